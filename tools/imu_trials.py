"""What an IMU is worth to a 3D lidar on hard corners: clouds lost, seconds without any, gravity.

    PYTHONPATH=. python tools/imu_trials.py FOLDER [--worlds 11 12 13 14] [--rig car16]

Streets of the simulator (42 s, usual faults) whose corners are taken at 6 m/s, seen while the lidar turns:
each is drawn into FOLDER once and mapped without its satellite fixes, whole, without every third cloud, and
with clouds of 20 points only for 3 s about its first corner after 15 s, or for 20 s, where wheels tell 0.3 %
too much. A row a case: over the worlds, the median and in brackets the worst. Where the log ends with the gap
printed is the error of the robot then, as a share of the path driven in it. What the runs say goes to stderr.
"""

from __future__ import annotations

import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

import slam
from slam.datasets import open_dataset
from slam.datasets.dataset import Dataset
from slam.estimates import Trajectory
from slam.evaluation.coverage import coverage
from slam.evaluation.trajectory_error import absolute_error, associate
from slam.measurements import FloatArray, GnssFix, ImuReading, Measurement, PointCloud, WheelOdometry
from slam.simulation.street import STREET_FAULTS, STREET_RIGS, record_street
from slam.storage.tum import read_tum
from tools.handheld_imu import lean_degrees

SECONDS, SIDEWARD_M_S2 = 42.0, 8.0
CORNER_AFTER_S, CORNER_RAD_S, GAP_S = 15.0, 0.8, 3.0
LONG_GAP_S, WHEELS_TOO_FAR, FEW, TURN_S = (15.0, 35.0), 1.003, 20, 0.1
Span = tuple[float, float]
NEVER: Span = (np.inf, np.inf)


@dataclass(frozen=True)
class Case:
    """What is done to a street: when its clouds are useless, by its truth, which are lost, what is used."""

    name: str
    gap_s: Callable[[Trajectory], Span] = lambda _: NEVER
    ends: bool = False
    every: int = 0
    wheels: bool = False
    imu: bool = True
    forces: bool = True


def corner_gap(truth: Trajectory) -> Span:
    """Seconds about a corner."""
    yaw = np.unwrap(Rotation.from_quat(truth.quaternions_xyzw).as_euler("ZYX")[:, 0])
    at_s, rate = truth.stamps_s - truth.stamps_s[0], np.abs(np.gradient(yaw, truth.stamps_s))
    middle_s = float(at_s[(at_s > CORNER_AFTER_S) & (rate > CORNER_RAD_S)][0])
    return middle_s - 0.5 * GAP_S, middle_s + 0.5 * GAP_S


CASES = (
    Case("sharp corners, without its IMU", imu=False),
    Case("sharp corners, its gyroscope alone", forces=False),
    Case("sharp corners"),
    Case("every third cloud lost, without its IMU", every=3, imu=False),
    Case("every third cloud lost", every=3),
    Case("3 s about a corner without clouds", corner_gap),
    Case("the same, where they end", corner_gap, ends=True),
    Case("20 s without clouds, with wheels, where they end", lambda _: LONG_GAP_S, ends=True, wheels=True),
)


def cut(log: Dataset, case: Case, truth: Trajectory) -> Iterator[Measurement]:
    """A log without clouds, and with wheels, in order."""
    begun_s, clouds, rolled = None, 0, wheels(truth) if case.wheels else iter(())
    wheel, gap_s = next(rolled, None), case.gap_s(truth)
    for one in log:
        begun_s = one.stamp_s if begun_s is None else begun_s
        at_s = one.stamp_s - begun_s
        if case.ends and at_s > gap_s[1]:
            # A driver publishes a cloud after its last point, so readings cover it.
            if at_s > gap_s[1] + TURN_S:
                return
            if isinstance(one, PointCloud):
                continue
        while wheel is not None and wheel.stamp_s <= one.stamp_s:
            yield wheel
            wheel = next(rolled, None)
        if isinstance(one, PointCloud):
            clouds += 1
            if case.every and clouds % case.every == 0:
                continue
            if gap_s[0] < at_s < gap_s[1] and one.times_s is not None:
                one = replace(
                    one, points_lidar=one.points_lidar[:FEW], times_s=one.times_s[:FEW], intensities=None
                )
        if isinstance(one, ImuReading) and not case.forces:
            one = replace(one, specific_force_m_s2=np.zeros(3))
        if not isinstance(one, GnssFix):
            yield one


