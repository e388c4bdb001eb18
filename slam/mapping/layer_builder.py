"""Build the lidar and depth grids from keyframes at known poses: the only place where evidence is drawn.

Grids are rebuilt from keyframes at their optimised poses, in any order, each counted once. Evidence is summed
without limits and clamped only in the final map; earlier clamping would make the map depend on the order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from typing import TypeAlias

import gtsam
import numpy as np

from fusion import bayes
from fusion.bayes import evidence_steps
from slam.errors import ScanweaveError
from slam.mapping.depth_grid import DepthModel, depth_board
from slam.mapping.evidence_tiles import SIDE, Board, EvidenceTiles, union
from slam.mapping.glass_panes import head_on, in_straight_runs
from slam.mapping.lidar_layer import LidarModel, lidar_board
from slam.mapping.occupancy_grid import OccupancyGrid, Steps
from slam.mapping.ray_tracing import Box
from slam.measurements import LaserScan, Pose, RgbdFrame, planar, row_from_pose2, spatial

# Probability that a cell under the robot is occupied; the pose may be a little off.
_UNDER_ROBOT = 0.2

Reading: TypeAlias = LaserScan | RgbdFrame

_MAX_POSITION_M = 1e6
# A map that is too large gets larger cells: at most so many cells are merged into one.
_MOST_CELLS_IN_ONE = 256


@dataclass(frozen=True, slots=True)
class LayerSettings:
    """Settings for drawing keyframes into grids.

    Attributes
    ----------
    resolution_m
        Side of a cell; Yang2021's R.
    p_min, p_max
        Bounds of each sensor's finished grid, so that the other one has an effect in Li2020 Eq. (10).
    robot_radius_m
        Radius of the disc around the base that the robot covers: objects there have gone.
    max_cells
        Largest number of cells of a finished grid; a larger map gets larger cells.
    """

    resolution_m: float
    lidar: LidarModel
    depth: DepthModel
    p_min: float = 0.02
    p_max: float = 0.98
    robot_radius_m: float = 0.0
    max_cells: int = 64_000_000


class LayerBuilder:
    """Grids that grow with the readings added; each reading is used once and not stored."""

    def __init__(self, settings: LayerSettings) -> None:
        self._settings = settings
        self._tiles: dict[str, EvidenceTiles] = {}
        self._scans_added: set[tuple[str, float, bytes]] = set()

    def add(self, reading: Reading, T_map_base: Pose) -> bool:
        """Add the scan or depth image of a keyframe; return False if it was added before.

        Parameters
        ----------
        reading
            Identified by sensor, stamp and pose, since the clocks of two logs in one map may agree.
        T_map_base
            Pose of the robot at the reading; the map's z = 0 is the floor.

        Raises
        ------
        ScanweaveError
            If the pose is not finite or too far away, the map would be far too large, or a frame has no
            mounting of its camera; the map stays unchanged.
        """
        if not (np.abs(T_map_base.matrix()) < _MAX_POSITION_M).all():
            raise ScanweaveError(f"cannot map the reading at {reading.stamp_s:.6f} s: its pose is lost")
        under = planar(T_map_base)
        key = (reading.sensor, reading.stamp_s, row_from_pose2(under).tobytes())
        if key in self._scans_added:
            return False
        settings = self._settings
        footprint = footprint_board(under, settings.robot_radius_m, settings.resolution_m)
        for name, board in self._boards(reading, T_map_base):
            self._check_room(board.box())
            heights = board.steps.shape[2] if board.steps.ndim == 3 else 1
            tiles = self._tiles.setdefault(name, EvidenceTiles(heights=heights))
            tiles.add(board)
            if footprint is not None:
                tiles.add(footprint)
        self._scans_added.add(key)
        return True

    def grid(self, name: str) -> OccupancyGrid | None:
        """Return the grid of ``lidar`` or ``depth`` so far, clamped; None without evidence. If it has too
        many cells, they become larger by an integer factor.
        """
        tiles, settings = self._tiles.get(name), self._settings
        if tiles is None or tiles.used is None:
            return None
        low, high = bayes.evidence_steps(settings.p_min), bayes.evidence_steps(settings.p_max)
        rows, cols = self._extent()[2:]
        side = math.ceil(math.sqrt(rows * cols / settings.max_cells))
        row, col, rows, cols = tiles.used
        row_to, col_to = -(-(row + rows) // side) * side, -(-(col + cols) // side) * side
        row, col = row // side * side, col // side * side
        box = (row, col, row_to - row, col_to - col)
        steps = tiles.coarse(box, low, high, side) if side > 1 else tiles.clipped(box, low, high)
        if name == "lidar" and side == 1:
            self._hold_panes(steps, box, low, high)
        corner = gtsam.Pose2(col * settings.resolution_m, row * settings.resolution_m, 0.0)
        return OccupancyGrid(steps, side * settings.resolution_m, corner)

    def _hold_panes(self, steps: Steps, box: Box, low: int, high: int) -> None:
        """Restore the evidence of head-on beams for panes in a box, where all beams together contradict it.

        To head-on beams they are twice as likely there as not. They are few, and stored by their indices.
        """
        row, col, rows, cols = box
        numbers, values = [np.zeros(0, np.intp)], [np.zeros(0, np.int16)]
        for first in range(0, rows, SIDE):
            part = steps[first : first + SIDE]
            panes = self._tiles["head on"].clipped((row + first, col, len(part), cols), low, high)
            cells = np.flatnonzero((panes > math.log(2.0) * bayes.STEPS_A_UNIT) & (part < 0))
            numbers.append(cells + first * cols)
            values.append(panes.ravel()[cells])
        cells = np.concatenate(numbers)
        straight = in_straight_runs(cells, (rows, cols), self._settings.resolution_m)
        steps.ravel()[cells[straight]] = np.concatenate(values)[straight]

    def _boards(self, reading: Reading, T_map_base: Pose) -> Iterator[tuple[str, Board]]:
        """Yield the evidence of a reading by layer; for a scan also that of its head-on beams."""
        settings = self._settings
        if isinstance(reading, LaserScan):
            cell_m, model = settings.resolution_m, settings.lidar
            for name, scan in (("lidar", reading), ("head on", head_on(reading, model.noise, cell_m))):
                yield name, lidar_board(scan, planar(T_map_base), model, cell_m)
            return
        if reading.T_base_camera is None:
            raise ScanweaveError(
                f"camera {reading.sensor} has no known mounting on the robot; give its mounting"
            )
        T_map_camera = spatial(T_map_base).compose(reading.T_base_camera)  # Yang2021 Eq. (15)-(16)
        matrix = np.asarray(T_map_camera.matrix())
        board = depth_board(reading, matrix, settings.depth, settings.resolution_m)
        if board is not None:
            yield "depth", board

    def _check_room(self, box: Box) -> None:
        """Raise an error if the map would grow as only a lost pose can explain."""
        rows, cols = self._extent(box)[2:]
        if rows * cols > _MOST_CELLS_IN_ONE * self._settings.max_cells:
            raise ScanweaveError(
                f"the map would have {rows} x {cols} cells of {self._settings.resolution_m:g} m, the limit "
                f"is {_MOST_CELLS_IN_ONE} x {self._settings.max_cells}: choose a coarser resolution, or look "
                "for a lost pose"
            )

    def _extent(self, *boxes: Box) -> Box:
        """Return the box of all layers so far, and other boxes."""
        used = [tiles.used for tiles in self._tiles.values() if tiles.used is not None]
        return reduce(union, [*used, *boxes])


def footprint_board(pose: gtsam.Pose2, radius_m: float, cell_m: float) -> Board | None:
    """Return the evidence of a keyframe's pose on the lattice; None if no whole cell is under the robot.

    Parameters
    ----------
    radius_m
        Radius of the disc around the base that the robot covers.
    """
    x, y, reach = pose.x() / cell_m, pose.y() / cell_m, radius_m / cell_m - 0.5 * np.sqrt(2.0)
    if reach <= 0.0:
        return None
    first_row, first_col = int(np.floor(y - reach)), int(np.floor(x - reach))
    side = int(np.ceil(2.0 * reach)) + 1
    rows = first_row + np.arange(side) + 0.5 - y
    cols = first_col + np.arange(side) + 0.5 - x
    under = rows[:, None] ** 2 + cols[None, :] ** 2 <= reach**2
    return Board(np.where(under, evidence_steps(_UNDER_ROBOT), 0).astype(np.int16), first_row, first_col)
