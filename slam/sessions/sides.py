"""One side of a join: the path along which a map was made, and the recognition of another path in it.

One joiner serves scans on a floor, clouds, and frames of a camera: each provides its localisation sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.config import Config
from slam.edits.keyframes import bases_of
from slam.localization.camera_sensor import CameraSensor
from slam.localization.cloud_sensor import CloudSensor, CloudView
from slam.localization.known_map import Walls, has_walls
from slam.localization.planar_sensor import PlanarSensor
from slam.localization.sensor import Sensor
from slam.localization.visual_locator import VisualLocator
from slam.mapper.keyframe_store import KeyframeStore
from slam.matching.cloud_points import voxel_of
from slam.measurements import FloatArray, Pose
from slam.storage.map_contents import MapContents


@dataclass(frozen=True, slots=True)
class Side:
    """One of the two maps of a join.

    Attributes
    ----------
    bases
        K poses of the robot at the keyframes, each in its map.
    path_m
        (K,) path length to each.
    view
        The static part of a keyframe's reading, for the other side's sensor; None if it saw nothing.
    sensor
        Creates the sensor that recognises readings of the other side; it needs much memory.
    """

    bases: Sequence[Pose]
    path_m: FloatArray
    view: Callable[[int], Any]
    sensor: Callable[[], Sensor[Any, Any]]

    @classmethod
    def of_walls(cls, walls: Walls, config: Config) -> Side:
        """Create a side from a map of a floor."""
        return cls(walls.map.node_poses, walls.map.path_m, walls.view, lambda: PlanarSensor(walls, config))

    @classmethod
    def of_clouds(cls, known: MapContents, config: Config) -> Side:
        """Create a side from a map of a 3D lidar."""
        assert known.clouds is not None
        clouds, voxel_m = known.clouds, voxel_of(known.clouds.points(0), config.cloud_odometry)

        def sensor() -> CloudSensor:
            return CloudSensor(known, Walls(known, config).field if has_walls(known) else None, config)

        def view(key: int) -> CloudView:
            return CloudView.of(clouds.points(key), clouds.T_base_lidar(key), voxel_m)

        return cls(known.node_poses, known.path_m, view, sensor)

    @classmethod
    def of_frames(cls, known: MapContents, other: MapContents, config: Config) -> Side:
        """Create a side from a map of a camera in 3D, to which frames of the other are matched."""
        assert known.frames is not None and other.frames is not None
        locator = VisualLocator(known, config)
        seen, shown = (
            KeyframeStore(config.rgbd, config.match.local_map_keyframes, one.frames) for one in (known, other)
        )
        locator.view(shown.keyframe(0))  # it contains the camera pose of the other map
        return cls(
            bases_of(known, known.node_poses),
            known.path_m,
            seen.keyframe,
            lambda: CameraSensor(locator, config),
        )

    def nearest(self, pose: Pose) -> int:
        """Return the keyframe nearest to a pose in the map."""
        offsets = np.array([base.translation() for base in self.bases]) - pose.translation()
        return int(np.linalg.norm(offsets, axis=1).argmin())


def sides_of(known: MapContents, session: MapContents, config: Config) -> tuple[Side, Side]:
    """Return the sides of two maps of the same kind."""
    if known.clouds is not None:
        return Side.of_clouds(known, config), Side.of_clouds(session, config)
    if known.planar:
        return tuple(Side.of_walls(Walls(side, config), config) for side in (known, session))  # type: ignore[return-value]
    return Side.of_frames(known, session, config), Side.of_frames(session, known, config)
