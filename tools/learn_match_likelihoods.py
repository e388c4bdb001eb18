"""Learn what a beam says for or against a pose: the constants of the planar and the cloud sensor.

Scans of the part of a log that is not mapped, where most of each is known, are judged at their true pose and
at the best of all wrong ones: the aligned proposal, more than a metre off, that explains most beams. Clouds
of one simulated drive are judged in the map of another one of the same home. Of the beams that say anything.

    python tools/learn_match_likelihoods.py fr079.log.gz:0.6 intel.log.gz:0.5 --clouds FIRST SECOND
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from localization_trials import MAPPED_SHARE, Case, build_case, scans_of

from slam.config import Config, load_config
from slam.datasets import open_dataset
from slam.estimates import Trajectory
from slam.localization.cloud_sensor import CloudSensor
from slam.localization.known_map import Walls, has_walls
from slam.localization.planar_sensor import PlanarSensor
from slam.localization.poses import separation
from slam.localization.scan_view import ScanView
from slam.localization.sensor import Keyframe
from slam.mapper.pipeline import build_map
from slam.measurements import FloatArray, LaserScan, Pose, pose2_from_row

KINDS = ("explained", "crossing", "in free")
SCANS = 200
WRONG_M = 1.0


def main() -> None:
    """Print shares and log-likelihood ratios."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", help="as in fr079.log.gz:0.6, a log and the share that is mapped")
    parser.add_argument("--clouds", nargs=2, type=Path, help="two simulated drives of a 3D lidar in a home")
    arguments = parser.parse_args()
    config = load_config(None, [])
    for argument in arguments.logs:
        tell(argument, planar_pairs(build_case(*argument.rsplit(":", 1), config)))
    if arguments.clouds:
        tell("clouds", cloud_pairs(*arguments.clouds, load_config(None, ["sensors.rgbd=false"])))


def tell(name: str, pairs: Iterator[tuple[FloatArray, FloatArray]]) -> None:
    """Print the mean shares of beams at true and at wrong poses, each (3,), and their ratios."""
    right, wrong = np.mean(list(pairs), axis=0)
    print(f"\n| {name} | true | best wrong | nats |\n|---|---|---|---|")
    for kind, one, other in zip(KINDS, right, wrong, strict=True):
        print(f"| {kind} | {one:.3f} | {other:.3f} | {math.log(one / other):.2f} |", flush=True)


def planar_pairs(case: Case) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Shares of each kind of beam of scans at the true pose and at the best wrong one."""
    sensor = PlanarSensor(Walls(case.known_map, case.config), case.config)
    scans = [n for n in scans_of(case) if case.mapped[n] >= MAPPED_SHARE]
    for n in np.random.default_rng(0).choice(scans, SCANS):
        scan = case.log[n]
        assert isinstance(scan, LaserScan)
        view = ScanView.of(scan, case.config)
        novel = sensor.novel(view, gtsam.Pose2(), None)
        places = sensor.propose(view, [Keyframe(gtsam.Pose2(), 0.0, novel)], None)
        right, wrong = rivals(sensor, view, pose2_from_row(case.truth[n]), filter(None, places))
        counts = [np.array(sensor.counted(pose, novel)) for pose in (*right, *wrong)]
        if right and wrong:
            shares = [kinds[:3] / max(kinds[:3].sum(), 1) for kinds in counts]
            yield shares[0], max(shares[1:], key=lambda kinds: kinds[0])


def cloud_pairs(first: Path, second: Path, config: Config) -> Iterator[tuple[FloatArray, FloatArray]]:
    """The same of clouds; true poses by the simulator."""
    log, driven = open_dataset(first), open_dataset(second)
    result = build_map(log, config)
    mapped, truth, other = result.map.trajectory, log.groundtruth(), driven.groundtruth()
    assert truth is not None and other is not None
    T_map_world = at(mapped, 0).compose(nearest(truth, mapped.stamps_s[0]).inverse())
    known = result.map
    assert known.clouds is not None
    sensor = CloudSensor(known, Walls(known, config).field if has_walls(known) else None, config)
    for reading in driven:
        observed = sensor.observe(reading, None)
        if observed is None or round(10.0 * observed.stamp_s) % 10:
            continue
        view, places = observed.view, sensor.propose(observed.view, (), None)
        true = T_map_world.compose(nearest(other, observed.stamp_s))
        right, wrong = rivals(sensor, view, true, places)
        if right and wrong:
            judged = [sensor.judged(pose, view)[1] for pose in (*right, *wrong)]
            counts = [np.sum([one.explained, one.crossing, one.in_free], axis=1) for one in judged]
            shares = [kinds / max(kinds.sum(), 1) for kinds in counts]
            yield shares[0], max(shares[1:], key=lambda kinds: kinds[0])


def rivals(
    sensor: PlanarSensor | CloudSensor, view: Any, true: Pose, places: Iterable[Pose]
) -> tuple[list[Pose], list[Pose]]:
    """The true pose, if it can be aligned, and the wrong ones of some places, aligned where they can be."""
    motion = sensor.align(view, true)
    aligned = [(place, sensor.align(view, place)) for place in places]
    poses = [place if found is None else found.T_reference_base for place, found in aligned]
    right = [] if motion is None else [motion.T_reference_base]
    return right, [pose for pose in poses if separation(pose, true)[0] > WRONG_M]


def at(trajectory: Trajectory, n: int) -> gtsam.Pose3:
    """A pose of a trajectory."""
    x, y, z, w = trajectory.quaternions_xyzw[n].tolist()
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), trajectory.positions_m[n])


def nearest(trajectory: Trajectory, stamp_s: float) -> gtsam.Pose3:
    """The pose whose stamp is nearest."""
    return at(trajectory, int(np.abs(trajectory.stamps_s - stamp_s).argmin()))


if __name__ == "__main__":
    main()
