"""The walls of a map as localisation needs them, read-only.

Those of a grid map are the boundaries of its free space, each side of a wall facing its own room.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property, lru_cache

import numpy as np
from scipy import ndimage

from fusion.estimation import TINY
from slam.config import Config
from slam.errors import MapFileError
from slam.localization.beam_check import END_M, KnownSpace, known_space
from slam.localization.beams import WALL, follow
from slam.localization.scan_view import ScanView
from slam.localization.whole_map_field import BLUR, WholeMapField, build_whole_map_field
from slam.mapping.occupancy_grid import FREE, OCCUPIED, OccupancyGrid, looked_up
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.planar import between, transform_points
from slam.matching.scan_points import ScanPoints
from slam.measurements import BoolArray, Float32Array, FloatArray, Pose, pose2_from_row, row_from_pose2
from slam.storage.map_contents import MapContents

# Side of a tile of the map, and how far from its middle the keyframes are that make it.
_TILE_M, _TILE_REACH_M = 4.0, 10.0


def has_walls(known: MapContents) -> bool:
    """Whether a planar scan, or the plan of a cloud, can be matched to a map."""
    drawn = not len(known.node_poses)
    return known.grid is not None and (drawn or any(scan is not None for scan in known.keyframe_scans))


class Walls:
    """The walls of a map in several forms, each computed once when it is first needed.

    They are those that its keyframes have seen; of a map that is nothing but a grid, those that it draws.

    Raises
    ------
    MapFileError
        If the map holds no scan.
    """

    def __init__(self, known_map: MapContents, config: Config) -> None:
        if not has_walls(known_map):
            raise MapFileError("the map contains no lidar scan: a scan cannot be localised in it")
        self.map = known_map
        self._config = config
        self._tile = lru_cache(maxsize=48)(self._made)
        self._poses = known_map.keyframe_poses.reshape(-1, 3)
        self._views = {
            key: ScanView.of(scan, config)
            for key, scan in enumerate(known_map.keyframe_scans)
            if scan is not None
        }
        # A drawing has no keyframes to be near: a tile of it is all that a scan can reach from there.
        self._tile_m = config.scan.range_max_m if self._drawn else _TILE_M

    @cached_property
    def _drawn(self) -> OrientedPoints | None:
        """The walls of a map that is a grid alone."""
        return None if len(self.map.node_poses) else drawn_walls(self.grid)

    @cached_property
    def grid(self) -> OccupancyGrid:
        """The occupancy grid."""
        assert self.map.grid is not None
        return self.map.grid

    def tile(self, pose: FloatArray) -> LocalMap:
        """The local map around a pose (3,), to match to: without points far from every keyframe."""
        return self._tile(math.floor(pose[0] / self._tile_m), math.floor(pose[1] / self._tile_m))

    def _made(self, column: int, row: int) -> LocalMap:
        """A tile, of the keyframes near its middle: what is seen from there, as it was seen."""
        middle = (np.array([column, row]) + 0.5) * self._tile_m
        if self._drawn is not None:
            in_tile = np.abs(self._drawn.points - middle).max(axis=1, initial=0.0) <= 1.5 * self._tile_m
            return LocalMap.build([self._drawn.only(in_tile)], self._config.match)
        in_tile = np.hypot(*(self._poses[:, :2] - middle).T) <= _TILE_REACH_M
        parts = [view.oriented.moved(self._poses[k]) for k, view in self._views.items() if in_tile[k]]
        return LocalMap.build(parts or [OrientedPoints.none()], self._config.match)

    @cached_property
    def space(self) -> KnownSpace:
        """Walls and free space for following beams."""
        return known_space(self.grid)

    @cached_property
    def field(self) -> WholeMapField:
        """The whole map for the global search."""
        placed = [self._standing(view, self._poses[k])[0] for k, view in self._views.items()]
        if self._drawn is not None:
            placed = [self._drawn.points.astype(np.float64)]
        return build_whole_map_field(np.concatenate(placed), self.grid, self._config.match.cell_m)

    def view(self, key: int) -> ScanView | None:
        """What stood of what a keyframe of the map saw, without people; None if it has no scan."""
        view = self._views.get(key)
        return None if view is None else view.only(self._standing(view, self._poses[key])[1])

    def sampled(self, count: int) -> Iterator[tuple[Pose, ScanView]]:
        """Keyframes evenly from the whole path, ``T_map_base`` and the view of each; all if there are fewer.

        Of a map that is a grid alone, what would be seen from so many of its free places.
        """
        if self._drawn is not None:
            yield from drawn_views(self._drawn, self.space, self._config.scan.range_max_m, count)
        keys = list(self._views)
        for key in keys if len(keys) <= count else [keys[n * len(keys) // count] for n in range(count)]:
            yield pose2_from_row(self._poses[key]), self._views[key]

    @cached_property
    def _free(self) -> BoolArray:
        """Free cells of the grid."""
        return np.asarray(self.grid.states() == FREE)

    def _standing(self, view: ScanView, pose: FloatArray) -> tuple[FloatArray, BoolArray]:
        """A keyframe's points in the map, less those where other scans saw free space (people); and which."""
        placed = transform_points(view.points.points_base, pose)
        stands = ~looked_up(self._free, self.grid.cells_of(placed), outside=True)
        return placed[stands], stands


