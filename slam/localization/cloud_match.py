"""A cloud against a known map: aligned to its planes, and its beams weighed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.config import Config
from slam.localization.cloud_places import CloudPlaces
from slam.localization.cloud_space import judge_beams
from slam.localization.known_clouds import CloudTiles, KnownClouds
from slam.matching.cloud_points import thinned
from slam.matching.local_cloud import moved
from slam.measurements import FloatArray, MotionEstimate, PointCloud

# Shares of explained, in-free and crossing beams at true poses, and at wrong ones that fit best.
_EXPLAINED_NATS = math.log(0.40 / 0.22)
_IN_FREE_NATS = math.log(0.01 / 0.10)
_CROSSING_NATS = math.log(0.045 / 0.15)


@dataclass(frozen=True, slots=True)
class CloudView:
    """One cloud, prepared once.

    Attributes
    ----------
    stamp_s
        Time of the cloud.
    points
        (N, 3) thinned to the map's voxels, base frame.
    lidar
        (3,) where the beams begin, base frame.
    """

    stamp_s: float
    points: FloatArray
    lidar: FloatArray


class CloudMatcher:
    """Matches clouds to a map; stateless but for the tiles that it keeps."""

    def __init__(self, known: KnownClouds, config: Config) -> None:
        self._tiles = CloudTiles(known, config)
        self._settings, self._general = config.cloud_localization, config.localization
        self.voxel_m = self._tiles.voxel_m
        self._places = CloudPlaces(known, self.voxel_m, self._settings)

    def view(self, cloud: PointCloud, points: FloatArray) -> CloudView:
        """Prepare the deskewed points (N, 3), base frame, of a cloud."""
        lidar = np.asarray(cloud.T_base_lidar.translation())
        return CloudView(cloud.stamp_s, thinned(points, self.voxel_m), lidar)

    def align(self, view: CloudView, guess: gtsam.Pose3) -> MotionEstimate | None:
        """``T_map_base`` from a guess nearby; None where nothing fits."""
        tile = self._tiles.around(guess)
        aligned = None if tile is None else tile.local.align(view.points, guess)
        return None if aligned is None else aligned.motion

    def search(self, view: CloudView) -> list[gtsam.Pose3]:
        """``T_map_base`` of places that look alike and fit, each arrived at from afar."""
        found = []
        for guess in self._places.propose(view.points):
            tile = self._tiles.around(guess)
            reach_m = self._settings.arrive_voxels * self.voxel_m
            aligned = None if tile is None else tile.local.align(view.points, guess, reach_m)
            if aligned is not None and aligned.motion.inlier_share >= self._general.least_inlier_share:
                found.append(aligned.found.pose)
        return found

    def weigh(self, pose: gtsam.Pose3, view: CloudView, points: FloatArray) -> float:
        """Evidence for ``T_map_base`` over the best of the wrong poses, nats.

        The beams of a column, one over the other, count as one: walls are upright.

        Parameters
        ----------
        points
            (N, 3) of the view, base frame, one a cell of a surface.
        """
        tile = self._tiles.around(pose)
        if tile is None or not len(points):
            return 0.0
        lidar = np.asarray(pose.transformFrom(view.lidar))
        reach_m = self._settings.on_plane_voxels * self.voxel_m
        verdicts = judge_beams(tile.space, tile.local.planes, lidar, moved(points, pose), reach_m)
        said = verdicts.explained | verdicts.in_free | verdicts.crossing
        if not said.any():
            return 0.0
        nats = (
            _EXPLAINED_NATS * float(verdicts.explained.sum())
            + _IN_FREE_NATS * float(verdicts.in_free.sum())
            + _CROSSING_NATS * float(verdicts.crossing.sum())
        )
        columns = np.unique(np.floor(points[said, :2] / self._general.news_cell_m).astype(np.int64), axis=0)
        return nats / float(said.sum()) * len(columns) / self._general.correlated_cells
