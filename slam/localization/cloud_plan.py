"""Where in the plan of a map of clouds a scan may have been taken: everywhere is looked, by what stands up.

Scan contexts know only places near the mapped way. A room that looks the same from its other half must not be
found there and nowhere else, so the plan has its say as well; it tells no height, which the keyframes do.
"""

from __future__ import annotations

import gtsam
import numpy as np

from fusion.height_band import HeightBand
from slam.config import Config
from slam.localization.global_search import search_everywhere
from slam.localization.known_clouds import KnownClouds
from slam.localization.scan_view import first_in_cells
from slam.localization.whole_map_field import WholeMapField
from slam.mapping.band_scan import band_scan, ground_of
from slam.matching.scan_points import extract_points
from slam.measurements import FloatArray


class CloudPlan:
    """The plan of a map, searched for the plan of a scan.

    Parameters
    ----------
    field
        Of the map's plan.
    known
        The clouds that the plan was made of.
    voxel_m
        Side of their voxels.
    """

    def __init__(self, field: WholeMapField, known: KnownClouds, voxel_m: float, config: Config) -> None:
        self._field, self._config = field, config
        self._T_base_lidar = known.T_base_lidar
        clouds = (known.clouds.points(key) for key in range(len(known.clouds)))
        ground = ground_of(clouds, known.T_base_lidar, voxel_m, config.cloud_odometry.thickness_m)
        self._ground_m = None if ground is None else ground.height_m
        self._positions = np.array([pose.translation() for pose in known.poses])

    def propose(self, points: FloatArray) -> list[gtsam.Pose3]:
        """``T_map_base`` of places with the plan of a thinned scan (N, 3), base frame; the best first."""
        seen = self._flat(points)
        if not len(seen):
            return []
        settings = self._config.localization
        places = search_everywhere(
            self._field,
            seen[:: max(1, -(-len(seen) // settings.search_points))],
            settings.search_least_score,
            settings.search_keep_share,
            self._config.cloud_localization.looks,
            settings.search_threads,
        )
        return [self._lifted(place.pose) for place in places]

    def _flat(self, points: FloatArray) -> FloatArray:
        """(M, 2) what a flat lidar would see of a scan, one point a cell."""
        layers = self._config.layers
        if self._ground_m is None or layers.climb_m >= layers.robot_height_m:
            return np.zeros((0, 2))
        band = HeightBand(0.0, layers.robot_height_m, layers.climb_m)
        # A thinned scan has no second point in a cell.
        config = self._config.cloud_map.model_copy(update={"least_points": 1})
        scan, limits = (
            band_scan(points, 0.0, self._T_base_lidar, band, self._ground_m, config),
            self._config.scan,
        )
        flat = extract_points(scan, limits.range_min_m, limits.range_max_m, limits.neighbours).points_base
        return np.asarray(flat[first_in_cells(flat, self._config.localization.news_cell_m)[0]], np.float64)

    def _lifted(self, pose: FloatArray) -> gtsam.Pose3:
        """A pose (3,) of the plan at the height of the nearest keyframe."""
        nearest = int(np.hypot(*(self._positions[:, :2] - pose[:2]).T).argmin())
        at = np.array([pose[0], pose[1], self._positions[nearest, 2]])
        return gtsam.Pose3(gtsam.Rot3.Yaw(float(pose[2])), at)
