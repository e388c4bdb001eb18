"""A cloud against a known map: aligned to its planes, and its beams weighed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

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
_EXPLAINED_NATS = math.log(0.40 / 0.20)
_IN_FREE_NATS = math.log(0.01 / 0.06)
_CROSSING_NATS = math.log(0.03 / 0.18)


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
        """``T_map_base`` from a guess nearby; None where too little of the cloud fits."""
        tile = self._tiles.around(guess)
        if tile is None:
            return None
        lidar = np.asarray(guess.transformFrom(view.lidar))
        strange = tile.planes.judge(lidar, moved(view.points, guess), 0.0).strange
        aligned = tile.local.align(view.points[~strange], guess)
        if aligned is None or aligned.motion.inlier_share < self._general.least_inlier_share:
            return None
        agreement = aligned.found.agreement * float(np.mean(~strange)) / max(tile.agreement, 1e-3)
        if agreement < self._settings.least_agreement:
            return None
        # Where only a part is known, that part is seen at its edges.
        doubt = 1.0 / min(agreement, 1.0) ** 2
        return replace(aligned.motion, covariance=doubt * aligned.motion.covariance)

    def search(self, view: CloudView) -> list[gtsam.Pose3]:
        """``T_map_base`` of places that look alike and fit, each arrived at from afar."""
        settings, wide_m = self._settings, self._settings.coarseness * self.voxel_m
        scan = thinned(view.points, wide_m)
        arrived: list[tuple[float, gtsam.Pose3]] = []
        for guess in self._places.propose(view.points):
            tile = self._tiles.around(guess)
            if tile is None:
                continue
            aligned = tile.coarse.align(scan, guess, settings.arrive_voxels * self.voxel_m)
            if aligned is not None:
                arrived.append((aligned.found.agreement, aligned.found.pose))
        arrived.sort(key=lambda place: -place[0])
        motions = (self.align(view, pose) for _, pose in arrived[: settings.refined])
        return [
            m.T_reference_base
            for m in motions
            if m is not None and isinstance(m.T_reference_base, gtsam.Pose3)
        ]

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
        verdicts = judge_beams(tile.space, tile.planes, lidar, moved(points, pose), reach_m)
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
