"""Cloud of a 3D lidar's map without moving objects, with its ground."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from slam.config import Config
from slam.heap import give_back
from slam.mapping.cloud_map import CloudTiles
from slam.mapping.cloud_passers_by import passed_by
from slam.mapping.elevation import Elevation
from slam.measurements import BoolArray, Float32Array, spatial
from slam.storage.lidar_cloud_files import LidarCloud
from slam.storage.map_contents import MapContents


@contextmanager
def lidar_cloud(contents: MapContents, config: Config, ground: Elevation | None) -> Iterator[LidarCloud]:
    """The cloud of a map that has clouds, as long as it is used.

    Parameters
    ----------
    ground
        Of the map; if it is unknown, no moved object can be found, and all points stay.

    Raises
    ------
    ScanweaveError
        If a pose is not finite.
    """
    poses = [spatial(pose) for pose in contents.node_poses]
    clouds = contents.clouds
    assert clouds is not None
    with tempfile.TemporaryFile(prefix="scanweave-cloud-") as file:
        rows = (clouds.rows(key) for key in range(len(clouds)))
        tiles = CloudTiles(rows, poses, config.grid.resolution_m, file)
        give_back()
        if ground is None:
            yield LidarCloud(tiles.cloud(), lambda points: np.zeros(len(points), np.bool_), None)
            return
        reach_m = config.cloud_odometry.range_max_m
        passed = passed_by(tiles.points(), tiles.seen(), poses, contents.T_base_lidar, ground, reach_m)
        give_back()

        def is_ground(points: Float32Array) -> BoolArray:
            above_m = np.abs(ground.above_m(points.astype(np.float64)))
            # Where no ground was seen, its height is a guess.
            return np.asarray((above_m < 0.5 * passed.voxel_m) & ground.seen_at(points))

        removed = tiles.cloud(passed.holds) if len(passed.keys) else None
        yield LidarCloud(tiles.cloud(lambda points: ~passed.holds(points)), is_ground, removed)