def drawn_walls(grid: OccupancyGrid) -> OrientedPoints:
    """Return a point at the centre of each wall cell for every free side, map frame.

    Normals point away from the occupied cells around the free cell, as seen by a scan from there. A wall of
    one cell between two rooms has both.
    """
    states = grid.states()
    wall = states == OCCUPIED
    # Wide enough to smooth the steps of a slanted wall.
    filled = np.pad(ndimage.gaussian_filter(wall.astype(np.float32), BLUR, mode="nearest"), 1, "edge")
    walls, free = np.pad(wall, 1), np.pad(states == FREE, 1)
    slope_y, slope_x = (np.gradient(filled, axis=axis) for axis in (0, 1))
    cells, normals = list[Float32Array](), list[Float32Array]()
    for row, column in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        free_cells = np.argwhere(free & np.roll(walls, (-row, -column), (0, 1)))
        gradient = -np.column_stack([slope_x[tuple(free_cells.T)], slope_y[tuple(free_cells.T)]])
        length = np.hypot(*gradient.T)
        sided = length > TINY
        normals.append(gradient[sided] / length[sided, None])
        cells.append(np.asarray(free_cells[sided] + (row, column), np.float32)[:, ::-1])
    middles = (np.concatenate(cells) - np.float32(0.5)) * np.float32(grid.resolution_m)
    corner = row_from_pose2(grid.T_map_grid)
    turned = transform_points(np.concatenate(normals), np.array([0.0, 0.0, corner[2]]))
    return OrientedPoints(
        transform_points(middles, corner).astype(np.float32), np.asarray(turned, np.float32)
    )


def drawn_views(
    drawn: OrientedPoints, space: KnownSpace, reach_m: float, count: int
) -> Iterator[tuple[Pose, ScanView]]:
    """Return virtual 360 degree scans from so many places of free space, with ``T_map_base``."""
    clear = np.argwhere(space.clear) + 0.5
    in_cells = transform_points(drawn.points, between(space.frame, np.zeros(3))) / space.cell_m
    for cell in clear[np.arange(count) * len(clear) // count] if len(clear) else ():
        place = np.array([*transform_points(cell[None] * space.cell_m, space.frame)[0], 0.0])
        offsets = drawn.points - place[:2]
        faces = (np.hypot(*offsets.T) < reach_m) & (np.einsum("ij,ij->i", offsets, drawn.normals) < 0.0)
        ends = np.column_stack([in_cells, np.full(len(drawn), 0.5)])[faces]
        first_hits = follow(space.cells, np.array([*cell, 0.5]), ends, END_M / space.cell_m)
        on_wall = np.flatnonzero(faces)[first_hits != WALL]
        points = ScanPoints(offsets[on_wall].astype(np.float32), drawn.normals[on_wall])
        yield pose2_from_row(place), ScanView(0.0, points, OrientedPoints.from_scan(points), np.zeros(2))
