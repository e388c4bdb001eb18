"""What localisation needs of a map, read-only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slam.config import Config
from slam.errors import MapFileError
from slam.localization.beam_check import KnownSpace, known_space
from slam.localization.map_tiles import MapTiles
from slam.localization.whole_map_field import WholeMapField, build_whole_map_field
from slam.map_result import MapResult
from slam.mapping.occupancy_grid import FREE, OccupancyGrid
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import transform_points
from slam.matching.scan_points import ScanPoints, extract_points
from slam.measurements import FloatArray, LaserScan


@dataclass(frozen=True)
class KnownMap:
    """An optimised map.

    Attributes
    ----------
    keyframe_poses
        (K, 3) x, y, yaw in the map frame.
    keyframe_scans
        The scan of each keyframe; None where it has none.
    grid
        The occupancy grid; None of a map without a lidar.
    """

    keyframe_poses: FloatArray
    keyframe_scans: Sequence[LaserScan | None]
    grid: OccupancyGrid | None

    @classmethod
    def of_result(cls, result: MapResult) -> KnownMap:
        """The map that a run has just made."""
        return cls(result.keyframe_poses, result.keyframe_scans, result.grid)

    @property
    def has_walls(self) -> bool:
        """Whether a scan can be matched to it."""
        return self.grid is not None and any(scan is not None for scan in self.keyframe_scans)


class Walls:
    """The walls of a map in the forms in which they are asked for, each made once.

    Raises
    ------
    MapFileError
        Where the map holds no scan.
    """

    def __init__(self, known_map: KnownMap, config: Config) -> None:
        if not known_map.has_walls:
            raise MapFileError("the map holds no lidar scan: a scan cannot be localised in it")
        self._map = known_map
        self._config = config
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

    @cached_property
    def grid(self) -> OccupancyGrid:
        """The occupancy grid."""
        assert self._map.grid is not None
        return self._map.grid

    @cached_property
    def tiles(self) -> MapTiles:
        """Local maps to match to."""
        scans = [OrientedPoints.from_scan(points) for points in self._scans]
        return MapTiles(self._poses, scans, self._config.localization, self._config.match)

    @cached_property
    def space(self) -> KnownSpace:
        """Walls and free space for following beams."""
        return known_space(self.grid)

    @cached_property
    def field(self) -> WholeMapField:
        """The whole map for the global search."""
        settings = self._config.localization
        points = np.concatenate(
            [self._standing(points, pose) for points, pose in zip(self._scans, self._poses, strict=True)]
        )
        return build_whole_map_field(
            points, self.grid, settings.field_cell_m, settings.field_sigma_m, settings.unknown_likelihood
        )

    def _standing(self, points: ScanPoints, pose: FloatArray) -> FloatArray:
        """Points of a keyframe in the map, but for those where other scans saw free space: people."""
        placed = transform_points(points.points_base, pose)
        cells = self.grid.cells_of(placed)
        inside = ((cells >= 0) & (cells < self.grid.log_odds.shape)).all(axis=1)
        placed, cells = placed[inside], cells[inside]
        return placed[self.grid.states()[cells[:, 0], cells[:, 1]] != FREE]
