"""A drive's map before and after the repair, against the true grid at lidar height: Xu2024 Fig. 9."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from xu2024_pairs import TruePair

from slam.config import Config
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.layer_builder import LayerBuilder
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import LaserScan, row_from_pose2
from slam.simulation.true_grid import TrueGrid

RESOLUTION_M = 0.05
NEAR_CELLS = 1  # tolerance for walls and for occupied cells
_MARGIN_CELLS = 20  # about the true grid, which ends with the outer walls: what is near them lies outside too
_OCCUPIED = 100


@dataclass(frozen=True, slots=True)
class MapScore:
    """Shares, and the grids they are of.

    Attributes
    ----------
    completeness
        Of the wall cells that the lidar could have met, those that the map has occupied.
    false_occupied
        Of the occupied cells, those that are near no wall.
    """

    completeness: float
    false_occupied: float
    states: NDArray[np.int8]


class DriveMaps:
    """Maps of one drive from the same poses: one of the scans as they are, one of the repaired."""

    def __init__(self) -> None:
        settings = replace(layer_settings(Config()), resolution_m=RESOLUTION_M, robot_radius_m=0.0)
        self.before, self.after = LayerBuilder(settings), LayerBuilder(settings)
        self._met: list[NDArray[np.float64]] = []

    def add(self, pair: TruePair, repaired_m: NDArray[np.float32]) -> None:
        """One scan into both; what it truly met is what a map can be asked for."""
        scan, pose = pair.scan, row_from_pose2(pair.T_map_laser)
        for builder, ranges in ((self.before, scan.ranges_m), (self.after, repaired_m)):
            # Scans of one place are distinguished by their times, which a pair does not contain.
            numbered = LaserScan(
                float(len(self._met)), ranges, scan.start_angle_rad, scan.step_rad, scan.range_max_m
            )
            builder.add(numbered, pair.T_map_laser)
        bearings, truth = scan.bearings_rad() + pose[2], pair.true_ranges_m.astype(np.float64)
        met = np.isfinite(truth) & (truth <= scan.range_max_m)
        ends = pose[:2] + truth[met, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])[met]
        self._met.append(ends)

    def scores(self, truth: TrueGrid) -> tuple[MapScore, MapScore]:
        """Before and after."""
        ends = np.concatenate(self._met)
        before, after = self.before.grid("lidar"), self.after.grid("lidar")
        assert before is not None and after is not None
        return _score(before, truth, ends), _score(after, truth, ends)


def _score(grid: OccupancyGrid, truth: TrueGrid, ends: NDArray[np.float64]) -> MapScore:
    """Both grids are laid on one lattice through the map's origin."""
    states = grid.states()
    walls = np.pad(truth.occupied, _MARGIN_CELLS)
    shape, origin_xy = walls.shape, np.array(truth.origin_xy) - _MARGIN_CELLS * RESOLUTION_M
    offset = np.round(
        (np.array([grid.T_map_grid.x(), grid.T_map_grid.y()]) - origin_xy) / RESOLUTION_M
    ).astype(int)
    row, col = np.nonzero(states == _OCCUPIED)
    row, col = row + offset[1], col + offset[0]
    inside = (row >= 0) & (row < shape[0]) & (col >= 0) & (col < shape[1])
    occupied = np.zeros(shape, dtype=bool)
    occupied[row[inside], col[inside]] = True
    around = np.ones((2 * NEAR_CELLS + 1,) * 2, dtype=bool)
    near_wall = ndimage.binary_dilation(walls, around)
    wrong = np.count_nonzero(occupied & ~near_wall) + np.count_nonzero(~inside)
    cells = np.floor((ends - origin_xy) / RESOLUTION_M + 1e-6).astype(int)
    cells = cells.clip(0, np.array(shape[::-1]) - 1)
    wanted = np.zeros(shape, dtype=bool)
    wanted[cells[:, 1], cells[:, 0]] = True
    wanted &= near_wall
    met = ndimage.binary_dilation(occupied, around)
    return MapScore(
        completeness=float(np.count_nonzero(wanted & met) / max(np.count_nonzero(wanted), 1)),
        false_occupied=float(wrong / max(row.size, 1)),
        states=states,
    )
