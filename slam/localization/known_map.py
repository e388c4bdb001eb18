"""What localisation needs of a map, read-only."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import gtsam
import numpy as np

from slam.config import Config
from slam.errors import MapFileError
from slam.localization.beam_check import KnownSpace, known_space
from slam.localization.beams import looked_up
from slam.localization.known_clouds import KnownClouds
from slam.localization.whole_map_field import WholeMapField, build_whole_map_field
from slam.mapper.map_result import MapResult
from slam.mapping.occupancy_grid import FREE, OccupancyGrid
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.planar import transform_points
from slam.matching.scan_points import ScanPoints, extract_points
from slam.measurements import BoolArray, FloatArray, LaserScan
from slam.outputs.finished_map import Map
from slam.storage.map_clouds import MapClouds
from slam.storage.map_frames import MapFrames
from slam.vision.color_registration import ColorRegistration
from slam.vision.learned_camera import LearnedCamera

# Side of a tile of the map, and how far from its middle the keyframes are that make it.
_TILE_M, _TILE_REACH_M = 4.0, 10.0


@dataclass(frozen=True)
class KnownCameras:
    """The camera keyframes of a map.

    Attributes
    ----------
    frames
        Their images and features, read when they are asked for; each frame's mounting is what is known of
        the camera's place on the robot.
    poses
        ``T_map_camera`` of each.
    learned
        What the mapping run learned of cameras, by their names.
    """

    frames: MapFrames
    poses: Sequence[gtsam.Pose3]
    learned: Mapping[str, LearnedCamera] = field(default_factory=dict)

    @property
    def sensor(self) -> str:
        """Name of the camera."""
        return self.frames.frame(0).sensor

    @property
    def T_base_camera(self) -> gtsam.Pose3 | None:
        """Where the camera sits; None where it is its own base."""
        learned = self.learned.get(self.sensor)
        if learned is not None and learned.T_base_camera is not None:
            return learned.T_base_camera
        return self.frames.frame(0).T_base_camera

    @property
    def registrations(self) -> dict[str, ColorRegistration]:
        """Where colour cameras sit beside their depth cameras, as far as the mapping run has asked."""
        return {
            name: learned.registration
            for name, learned in self.learned.items()
            if learned.registration is not None
        }


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
    planar
        Whether the robot stays on a floor.
    cameras
        The camera keyframes; None where there are none.
    clouds
        The clouds of the keyframes; None where no 3D lidar made the map.
    """

    keyframe_poses: FloatArray
    keyframe_scans: Sequence[LaserScan | None]
    grid: OccupancyGrid | None
    planar: bool = True
    cameras: KnownCameras | None = None
    clouds: KnownClouds | None = None

    @classmethod
    def of_result(cls, result: MapResult) -> KnownMap:
        """The map that a run has just made."""
        dense = result.dense
        cameras = None
        if dense is not None and isinstance(dense.frames, MapFrames) and dense.poses:
            learned = {name: record.learned for name, record in result.cameras.items()}
            cameras = KnownCameras(dense.frames, dense.poses, learned)
        planar = isinstance(result.graph.pose(0), gtsam.Pose2)
        clouds, mapped = None, result.clouds
        if mapped is not None and isinstance(mapped.clouds, MapClouds):
            clouds = KnownClouds(mapped.clouds, mapped.poses, mapped.T_base_lidar)
        return cls(result.keyframe_poses, result.keyframe_scans, result.grid, planar, cameras, clouds)

    @classmethod
    def of_saved(cls, saved: Map) -> KnownMap:
        """A map in a file; its images and clouds are read when they are asked for."""
        cameras = None
        if len(saved.frames):
            cameras = KnownCameras(saved.frames, saved.frame_poses(), saved.contents.cameras)
        clouds = None
        if len(saved.clouds):
            bases = [pose for pose in saved.contents.node_poses if isinstance(pose, gtsam.Pose3)]
            clouds = KnownClouds(saved.clouds, bases, saved.clouds.T_base_lidar(0))
        return cls(saved.keyframe_poses, saved.keyframe_scans, saved.grid, saved.planar, cameras, clouds)

    @property
    def has_walls(self) -> bool:
        """Whether a planar scan, or the plan of a cloud, can be matched to it."""
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
        settings = self._config.localization
        free = self.grid.states() == FREE
        points = np.concatenate(
            [
                self._standing(points, pose, free)
                for points, pose in zip(self._scans, self._poses, strict=True)
            ]
        )
        return build_whole_map_field(points, self.grid, settings.field_cell_m)

    def _standing(self, points: ScanPoints, pose: FloatArray, free: BoolArray) -> FloatArray:
        """Points of a keyframe in the map, but for those where other scans saw free space: people."""
        placed = transform_points(points.points_base, pose)
        return placed[~looked_up(free, self.grid.cells_of(placed), outside=True)]
