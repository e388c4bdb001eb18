"""Whether the simulator's bags map to the same result as its folders.

Usage: python tools/bag_equivalence.py [--rigs xu2024 lidar3d] [--home 1] [--duration 20]
A drive of each of the simulator's robots is recorded in both formats, and both are mapped. A line per robot
gives the largest distance of the poses, and how many cells of the plans differ. Exit code 1 beyond 1 mm.
"""

from __future__ import annotations

import sys
import tempfile
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.config import load_config
from slam.datasets import open_dataset
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.simulation.drive_faults import FAULT_PRESETS
from slam.simulation.home import generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS

_MOST_APART_M = 1e-3


@dataclass(frozen=True)
class Difference:
    """Of two maps: poses with a stamp in only one, greatest distance of the others in metres, cells."""

    lonely: int
    apart_m: float
    cells: int

    @property
    def is_same(self) -> bool:
        """To the millimetre."""
        return not self.lonely and self.apart_m <= _MOST_APART_M


def main() -> None:
    """Record, map twice, compare."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", nargs="+", choices=list(RIGS), default=list(RIGS))
    parser.add_argument("--home", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--duration", type=float, default=20.0)
    arguments = parser.parse_args()
    same = True
    for name in arguments.rigs:
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder) / name
            home = generate_home(arguments.home, "home")
            faults = FAULT_PRESETS["usual"]
            record_drive(
                home, RIGS[name], arguments.seed, log, faults, arguments.duration, formats=("folder", "mcap")
            )
            found = difference(mapped(log), mapped(log / "log.mcap"))
        same = same and found.is_same
        print(
            f"{name:16s} at most {1e3 * found.apart_m:.4f} mm apart, {found.lonely} poses in one alone, "
            f"{found.cells} cells differ",
            flush=True,
        )
    sys.exit(0 if same else 1)


def mapped(log: Path) -> MapResult:
    """The map of a log by the preset settings."""
    return build_map(open_dataset(log), load_config(None, []))


def difference(one: MapResult, other: MapResult) -> Difference:
    """Compare trajectories stamp by stamp, and plans cell by cell."""
    stamps = [np.round(result.map.trajectory.stamps_s, 6) for result in (one, other)]
    _, here, there = np.intersect1d(stamps[0], stamps[1], return_indices=True)
    ways = one.map.trajectory.positions_m[here] - other.map.trajectory.positions_m[there]
    lonely = len(np.setxor1d(stamps[0], stamps[1]))
    apart_m = float(np.linalg.norm(ways, axis=1).max(initial=0.0))
    return Difference(lonely, apart_m, different_cells(one.map.grid, other.map.grid))


def different_cells(one: OccupancyGrid | None, other: OccupancyGrid | None) -> int:
    """Cells whose state differs; all where only one map has a plan, or the plans are of different sizes."""
    if one is None or other is None:
        return sum(plan.steps.size for plan in (one, other) if plan is not None)
    states, others = one.states(), other.states()
    return int((states != others).sum()) if states.shape == others.shape else states.size


if __name__ == "__main__":
    main()
