"""Localise with a 3D lidar in a known map of clouds: align clouds to its planes, and weight their beams."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from fusion.height_band import thin_to_voxels
from slam.config import Config
from slam.estimates import MotionEstimate
from slam.localization.cloud_places import CloudPlaces
from slam.localization.cloud_space import BeamVerdicts, judge_beams
from slam.localization.known_clouds import COARSENESS, CloudTiles
from slam.localization.odometry import CloudOdometry
from slam.localization.poses import Measured
from slam.localization.scan_view import cell_keys
from slam.localization.sensor import Keyframe, Observation, moved_on
from slam.localization.whole_map_field import WholeMapField
from slam.matching.cloud_points import at_middle_of_turn
from slam.matching.local_cloud import REACH, Aligned, LocalCloud, moved
from slam.measurements import FloatArray, ImuReading, PointCloud, Pose, WheelOdometry, logarithm
from slam.storage.map_contents import MapContents

# Shares of explained, in-free and crossing beams at true poses, and at wrong ones that fit best: see
# tools/learn_match_likelihoods.py.
_EXPLAINED_NATS = math.log(0.40 / 0.20)
_IN_FREE_NATS = math.log(0.01 / 0.06)
_CROSSING_NATS = math.log(0.03 / 0.18)
# Number of traced beams: more add no information.
_MOST_BEAMS = 6000
# A point so near to a plane, in voxels, is explained by it.
_ON_PLANE = 0.5


@dataclass(frozen=True, slots=True)
class CloudView:
    """A prepared cloud.

    Attributes
    ----------
    points
        (N, 3) thinned to the map's voxels, base frame.
    lidar
        (3,) origin of the beams, base frame.
    novel_share
        Share of what it sees that is new after the earlier keyframes.
    """

    points: FloatArray
    lidar: FloatArray
    novel_share: float = 1.0

    @classmethod
    def of(cls, points: FloatArray, T_base_lidar: gtsam.Pose3, voxel_m: float) -> CloudView:
        """Prepare a whole cloud (N, 3), base frame."""
        return cls(thin_to_voxels(points, voxel_m), np.asarray(T_base_lidar.translation()))


class CloudSensor:
    """A `Sensor`; its only state is its odometry and cached map tiles.

    Parameters
    ----------
    known
        A map of a 3D lidar.
    field
        Likelihood field of its plan; None if it has none.
    """

    # Earlier keyframes cost time, and drift bends the path.
    weighs_back = 5
    least_keyframes = 3

    def __init__(self, known: MapContents, field: WholeMapField | None, config: Config) -> None:
        self._tiles, self._odometry = CloudTiles(known, config), CloudOdometry(config)
        self._config, self._general, self._settings = config, config.localization, config.cloud_localization
        self.voxel_m = self._tiles.voxel_m
        self._places = CloudPlaces(field, known, self.voxel_m, config)
        # From a place as near as that, a search leads to the same candidates.
        self.search_every_m = max(self._general.search_every_m, self._places.apart_m)
        self._stamp_s = -math.inf

    @property
    def unfit(self) -> str:
        """See `CloudOdometry`."""
        return self._odometry.unfit

    def observe(self, measurement: Any, known: Pose | None) -> Observation[CloudView] | None:
        """See `Sensor`; takes clouds, whose time is the middle of their revolution, wheels and IMU."""
        if isinstance(measurement, WheelOdometry):
            self._odometry.add_wheels(measurement)
        if isinstance(measurement, ImuReading):
            self._odometry.add_imu(measurement)
        if not isinstance(measurement, PointCloud):
            return None
        cloud = at_middle_of_turn(measurement, self._config.cloud_odometry)
        points, step = self._odometry.add(cloud)
        view = CloudView.of(points, cloud.T_base_lidar, self.voxel_m)
        elapsed_s, self._stamp_s = cloud.stamp_s - self._stamp_s, cloud.stamp_s
        late: FloatArray | float = 0.0
        if step.moved is not None and elapsed_s > 0.0:
            sigma_s = self._config.sensors.calibration.cloud_sigma_s
            late = logarithm(step.moved.pose) * sigma_s / elapsed_s
        return Observation(cloud.stamp_s, view, step.pose, step.moved, step.moved is None, late)

    def sees_new(self, view: CloudView, before: Pose | None, pose: Pose) -> bool:
        """See `Sensor`."""
        return len(view.points) > 0 and moved_on(before, pose, self._general)

    def novel(self, view: CloudView, pose: Pose, before: Sequence[Keyframe[CloudView]] | None) -> CloudView:
        """See `Sensor`."""
        return view if before is None else replace(view, novel_share=self._settings.new_share)

    def align(self, view: CloudView, guess: Pose) -> MotionEstimate | None:
        """See `Sensor`."""
        aligned, agreement = self._aligned(view, guess)
        # At least half as much of it is on known planes as of the map's own clouds.
        if aligned is None or agreement < 0.5:
            return None
        # If only a part is known, it is seen at its edges.
        doubt = 1.0 / min(agreement, 1.0) ** 2
        return replace(aligned.motion, covariance=doubt * aligned.motion.covariance)

    def weigh(self, pose: Pose, novel: CloudView, motion: MotionEstimate | None = None) -> float:
        """See `Sensor`. The beams of a vertical column count as one, since walls are upright."""
        points, verdicts = self.judged(pose, novel)
        informed = np.any(verdicts, axis=0)
        if not informed.any():
            return 0.0
        nats = float(np.array([_EXPLAINED_NATS, _IN_FREE_NATS, _CROSSING_NATS]) @ np.sum(verdicts, axis=1))
        cells = np.floor(points[informed, :2] / self._general.novel_cell_m).astype(np.int64)
        columns = len(np.unique(cell_keys(cells)))
        return novel.novel_share * nats / float(informed.sum()) * columns / self._general.correlated_cells

    def judged(self, pose: Pose, view: CloudView) -> tuple[FloatArray, BeamVerdicts]:
        """Return some points of a cloud, (N, 3), base frame, and how their beams judge ``T_map_base``."""
        assert isinstance(pose, gtsam.Pose3)
        points = view.points[:: max(1, -(-len(view.points) // _MOST_BEAMS))]
        tile = self._tiles.around(pose)
        if tile is None:
            return points, BeamVerdicts(*np.zeros((3, len(points)), np.bool_))
        lidar = np.asarray(pose.transformFrom(view.lidar))
        reach_m = _ON_PLANE * self.voxel_m
        return points, judge_beams(tile.space, tile.planes, lidar, moved(points, pose), reach_m)

    def propose(
        self, view: CloudView, keyframes: Sequence[Keyframe[CloudView]], within: Measured | None
    ) -> Iterator[gtsam.Pose3 | None]:
        """See `Sensor`: places that look similar by scan context or plan, and fit best.

        One reading makes at most one tile of the map here: it costs more than everything else.
        """
        scan = thin_to_voxels(view.points, COARSENESS * self.voxel_m)
        arrived: list[tuple[float, gtsam.Pose3, LocalCloud]] = []
        for guess in self._places.propose(view.points):
            made = self._tiles.made
            tile = self._tiles.around(guess)
            if self._tiles.made > made:
                yield None
            if tile is None:
                continue
            aligned = tile.coarse.align(scan, guess)
            ends = [guess, *([] if aligned is None else [aligned.found.pose])]  # large voxels may mislead
            made = self._tiles.made
            arrived.append(max(((self.weigh(at, view), at, tile.local) for at in ends), key=lambda a: a[0]))
            if self._tiles.made > made:
                yield None
        arrived.sort(key=lambda place: -place[0])
        for _, pose, local in arrived[: self._settings.places]:
            exact = local.align(view.points, pose, REACH * self.voxel_m)  # may be some voxels off
            yield pose if exact is None else exact.found.pose

    def _aligned(self, view: CloudView, guess: Pose) -> tuple[Aligned | None, float]:
        """Return an alignment, and the share of the cloud that agrees, relative to the map's own clouds."""
        assert isinstance(guess, gtsam.Pose3)
        tile = self._tiles.around(guess)
        if tile is None or not len(view.points):
            return None, 0.0
        lidar = np.asarray(guess.transformFrom(view.lidar))
        known = ~tile.planes.judge(lidar, moved(view.points, guess), 0.0).strange
        aligned = tile.local.refine(view.points[known], guess)
        share = 0.0 if aligned is None else aligned.found.agreement * float(np.mean(known))
        return aligned, share / max(tile.agreement, 1e-3)
