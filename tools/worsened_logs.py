"""Degrade real logs in typical ways, map them, and score the relations."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from pathlib import Path

import gtsam
import numpy as np

from slam.config import load_config
from slam.datasets import open_dataset
from slam.estimates import Trajectory
from slam.evaluation.alignment import nearest_indices
from slam.evaluation.relations import read_relations, score_relations
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.mapper import Mapper
from slam.measurements import FloatArray, LaserScan, Measurement, WheelOdometry

KINDS = {
    "as recorded": "as recorded",
    "jumps": "odometry jumps by metres, every 400 readings or so",
    "frozen": "odometry that never moves",
    "none": "no odometry",
    "half": "every second scan",
    "noise": "3 cm of range noise",
    "short": "range cut to 5.6 m",
    "sparse": "every fourth beam",
    "narrow": "field of view cut to 120 degrees",
    "people": "two people close by in every scan",
    "gaps": "30 times 5 to 28 s without a scan",
    "gross": "40 gross errors of the wheels",
    "late": "scans 0.1 s behind the wheels",
    "all": "these three together",
    "fewer": "the same, 6 gaps and 8 gross errors",
}
# How many gaps without a scan, and how many gross errors of the wheels.
GAPS = {"gaps": 30, "all": 30, "fewer": 6}
GROSS = {"gross": 40, "all": 40, "fewer": 8}
GAP_S = 5.0, 28.0
LATE = "late", "all", "fewer"
GROSS_KINDS, GROSS_SHARES = ("heading", "position", "standstill"), (0.55, 0.25, 0.2)
LATE_S = 0.1


def main() -> None:
    """Run the matrix and print one Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder of lidar2d/")
    parser.add_argument("--log", action="append", help="fr079 or intel; repeatable; both by default")
    parser.add_argument("--kind", action="append", choices=KINDS, help="repeatable; all by default")
    parser.add_argument("--seed", action="append", type=int, help="seed; repeatable; 1 by default")
    parser.add_argument("--set", action="append", default=[], help="as in scanweave map --set")
    arguments = parser.parse_args()
    logs = arguments.log or ["fr079", "intel"]
    print(f"| | {' | '.join(logs)} |\n|---|{'---|' * len(logs)}", flush=True)
    for kind in arguments.kind or KINDS:
        for seed in arguments.seed or [1]:
            cells = [cell_of(arguments.data / "lidar2d" / log, kind, seed, arguments.set) for log in logs]
            draw = f", draw {seed}" if len(arguments.seed or []) > 1 else ""
            print(f"| {KINDS[kind]}{draw} | {' | '.join(cells)} |", flush=True)


def cell_of(folder: Path, kind: str, seed: int, settings: list[str]) -> str:
    """Mean error of the relations of a log that was made worse, and the greatest."""
    config = load_config(None, settings)
    mapper, scans_s = Mapper(config, PlanarRobot(config)), []
    for measurement in worsened(folder / f"{folder.name}.log.gz", kind, np.random.default_rng(seed)):
        mapper.add(measurement)
        if isinstance(measurement, LaserScan):
            scans_s.append(measurement.stamp_s)
    made = seen(mapper.finish().map.trajectory, np.array(scans_s))
    errors = score_relations(made, read_relations(folder / f"{folder.name}.relations")).all.translation_m
    return f"{errors.mean:.3f} ({errors.max:.2f})"


def worsened(path: Path, kind: str, rng: np.random.Generator) -> Iterator[Measurement]:
    """The log's measurements, changed."""
    log: Iterable[Measurement] = open_dataset(path)
    if kind in LATE:
        log = ahead(list(log))
    if kind in GROSS:
        log = grossly_wrong(list(log), GROSS[kind], rng)
    if kind in GAPS:
        log = without_scans(list(log), GAPS[kind], rng)
    offset = gtsam.Pose2()
    scans = 0
    for measurement in log:
        if isinstance(measurement, WheelOdometry):
            if kind == "none":
                continue
            if kind == "jumps" and rng.random() < 1 / 400:
                offset = offset.compose(gtsam.Pose2(*rng.normal(0.0, 3.0, 2), rng.normal(0.0, 1.5)))
            pose = gtsam.Pose2() if kind == "frozen" else offset.compose(measurement.T_odom_base)
            yield replace(measurement, T_odom_base=pose)
            continue
        scans += 1
        if kind != "half" or scans % 2 == 0:
            yield worsened_scan(measurement, kind, rng)


def seen(made: Trajectory, scans_s: FloatArray) -> Trajectory:
    """The poses that are not in a gap."""
    apart_s = np.abs(scans_s[nearest_indices(scans_s, made.stamps_s)] - made.stamps_s)
    return made[apart_s < GAP_S[0] / 2]


