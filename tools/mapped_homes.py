"""Layers that the whole pipeline makes of simulated drives, against the true plan, within one cell.

    python tools/mapped_homes.py DRIVE [DRIVE ...] --robot-height METRES

Each drive is a folder of ``scanweave simulate --format folder``. Asked for is what borders on the floor
within four metres of the robot's way, seen or not: a short drive cannot reach 1.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from slam.comparison.map_score import map_scores, read_true_grid
from slam.comparison.product import StateGrid
from slam.config import load_config
from slam.datasets import open_dataset
from slam.evaluation.trajectory_error import absolute_error
from slam.mapper.pipeline import build_map
from slam.mapping.layered_map import LAYERS


def main() -> None:
    """Map every drive and print a row for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("drives", nargs="+", type=Path)
    parser.add_argument("--robot-height", type=float, required=True, help="of the drive's rig, metres")
    arguments = parser.parse_args()
    print(f"| drive | ATE, m | {' | '.join(f'{name}: F1, precision, recall' for name in LAYERS)} |")
    print("|---" * (len(LAYERS) + 2) + "|")
    for drive in arguments.drives:
        print(f"| {drive.name} | {' | '.join(_row(drive, arguments.robot_height))} |", flush=True)


def _row(drive: Path, robot_height_m: float) -> list[str]:
    """Trajectory error and the scores of every layer of one drive."""
    config = load_config(None, ["dense_map.enabled=false", f"layers.robot_height_m={robot_height_m:g}"])
    dataset = open_dataset(drive)
    result = build_map(dataset, config)
    built, driven = result.map.layers(config), dataset.groundtruth()
    if built is None or driven is None:
        raise SystemExit(
            f"{drive} has no camera or no true trajectory; give a simulated drive of such a robot"
        )
    error = absolute_error(result.map.trajectory, driven)
    truth = read_true_grid(drive / "truth" / "grid_robot.npz")
    cells = [f"{error.translation_m.rmse:.4f}"]
    for name in LAYERS:
        found = StateGrid(built.states(name), built.resolution_m, built.T_map_grid)
        score = map_scores(found, truth, error.T_reference_map, driven.positions_m[:, :2])
        cells.append(f"{score['f1']:.3f}, {1.0 - score['false_occupied']:.3f}, {score['completeness']:.3f}")
    return cells


if __name__ == "__main__":
    main()