def wheels(truth: Trajectory, every: int = 5) -> Iterator[WheelOdometry]:
    """Wheel odometry of a car, 20 Hz: its path, measured too long, and turns about its upright axis."""
    rolled, before = gtsam.Pose2(), None
    for stamp_s, place, turn in zip(
        truth.stamps_s[::every].tolist(),
        truth.positions_m[::every],
        Rotation.from_quat(truth.quaternions_xyzw[::every]).as_matrix(),
        strict=True,
    ):
        here = gtsam.Pose3(gtsam.Rot3(turn), place)
        if before is not None:
            step = before.between(here)
            yaw = float(step.rotation().yaw())
            rolled = rolled.compose(gtsam.Pose2(WHEELS_TOO_FAR * step.x(), WHEELS_TOO_FAR * step.y(), yaw))
        before = here
        yield WheelOdometry(stamp_s, rolled)


def end_percent(found: Trajectory, truth: Trajectory, begin_s: float) -> float:
    """How far the last pose is off as seen from the last one before a gap, of the way driven since."""
    found, true = associate(found, truth)
    ends = [int(np.flatnonzero(true.stamps_s - truth.stamps_s[0] <= begin_s)[-1]), -1]
    turns = [Rotation.from_quat(one.quaternions_xyzw[ends[0]]) for one in (found, true)]
    steps = [np.diff(one.positions_m[ends], axis=0)[0] for one in (found, true)]
    seen, driven = (turn.inv().apply(step) for turn, step in zip(turns, steps, strict=True))
    inside = (truth.stamps_s >= true.stamps_s[ends[0]]) & (truth.stamps_s <= true.stamps_s[-1])
    way_m = float(np.linalg.norm(np.diff(truth.positions_m[inside], axis=0), axis=1).sum())
    return 100.0 * float(np.linalg.norm(seen - driven)) / way_m


def trial(folder: Path, case: Case) -> FloatArray:
    """ATE and worst in mm, lean in degrees and worst, percent at the end of the gap, share of ellipses."""
    truth = read_tum(folder / "groundtruth.txt")
    config = slam.load_config(None, [f"sensors.imu={case.imu}"])
    made = slam.build_map(cut(open_dataset(folder / "log.mcap"), case, truth), config)
    error = absolute_error(made.trajectory, truth).translation_m
    lean = lean_degrees(made.trajectory, truth)
    assert made.covariances is not None
    held = coverage(made.trajectory, made.covariances, truth, 0.02)
    off = end_percent(made.trajectory, truth, case.gap_s(truth)[0]) if case.ends else np.nan
    found = (1e3 * error.rmse, 1e3 * error.max, lean.mean(), lean.max(), off, held.nees, held.position)
    print(folder.name, case.name, np.round(found, 3).tolist(), *made.warnings, file=sys.stderr, sep="; ")
    made.close()
    return np.array(found)


def main() -> None:
    """Draw the streets, map them, print a row a case."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--worlds", nargs="+", type=int, default=[11, 12, 13, 14])
    parser.add_argument("--rig", choices=sorted(STREET_RIGS), default="car16")
    arguments = parser.parse_args()
    streets = []
    for world in arguments.worlds:
        streets.append(arguments.folder / f"{arguments.rig}_{world}")
        if not streets[-1].exists():
            rig, faults = STREET_RIGS[arguments.rig], STREET_FAULTS["usual"]
            record_street(
                world,
                world,
                streets[-1],
                rig,
                faults,
                SECONDS,
                formats=("mcap",),
                sideward_m_s2=SIDEWARD_M_S2,
            )
    print("| case | ATE, mm | worst pose | leans, degrees | worst | off at its end | NEES | ellipses hold |")
    print("|---|---|---|---|---|---|---|---|")
    for case in CASES:
        rows = np.array([trial(street, case) for street in streets])
        (ate, far, lean, most, off, nees, held), worst = np.median(rows, axis=0), rows.max(axis=0)
        drift = f"{off:.2f} ({worst[4]:.2f}) %" if case.ends else ""
        print(
            f"| {case.name} | {ate:.1f} ({worst[0]:.1f}) | {far:.0f} ({worst[1]:.0f}) | {lean:.2f} "
            f"({worst[2]:.2f}) | {most:.2f} ({worst[3]:.2f}) | {drift} | {nees:.1f} ({worst[5]:.1f}) | "
            f"{held:.2f} ({rows[:, 6].min():.2f}) |",
            flush=True,
        )


if __name__ == "__main__":
    main()