def times_s(log: Sequence[Measurement]) -> FloatArray:
    """(N,) that rise in the log's order: stamps may run backward."""
    stamps_s = np.array([measurement.stamp_s for measurement in log])
    return 0.5 * (np.maximum.accumulate(stamps_s) + np.minimum.accumulate(stamps_s[::-1])[::-1])


def grossly_wrong(log: list[Measurement], count: int, rng: np.random.Generator) -> Iterator[Measurement]:
    """Wheels that turn by 10 to 180 degrees, go 0.5 to 3 m, or neither count nor tell for 2 to 8 s, at once.

    As `scanweave simulate --campus` draws them, evenly over the way.
    """
    poses = [one.T_odom_base for one in log if isinstance(one, WheelOdometry)]
    ways_m = [
        0.0,
        *accumulate(float(a.range(b.translation())) for a, b in pairwise(poses)),
    ]
    due_m = np.sort(rng.uniform(0.0, ways_m[-1], count)).tolist()
    wrong, silent_s, before, number = gtsam.Pose2(), -math.inf, gtsam.Pose2(), -1
    for now_s, measurement in zip(times_s(log).tolist(), log, strict=True):
        if not isinstance(measurement, WheelOdometry):
            yield measurement
            continue
        number, pose = number + 1, measurement.T_odom_base
        if now_s < silent_s:
            # What it has moved until now is not counted.
            wrong = wrong * before * pose.inverse()
            before = pose
            continue
        if due_m and ways_m[number] >= due_m[0]:
            due_m.pop(0)
            kind, sign = str(rng.choice(GROSS_KINDS, p=GROSS_SHARES)), rng.choice([-1.0, 1.0])
            jump = gtsam.Pose2()
            if kind == "heading":
                jump = gtsam.Pose2(0.0, 0.0, sign * math.radians(rng.uniform(10.0, 180.0)))
            elif kind == "position":
                towards, far_m = rng.uniform(-math.pi, math.pi), rng.uniform(0.5, 3.0)
                jump = gtsam.Pose2(far_m * math.cos(towards), far_m * math.sin(towards), 0.0)
            else:
                silent_s = now_s + rng.uniform(2.0, 8.0)
            wrong = wrong * pose * jump * pose.inverse()
        before = pose
        yield replace(measurement, T_odom_base=wrong * pose)


def without_scans(log: list[Measurement], count: int, rng: np.random.Generator) -> Iterator[Measurement]:
    """Gaps, one in each of as many equal parts of the time; wheels go on."""
    stamps_s = times_s(log)
    bounds_s = np.linspace(stamps_s[0], stamps_s[-1], count + 1)
    lengths_s = rng.uniform(*GAP_S, count)
    begun_s = rng.uniform(bounds_s[:-1], bounds_s[1:] - lengths_s)
    for now_s, measurement in zip(stamps_s.tolist(), log, strict=True):
        silent = ((begun_s < now_s) & (now_s < begun_s + lengths_s)).any()
        if isinstance(measurement, WheelOdometry) or not silent:
            yield measurement


def ahead(log: list[Measurement]) -> Iterator[Measurement]:
    """Wheels that tell where the robot is a little later than a scan of the same stamp."""
    poses = [one.T_odom_base for one in log if isinstance(one, WheelOdometry)]
    share = LATE_S * len(poses) / (log[-1].stamp_s - log[0].stamp_s)
    number = 0
    for measurement in log:
        if isinstance(measurement, WheelOdometry):
            pose, number = poses[number], number + 1
            step = pose.between(poses[min(number, len(poses) - 1)])
            part = gtsam.Pose2(share * step.x(), share * step.y(), share * step.theta())
            measurement = replace(measurement, T_odom_base=pose * part)
        yield measurement


def worsened_scan(scan: LaserScan, kind: str, rng: np.random.Generator) -> LaserScan:
    """One sweep, changed."""
    ranges = scan.ranges_m
    if kind == "noise":
        noisy = ranges + rng.normal(0.0, 0.03, ranges.size)
        return replace(scan, ranges_m=noisy.astype(np.float32))
    if kind == "short":
        return replace(scan, ranges_m=np.where(ranges > 5.6, np.inf, ranges).astype(np.float32))
    if kind == "sparse":
        return replace(scan, step_rad=4 * scan.step_rad, ranges_m=ranges[::4].copy())
    if kind == "narrow":
        cut = ranges.size // 6
        start_rad = scan.start_angle_rad + cut * scan.step_rad
        return replace(scan, start_angle_rad=start_rad, ranges_m=ranges[cut:-cut].copy())
    if kind == "people":
        ranges = ranges.copy()
        for _ in range(2):
            centre, half = rng.integers(0, ranges.size), ranges.size // 20
            near = slice(max(0, centre - half), centre + half)
            ranges[near] = np.minimum(ranges[near], rng.uniform(0.8, 3.0))
        return replace(scan, ranges_m=ranges)
    return scan


if __name__ == "__main__":
    main()
