"""A cloud against a known map: aligned to its planes, and its beams weighed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam.config import Config
from slam.localization.cloud_places import CloudPlaces
from slam.localization.cloud_plan import CloudPlan
from slam.localization.cloud_space import judge_beams
from slam.localization.known_clouds import CloudTiles, KnownClouds
from slam.localization.scan_view import cell_keys
from slam.localization.whole_map_field import WholeMapField
from slam.matching.cloud_points import thinned
from slam.matching.local_cloud import Aligned, moved
from slam.measurements import FloatArray, MotionEstimate, PointCloud

# Shares of explained, in-free and crossing beams at true poses, and at wrong ones that fit best.
_EXPLAINED_NATS = math.log(0.40 / 0.20)
_IN_FREE_NATS = math.log(0.01 / 0.06)
_CROSSING_NATS = math.log(0.03 / 0.18)
# Beams that are followed: more tell the same.
_MOST_BEAMS = 6000


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

    def __init__(self, known: KnownClouds, field: WholeMapField | None, config: Config) -> None:
        self._tiles = CloudTiles(known, config)
        self._settings, self._general = config.cloud_localization, config.localization
        self.voxel_m = self._tiles.voxel_m
        self._places = CloudPlaces(known, self.voxel_m, self._settings)
        self._plan = None if field is None else CloudPlan(field, known, self.voxel_m, config)

    def view(self, cloud: PointCloud, points: FloatArray) -> CloudView:
        """Prepare the deskewed points (N, 3), base frame, of a cloud."""
        lidar = np.asarray(cloud.T_base_lidar.translation())
        return CloudView(cloud.stamp_s, thinned(points, self.voxel_m), lidar)

    def align(self, view: CloudView, guess: gtsam.Pose3) -> MotionEstimate | None:
        """``T_map_base`` from a guess nearby; None where too little of the cloud is known there."""
        aligned, agreement = self._aligned(view, guess)
        if aligned is None or aligned.motion.inlier_share < self._general.least_inlier_share:
            return None
        if agreement < self._settings.least_agreement:
            return None
        # Where only a part is known, that part is seen at its edges.
        doubt = 1.0 / min(agreement, 1.0) ** 2
        return replace(aligned.motion, covariance=doubt * aligned.motion.covariance)

    def search(self, view: CloudView) -> list[gtsam.Pose3]:
        """``T_map_base`` of places that look alike, by scan context or by plan, and fit best."""
        settings, wide_m = self._settings, self._settings.coarseness * self.voxel_m
        by_plan = [] if self._plan is None else self._plan.propose(view.points)
        scan = thinned(view.points, wide_m)
        arrived: list[tuple[float, gtsam.Pose3]] = []
        for guess in self._places.apart([*by_plan, *self._places.propose(view.points)]):
            tile = self._tiles.around(guess)
            if tile is None:
                continue
            aligned = tile.coarse.align(scan, guess, settings.arrive_voxels * self.voxel_m)
            pose = guess if aligned is None else aligned.found.pose
            arrived.append((self.weigh(pose, view), pose))
        arrived.sort(key=lambda place: -place[0])
        found = []
        for _, pose in arrived[: settings.refined]:
            exact, _ = self._aligned(view, pose)
            found.append(pose if exact is None else exact.found.pose)
        return found

    def _aligned(self, view: CloudView, guess: gtsam.Pose3) -> tuple[Aligned | None, float]:
        """An alignment, and what share of the cloud agrees, where that of the map's own clouds is 1."""
        tile = self._tiles.around(guess)
        if tile is None or not len(view.points):
            return None, 0.0
        lidar = np.asarray(guess.transformFrom(view.lidar))
        known = ~tile.planes.judge(lidar, moved(view.points, guess), 0.0).strange
        aligned = tile.local.refine(view.points[known], guess)
        share = 0.0 if aligned is None else aligned.found.agreement * float(np.mean(known))
        return aligned, share / max(tile.agreement, 1e-3)

    def weigh(self, pose: gtsam.Pose3, view: CloudView) -> float:
        """Evidence of a cloud for ``T_map_base`` over the best of the wrong poses, nats.

        The beams of a column, one over the other, count as one: walls are upright.
        """
        tile = self._tiles.around(pose)
        if tile is None or not len(view.points):
            return 0.0
        points = view.points[:: -(-len(view.points) // _MOST_BEAMS)]
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
        cells = np.floor(points[said, :2] / self._general.news_cell_m).astype(np.int64)
        columns = len(np.unique(cell_keys(cells)))
        return nats / float(said.sum()) * columns / self._general.correlated_cells
