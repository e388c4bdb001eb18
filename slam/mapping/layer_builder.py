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
from slam.errors import ScanweaveError
from slam.mapping.depth_grid import DepthModel, depth_board
from slam.mapping.evidence_tiles import SIDE, Board, EvidenceTiles, union
from slam.mapping.footprint import footprint_board
from slam.mapping.glass_panes import head_on, in_straight_runs
from slam.mapping.lidar_layer import LidarModel, lidar_board
from slam.mapping.occupancy_grid import OccupancyGrid, Steps
from slam.mapping.ray_tracing import Box
from slam.measurements import LaserScan, Pose, RgbdFrame, planar, row_from_pose2, spatial

Reading: TypeAlias = LaserScan | RgbdFrame

_MAX_POSITION_M = 1e6
# A map too large for its cells gets larger ones: so many of them in one at most.
_MOST_CELLS_IN_ONE = 256


@dataclass(frozen=True, slots=True)
class LayerSettings:
    """How keyframes become grids.

    Attributes
    ----------
    resolution_m
        Side of a cell; Yang2021's R.
    lidar, depth
        The inverse sensor models.
    p_min, p_max
        Bounds of each sensor's finished grid; they leave the other a say in Li2020 Eq. (10).
    robot_radius_m
        Of a disc around the base that the robot covers: what stood there has gone.
    memory_mb
        Memory for the tiles of each layer while building, 10^6 bytes; the rest waits on disk.
    max_cells
        Of a finished grid; a larger map gets larger cells.
    """

    resolution_m: float
    lidar: LidarModel
    depth: DepthModel
    p_min: float = 0.02
    p_max: float = 0.98
    robot_radius_m: float = 0.0
    memory_mb: float = 24.0
    max_cells: int = 64_000_000


class LayerBuilder:
    """Grids that grow with the readings put into them; each is seen once and not kept."""

    def __init__(self, settings: LayerSettings) -> None:
        self._settings = settings
        self._tiles: dict[str, EvidenceTiles] = {}
        self._seen: set[tuple[str, float, bytes]] = set()

    def add(self, reading: Reading, T_map_base: Pose) -> bool:
        """Add one keyframe's scan or depth image; False where it was added before.

        Parameters
        ----------
        reading
            Known by its sensor, stamp and pose: the clocks of two logs in one map may agree.
        T_map_base
            The robot when the reading was taken; the map's z = 0 is the floor.

        Raises
        ------
        ScanweaveError
            If the pose is not finite or too far away, the map would be far too large, or a frame does not
            tell where its camera sits; the map is as it was then.
        """
        if not (np.abs(T_map_base.matrix()) < _MAX_POSITION_M).all():
            raise ScanweaveError(f"cannot map the reading at {reading.stamp_s:.6f} s: its pose is lost")
        under = planar(T_map_base)
        key = (reading.sensor, reading.stamp_s, row_from_pose2(under).tobytes())
        if key in self._seen:
            return False
        settings = self._settings
        footprint = footprint_board(under, settings.robot_radius_m, settings.resolution_m)
        for name, board in self._boards(reading, T_map_base):
            self._check_room(board.box())
            heights = board.steps.shape[2] if board.steps.ndim == 3 else 1
            tiles = self._tiles.setdefault(name, EvidenceTiles(settings.memory_mb, heights))
            tiles.add(board)
            if footprint is not None:
                tiles.add(footprint)
        self._seen.add(key)
        return True

    def grid(self, name: str) -> OccupancyGrid | None:
        """The grid of ``lidar`` or ``depth`` so far, clamped; None if it told nothing.

        Where it would have too many cells, they are larger, by a whole number.
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
        """Put back into the steps of a box what head-on beams say of panes, and all beams together refute.

        To head-on beams they are twice as likely there as not. They are few, and kept by their numbers.
        """
        row, col, rows, cols = box
        numbers, values = [np.zeros(0, np.intp)], [np.zeros(0, np.int16)]
        for first in range(0, rows, SIDE):
            part = steps[first : first + SIDE]
            panes = self._tiles["head on"].clipped((row + first, col, len(part), cols), low, high)
            held = np.flatnonzero((panes > math.log(2.0) * bayes.STEPS_A_UNIT) & (part < 0))
            numbers.append(held + first * cols)
            values.append(panes.ravel()[held])
        held = np.concatenate(numbers)
        straight = in_straight_runs(held, (rows, cols), self._settings.resolution_m)
        steps.ravel()[held[straight]] = np.concatenate(values)[straight]

    def _boards(self, reading: Reading, T_map_base: Pose) -> Iterator[tuple[str, Board]]:
        """What the reading says, by layer; of a scan also what its head-on beams alone say."""
        settings = self._settings
        if isinstance(reading, LaserScan):
            cell_m, model = settings.resolution_m, settings.lidar
            for name, scan in (("lidar", reading), ("head on", head_on(reading, model.noise, cell_m))):
                yield name, lidar_board(scan, planar(T_map_base), model, cell_m)
            return
        if reading.T_base_camera is None:
            raise ScanweaveError(
                f"camera {reading.sensor} does not tell where it sits on the robot; give its mount"
            )
        T_map_camera = spatial(T_map_base).compose(reading.T_base_camera)  # Yang2021 Eq. (15)-(16)
        matrix = np.asarray(T_map_camera.matrix())
        board = depth_board(reading, matrix, settings.depth, settings.resolution_m)
        if board is not None:
            yield "depth", board

    def _check_room(self, box: Box) -> None:
        """Refuse to grow to what only a lost pose can mean."""
        rows, cols = self._extent(box)[2:]
        if rows * cols > _MOST_CELLS_IN_ONE * self._settings.max_cells:
            raise ScanweaveError(
                f"the map would have {rows} x {cols} cells of {self._settings.resolution_m:g} m, the limit "
                f"is {_MOST_CELLS_IN_ONE} x {self._settings.max_cells}: choose a coarser resolution, or look "
                "for a lost pose"
            )

    def _extent(self, *boxes: Box) -> Box:
        """What holds all layers so far, and other boxes."""
        used = [tiles.used for tiles in self._tiles.values() if tiles.used is not None]
        return reduce(union, [*used, *boxes])
