"""The walls of a map as localisation needs them, read-only."""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np

from slam.config import Config
from slam.errors import MapFileError
from slam.localization.beam_check import KnownSpace, known_space
from slam.localization.beams import looked_up
from slam.localization.scan_view import ScanView
from slam.localization.whole_map_field import WholeMapField, build_whole_map_field
from slam.mapping.occupancy_grid import FREE, OccupancyGrid
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.planar import transform_points
from slam.matching.scan_points import ScanPoints, extract_points
from slam.measurements import BoolArray, FloatArray
from slam.storage.map_contents import MapContents

# Side of a tile of the map, and how far from its middle the keyframes are that make it.
_TILE_M, _TILE_REACH_M = 4.0, 10.0


def has_walls(known: MapContents) -> bool:
    """Whether a planar scan, or the plan of a cloud, can be matched to a map."""
    return known.grid is not None and any(scan is not None for scan in known.keyframe_scans)


class Walls:
    """The walls of a map in the forms in which they are asked for, each made once.

    Raises
    ------
    MapFileError
        Where the map holds no scan.
    """

    def __init__(self, known_map: MapContents, config: Config) -> None:
        if not has_walls(known_map):
            raise MapFileError("the map holds no lidar scan: a scan cannot be localised in it")
        self.map = known_map
        self._config = config
        self._tile = lru_cache(config.localization.tiles_cached)(self._made)
        settings = config.scan
        self._poses = np.array(
            [
                pose
                for pose, scan in zip(known_map.keyframe_poses, known_map.keyframe_scans, strict=True)
                if scan is not None
            ]
        )
        self._scans = [
            extract_points(scan, settings.range_min_m, settings.range_max_m, settings.neighbours)
            for scan in known_map.keyframe_scans
            if scan is not None
        ]
        self._oriented = [OrientedPoints.from_scan(points) for points in self._scans]

    @cached_property
    def grid(self) -> OccupancyGrid:
        """The occupancy grid."""
        assert self.map.grid is not None
        return self.map.grid

    def tile(self, pose: FloatArray) -> LocalMap:
        """The local map around a pose (3,), to match to: without points far from every keyframe."""
        return self._tile(math.floor(pose[0] / _TILE_M), math.floor(pose[1] / _TILE_M))

    def _made(self, column: int, row: int) -> LocalMap:
        """A tile, of the keyframes near its middle: what is seen from there, as it was seen."""
        middle = (np.array([column, row]) + 0.5) * _TILE_M
        near = np.hypot(*(self._poses[:, :2] - middle).T) <= _TILE_REACH_M
        parts = [self._oriented[k].moved(self._poses[k]) for k in np.flatnonzero(near).tolist()]
        return LocalMap.build(parts or [OrientedPoints.none()], self._config.match)

    @cached_property
    def space(self) -> KnownSpace:
        """Walls and free space for following beams."""
        return known_space(self.grid)

    @cached_property
    def field(self) -> WholeMapField:
        """The whole map for the global search."""
        points = np.concatenate(
            [
                transform_points(points.points_base[self._standing(points, pose)], pose)
                for points, pose in zip(self._scans, self._poses, strict=True)
            ]
        )
        return build_whole_map_field(points, self.grid, self._config.localization.field_cell_m)

    def view(self, key: int) -> ScanView | None:
        """What stood of what a keyframe of the map saw, without people; None where it has no scan."""
        scan = self.map.keyframe_scans[key]
        if scan is None:
            return None
        view = ScanView.of(scan, self._config)
        return view.only(self._standing(view.points, self.map.keyframe_poses[key]))

    @cached_property
    def _free(self) -> BoolArray:
        """Free cells of the grid."""
        return np.asarray(self.grid.states() == FREE)

    def _standing(self, points: ScanPoints, pose: FloatArray) -> BoolArray:
        """Which points of a keyframe lie not where other scans saw free space, as those on people do."""
        placed = transform_points(points.points_base, pose)
        return ~looked_up(self._free, self.grid.cells_of(placed), outside=True)
