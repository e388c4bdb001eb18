"""What people leave in the lidar's grid of simulated drives, at the true poses: cells, before and after.

    python tools/passers_by.py --rig xu2024 --homes 61 62 63 [--duration 60]

Left: occupied with the people's beams and not without them. Lost: fixed, and taken out with the people.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np

from slam.config import Config
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.layer_builder import LayerBuilder
from slam.mapping.occupancy_grid import OCCUPIED, OccupancyGrid
from slam.mapping.passers_by import without_passers_by
from slam.matching.planar import between
from slam.measurements import BoolArray, LaserScan, row_from_pose2
from slam.simulation.drive import simulate_drive
from slam.simulation.drive_faults import DriveFaults
from slam.simulation.events import ScanEvent
from slam.simulation.faults import Fault
from slam.simulation.home import generate_home
from slam.simulation.rigs import RIGS

Placed = list[tuple[LaserScan, gtsam.Pose2]]


def keyframes(rig: str, home: int, duration_s: float | None, config: Config) -> Iterator[ScanEvent]:
    """Sweeps as far apart as keyframes are."""
    blind = replace(RIGS[rig], cameras=())
    newest = None
    for event in simulate_drive(
        generate_home(home, "home"), blind, home, DriveFaults(person=True), duration_s
    ):
        if isinstance(event, ScanEvent):
            pose = row_from_pose2(event.T_map_base)
            step = np.full(3, np.inf) if newest is None else between(newest, pose)
            far = np.hypot(step[0], step[1]) > config.keyframes.distance_m
            if far or abs(step[2]) > config.keyframes.angle_rad:
                newest = pose
                yield event


def drawn(placed: Placed, config: Config) -> OccupancyGrid:
    """The grid with everything in it."""
    builder = LayerBuilder(layer_settings(config))
    for scan, T_map_base in placed:
        builder.add(scan, T_map_base)
    grid = builder.grid("lidar")
    assert grid is not None
    return grid


def occupied(grid: OccupancyGrid, like: OccupancyGrid) -> BoolArray:
    """Occupied cells of a grid on the lattice of another that holds it."""
    cells = np.zeros(like.shape, dtype=np.bool_)
    row, col = like.cells_of(
        np.array([[grid.T_map_grid.x(), grid.T_map_grid.y()]]) + 0.5 * grid.resolution_m
    )[0]
    cells[row : row + grid.shape[0], col : col + grid.shape[1]] = grid.states() == OCCUPIED
    return cells


def main() -> None:
    """Print one Markdown table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rig", default="xu2024", choices=sorted(RIGS))
    parser.add_argument("--homes", type=int, nargs="+", default=[61])
    parser.add_argument("--duration", type=float, help="seconds; one tour if absent")
    arguments = parser.parse_args()
    config, sums = Config(), np.zeros(4, dtype=int)
    print("| home | occupied | left by people | left now | lost |\n|---|---|---|---|---|")
    for home in arguments.homes:
        events = list(keyframes(arguments.rig, home, arguments.duration, config))
        placed = [(event.scan, event.T_map_base) for event in events]
        alone = [
            np.where(event.fault == Fault.PERSON, np.float32(np.nan), event.scan.ranges_m) for event in events
        ]
        known = drawn(
            [(replace(scan, ranges_m=r), pose) for (scan, pose), r in zip(placed, alone, strict=True)], config
        )
        grid = drawn(placed, config)
        static = without_passers_by(grid, placed, layer_settings(config).lidar).static
        truth, before, after = (occupied(one, grid) for one in (known, grid, static))
        row = [truth.sum(), (before & ~truth).sum(), (after & ~truth).sum(), (truth & before & ~after).sum()]
        sums += np.array(row)
        print(f"| {home} | {' | '.join(str(one) for one in row)} |", flush=True)
    print(f"| **all** | {' | '.join(str(one) for one in sums)} |")


if __name__ == "__main__":
    main()
