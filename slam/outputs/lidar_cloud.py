"""The cloud of a 3D lidar's map without what only passed by, with its ground."""

from __future__ import annotations

import numpy as np

from slam.config import Config
from slam.mapping.cloud_map import map_cloud
from slam.mapping.cloud_passers_by import passed_by
from slam.mapping.elevation import Elevation
from slam.measurements import spatial
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
        stays = map_cloud(clouds, poses, cell_m)
        return LidarCloud(stays, np.zeros(len(stays.points_map), np.bool_), None)
    reach_m = config.cloud_odometry.range_max_m
    passed = passed_by(clouds, poses, found.T_base_lidar, ground, reach_m)
    stays, gone = (map_cloud(passed.parts(clouds, poses, gone=one), poses, cell_m) for one in (False, True))
    above_m = np.abs(ground.above_m(stays.points_map.astype(np.float64)))
    # Where no ground was seen, its height is a guess.
    is_ground = (above_m < 0.5 * passed.voxel_m) & ground.seen_at(stays.points_map)
    return LidarCloud(stays, is_ground, gone if len(gone.points_map) else None)
