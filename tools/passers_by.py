"""What people leave in the lidar's grid of drives that were simulated and mapped: cells, before and after.

    python tools/passers_by.py --rig xu2024 --homes 61 62 63 [--duration 60]

Left: occupied with the people's beams and not without them; by everything, by what beams have passed alone,
and with what was followed from scan to scan too. Lost: fixed, and taken out with the people.
"""

from __future__ import annotations

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from dataclasses import replace

import gtsam
import numpy as np

from slam.app.mapping import Measured
from slam.config import Config
from slam.mapper.pipeline import build_map
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.layer_builder import LayerBuilder
from slam.mapping.layered_map import OCCUPANCY
from slam.mapping.occupancy_grid import OCCUPIED, OccupancyGrid
from slam.mapping.passers_by import without_passers_by
from slam.measurements import BoolArray, LaserScan, pose2_from_row
from slam.simulation.drive import simulate_drive
from slam.simulation.drive_faults import DriveFaults
from slam.simulation.events import OdometryEvent, ScanEvent
from slam.simulation.faults import Fault
from slam.simulation.home import generate_home
from slam.simulation.rigs import RIGS

Placed = list[tuple[LaserScan, gtsam.Pose2]]


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
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--rig", default="xu2024", choices=sorted(RIGS))
    parser.add_argument("--homes", type=int, nargs="+", default=[61])
    parser.add_argument("--duration", type=float, help="seconds; one tour if absent")
    arguments = parser.parse_args()
    config, sums = Config(), np.zeros(6, dtype=int)
    print("| home | occupied | left by people | by passes | and followed | lost | and followed |")
    print("|---|---|---|---|---|---|---|")
    blind = replace(RIGS[arguments.rig], cameras=())
    for home in arguments.homes:
        events = list(
            simulate_drive(
                generate_home(home, "home"), blind, home, DriveFaults(person=True), arguments.duration
            )
        )
        person = {one.scan.stamp_s: one.fault == Fault.PERSON for one in events if isinstance(one, ScanEvent)}
        measurements = [
            event.scan if isinstance(event, ScanEvent) else event.reading
            for event in events
            if isinstance(event, ScanEvent | OdometryEvent)
        ]
        made = build_map(Measured(measurements), config).map
        placed = [
            (scan, pose2_from_row(pose))
            for scan, pose in zip(made.measured_scans, made.keyframe_poses, strict=True)
            if scan is not None
        ]
        alone = [
            (replace(scan, ranges_m=np.where(person[scan.stamp_s], np.float32(np.nan), scan.ranges_m)), pose)
            for scan, pose in placed
        ]
        grid = drawn(placed, config)
        static, _ = without_passers_by(grid, placed, layer_settings(config).lidar)
        truth, before, passed, after = (
            occupied(one, grid) for one in (drawn(alone, config), grid, static, made.grids[OCCUPANCY])
        )
        left = [np.count_nonzero(one & ~truth) for one in (before, passed, after)]
        lost = [np.count_nonzero(truth & before & ~one) for one in (passed, after)]
        row = [np.count_nonzero(truth), *left, *lost]
        sums += np.array(row)
        print(f"| {home} | {' | '.join(str(one) for one in row)} |", flush=True)
    print(f"| **all** | {' | '.join(str(one) for one in sums)} |")


if __name__ == "__main__":
    main()
