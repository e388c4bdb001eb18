"""Map the real logs after making them worse in ways that other people's logs are, and score the relations."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np

from slam.config import load_config
from slam.datasets import open_dataset
from slam.evaluation.relations import read_relations, score_relations
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.mapper import Mapper
from slam.measurements import LaserScan, Measurement, WheelOdometry

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
}


def main() -> None:
    """Run the matrix and print one Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="holds lidar2d/")
    parser.add_argument("--log", action="append", help="fr079 or intel; repeatable; both by default")
    parser.add_argument("--kind", action="append", choices=KINDS, help="repeatable; all by default")
    parser.add_argument("--set", action="append", default=[], help="as in scanweave map --set")
    arguments = parser.parse_args()
    logs = arguments.log or ["fr079", "intel"]
    print(f"| | {' | '.join(logs)} |\n|---|{'---|' * len(logs)}", flush=True)
    for kind in arguments.kind or KINDS:
        errors = [f"{error_m(arguments.data / 'lidar2d' / log, kind, arguments.set):.3f}" for log in logs]
        print(f"| {KINDS[kind]} | {' | '.join(errors)} |", flush=True)


def error_m(folder: Path, kind: str, settings: list[str]) -> float:
    """Mean error of the relations of a log that was made worse."""
    config = load_config(None, settings)
    mapper = Mapper(config, PlanarRobot(config))
    for measurement in worsened(folder / f"{folder.name}.log.gz", kind, np.random.default_rng(1)):
        mapper.add(measurement)
    made = mapper.finish().map.trajectory
    return score_relations(made, read_relations(folder / f"{folder.name}.relations")).all.translation_m.mean


def worsened(path: Path, kind: str, rng: np.random.Generator) -> Iterator[Measurement]:
    """The log's measurements, changed."""
    offset = gtsam.Pose2()
    scans = 0
    for measurement in open_dataset(path):
        if isinstance(measurement, WheelOdometry):
            if kind == "none":
                continue
            if kind == "jumps" and rng.random() < 1 / 400:
                offset = offset.compose(gtsam.Pose2(*rng.normal(0.0, 3.0, 2), rng.normal(0.0, 1.5)))
            pose = gtsam.Pose2() if kind == "frozen" else offset.compose(measurement.T_odom_base)
            yield dataclasses.replace(measurement, T_odom_base=pose)
            continue
        scans += 1
        if kind != "half" or scans % 2 == 0:
            yield worsened_scan(measurement, kind, rng)


def worsened_scan(scan: LaserScan, kind: str, rng: np.random.Generator) -> LaserScan:
    """One sweep, changed."""
    ranges = scan.ranges_m
    if kind == "noise":
        noisy = ranges + rng.normal(0.0, 0.03, ranges.size)
        return dataclasses.replace(scan, ranges_m=noisy.astype(np.float32))
    if kind == "short":
        return dataclasses.replace(scan, ranges_m=np.where(ranges > 5.6, np.inf, ranges).astype(np.float32))
    if kind == "sparse":
        return dataclasses.replace(scan, step_rad=4 * scan.step_rad, ranges_m=ranges[::4].copy())
    if kind == "narrow":
        cut = ranges.size // 6
        start_rad = scan.start_angle_rad + cut * scan.step_rad
        return dataclasses.replace(scan, start_angle_rad=start_rad, ranges_m=ranges[cut:-cut].copy())
    if kind == "people":
        ranges = ranges.copy()
        for _ in range(2):
            centre, half = rng.integers(0, ranges.size), ranges.size // 20
            near = slice(max(0, centre - half), centre + half)
            ranges[near] = np.minimum(ranges[near], rng.uniform(0.8, 3.0))
        return dataclasses.replace(scan, ranges_m=ranges)
    return scan


if __name__ == "__main__":
    main()
