"""The cloud of a 3D lidar's map without what only passed by, with its ground."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from slam.config import Config
from slam.mapping.cloud_map import map_cloud
from slam.mapping.cloud_passers_by import passed_by
from slam.mapping.dense_map import ColoredCloud
from slam.mapping.elevation import Elevation
from slam.measurements import BoolArray, Float32Array, spatial
from slam.storage.lidar_cloud_files import LidarCloud
from slam.storage.map_contents import MapContents


def lidar_cloud(found: MapContents, config: Config, ground: Elevation | None) -> LidarCloud:
    """The cloud of a map that has clouds.

    Parameters
    ----------
    ground
        Of the map; where it is not known, nothing tells what stands on it, and all stays.

    Raises
    ------
    ScanweaveError
        Where a pose is not finite.
    """
    poses, cell_m = [spatial(pose) for pose in found.node_poses], config.grid.resolution_m
    clouds = found.clouds
    assert clouds is not None
    if ground is None:
        stays = _Parts(lambda: map_cloud(clouds, poses, cell_m))
        return LidarCloud(stays, lambda points: np.zeros(len(points), np.bool_), None)
    reach_m = config.cloud_odometry.range_max_m
    passed = passed_by(clouds, poses, found.T_base_lidar, ground, reach_m)
    stays, gone = (
        _Parts(lambda one=one: map_cloud(passed.parts(clouds, poses, gone=one), poses, cell_m))  # type: ignore[misc]
        for one in (False, True)
    )

    def is_ground(points: Float32Array) -> BoolArray:
        above_m = np.abs(ground.above_m(points.astype(np.float64)))
        # Where no ground was seen, its height is a guess.
        return np.asarray((above_m < 0.5 * passed.voxel_m) & ground.seen_at(points))

    return LidarCloud(stays, is_ground, gone if len(passed.keys) else None)


@dataclass(frozen=True, slots=True)
class _Parts:
    """Parts of a cloud, made anew each time that they are asked for."""

    make: Callable[[], Iterator[ColoredCloud]]

    def __iter__(self) -> Iterator[ColoredCloud]:
        return self.make()
