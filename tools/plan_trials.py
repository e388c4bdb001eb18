"""What a robot would ask of a map to drive by: does a plan over it hit something, and where does it lead?

    python tools/plan_trials.py DRIVE MAP [DRIVE MAP ...] [--set KEY=VALUE ...] [--json FILE]

DRIVE is a folder of ``scanweave simulate --format folder``, MAP what ``scanweave map`` made of it. The layers
are drawn anew from its keyframes, at their poses, with and without what lidar and cameras repaired of each
other, decided by both rules, and with gaps of glass closed: a row each, the mean over the drives, then each
row against the first by the median of the paired differences with the bootstrap interval of 95 % over homes.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.comparison.map_score import map_scores, read_true_grid
from slam.comparison.plan_score import plan_scores
from slam.comparison.statistics import paired
from slam.config import Config, load_config
from slam.datasets import open_dataset
from slam.evaluation.trajectory_error import absolute_error
from slam.mapper.map_result import depth_grid
from slam.mapping.glass_gaps import with_glass
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.layered_map import DecisionRule, LayeredMap
from slam.measurements import LaserScan
from slam.outputs.finished_map import Map, load_map
from slam.storage.tum import read_tum

# What is better when it is small.
_SMALLER = ("collide", "collide_hard", "danger", "false_occupied")
SHOWN = (*_SMALLER[:3], "reach", "reach_near", "false_occupied", "completeness", "f1")


def main() -> None:
    """Score every drive, and print the table."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("pairs", nargs="+", type=Path, metavar="DRIVE MAP")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the layers")
    parser.add_argument("--radius", type=float, default=0.25, help="of the robot, metres")
    parser.add_argument("--json", type=Path, help="gets the figures of every drive")
    arguments = parser.parse_args()
    if len(arguments.pairs) % 2:
        parser.error("give a MAP for every DRIVE")
    config = load_config(None, arguments.set)
    found: dict[str, dict[str, dict[str, float]]] = {}
    for drive, folder in zip(arguments.pairs[::2], arguments.pairs[1::2], strict=True):
        truth, way = read_true_grid(drive / "truth" / "grid_robot.npz"), read_tum(drive / "groundtruth.txt")
        with closing(load_map(folder)) as saved:
            for name, layers in variants(drive, saved, config):
                states = layers.decision()
                T_true_map = absolute_error(saved.trajectory, way).T_reference_map
                laid = (states, truth, T_true_map, way.positions_m[:, :2])
                scores = plan_scores(*laid, saved.trajectory.positions_m[:, :2], arguments.radius)
                found.setdefault(name, {})[drive.name] = scores | map_scores(*laid)
        print(f"{drive.name} done", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(table(found))


def variants(drive: Path, saved: Map, config: Config) -> Iterator[tuple[str, LayeredMap]]:
    """Ways to make the map to drive by of one drive's keyframes."""
    raw = raw_scans(drive, saved)
    depth = depth_grid(saved.contents.frames or (), saved.contents.frame_poses(), config)
    for name, scans in (("no fusion", raw), ("fused scans", list(saved.keyframe_scans))):
        lidar = grid_of_keyframes(scans, saved.keyframe_poses, config)
        for rule in ("corrected", "cautious"):
            yield f"{name}, {rule}", LayeredMap(lidar, depth, DecisionRule(rule))
        if lidar is not None:
            closed = with_glass(lidar, scans, saved.keyframe_poses, config)
            yield f"{name}, glass, cautious", LayeredMap(closed, depth, DecisionRule())


def raw_scans(drive: Path, saved: Map) -> list[LaserScan | None]:
    """The scans of the map's keyframes as they were recorded."""
    recorded = {reading.stamp_s: reading for reading in open_dataset(drive) if isinstance(reading, LaserScan)}
    return [
        None if scan is None else replace(scan, ranges_m=recorded[scan.stamp_s].ranges_m)
        for scan in saved.keyframe_scans
    ]


def table(found: dict[str, dict[str, dict[str, float]]], shown: Sequence[str] = SHOWN) -> str:
    """Means, and the median difference from the first row with its interval."""
    lines = [f"| map to drive by | {' | '.join(shown)} |", "|---" * (len(shown) + 1) + "|"]
    first = next(iter(found.values()))
    for name, drives in found.items():
        cells = [
            f"{np.nanmean([scores.get(key, np.nan) for scores in drives.values()]):.3f}" for key in shown
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
        if drives is not first:
            lines.append(f"| minus the first | {' | '.join(_against(drives, first, key) for key in shown)} |")
    return "\n".join(lines)


def _against(drives: dict[str, dict[str, float]], first: dict[str, dict[str, float]], key: str) -> str:
    """The median difference, its interval, and in how many drives it is better."""
    values, reference = (
        {(name, name, 0): scores.get(key, np.nan) for name, scores in part.items()}
        for part in (drives, first)
    )
    reported = paired(values, reference, smaller_is_better=key in _SMALLER)
    if reported is None:
        return "-"
    middle = reported.difference
    return f"{middle.median:+.3f} ({middle.low:+.3f} to {middle.high:+.3f}; {reported.better}/{middle.count})"


if __name__ == "__main__":
    main()
