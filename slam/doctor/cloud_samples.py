"""Data of a 3D lidar for the doctor: stretches of clouds spread over the log, and its motions in them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.datasets.corrections import begins_early
from slam.datasets.corrections_in_space import beyond, retimed
from slam.datasets.dataset import Thinned
from slam.doctor.camera_samples import SensorStep
from slam.doctor.floor import ANGLE_RAD, LEVER_M, floor_normal
from slam.doctor.own_body import body_reach_m
from slam.doctor.stretches import Repeats, Stretches
from slam.doctor.turning import Turn, times_scale, turn_of, unit_of
from slam.matching.cloud_points import at_middle_of_turn
from slam.measurements import FloatArray, PointCloud
from slam.odometry.cloud_tracker import CloudTracker, FirstMap, TrackedCloud

# The points of 16 rings are enough for the motion of a lidar and its surroundings.
_MOST_POINTS = 16_000
_CONFIG = Config()


@dataclass(slots=True)
class CloudSamples:
    """One 3D lidar; attributes as those of `slam.doctor.camera_samples.CameraSamples`.

    Attributes
    ----------
    clouds
        Thinned clouds of each stretch that are not matched yet.
    between
        Clouds of the same revolution as the previous one, by another lidar.
    interval_s, turn_s
        Interval between clouds, and time span of a cloud's points.
    turn
        Its rotation, if points have no timestamps and it can be estimated.
    times_scale
        Factor on point times by which clouds fit better, see `slam.doctor.turning.times_scale`.
    reach_m
        Range of the farthest points of the robot itself, 0 if it sees none.
    """

    steps: list[list[SensorStep]] = field(default_factory=list)
    clouds: list[list[PointCloud]] = field(default_factory=list)
    points: list[FloatArray] = field(default_factory=list)
    count: int = 0
    repeats: Repeats = field(default_factory=Repeats)
    between: int = 0
    interval_s: Thinned = field(default_factory=Thinned)
    turn_s: Thinned = field(default_factory=Thinned)
    turn: Turn | None = None
    times_scale: float = 1.0
    reach_m: float = 0.0
    T_base_lidar: gtsam.Pose3 = field(default_factory=lambda: gtsam.Pose3())
    _stretches: Stretches = field(default_factory=Stretches)
    _tracker: CloudTracker | None = None
    _tracked: tuple[float, TrackedCloud] | None = None
    _newest: PointCloud | None = None
    _stamps_s: list[float] = field(default_factory=list)
    _first: PointCloud | None = None

    @property
    def untimed_s(self) -> float:
        """Duration of a revolution with unknown point times; 0 if they are known."""
        return 0.0 if self.turn_s.values or self.turn else self.interval_s.median() or 0.0

    @property
    def stated_up(self) -> FloatArray:
        """The vertical (3,) of the base in the lidar's frame, by the log."""
        return np.asarray(self.T_base_lidar.rotation().matrix())[2]

    @property
    def stands(self) -> bool:
        """Whether a floor confirms its rotation."""
        normal = self.floor(self.stated_up)
        return normal is not None and bool(normal @ self.stated_up > math.cos(0.5 * ANGLE_RAD))

    def floor(self, up: FloatArray) -> FloatArray | None:
        """Normal (3,) of a floor as far below as the log says, near ``up`` (3,), lidar's frame."""
        points, height_m = np.concatenate([np.zeros((0, 3)), *self.points]), self.T_base_lidar.z()
        points = points[np.linalg.norm(points, axis=1) > height_m - LEVER_M]  # nearer is the robot
        return floor_normal(points, up, height_m)

    def add(self, cloud: PointCloud) -> None:
        """Add the next cloud."""
        self.count += 1
        if self._overlaps(cloud):
            self.between += 1
            return
        if self.repeats.take(self._newest and replace(self._newest, times_s=None), cloud):
            return
        if self._newest is not None:
            self.interval_s.add(cloud.stamp_s - self._newest.stamp_s)
        if cloud.times_s is not None and cloud.times_s.size >= _CONFIG.cloud_odometry.least_pairs:
            self.turn_s.add(float(np.ptp(cloud.times_s)))
        self._newest, self.T_base_lidar = cloud, cloud.T_base_lidar
        if not self._stretches.wants(cloud.stamp_s):
            return
        step = max(-(-len(cloud.points_lidar) // _MOST_POINTS), 1)  # also for an empty cloud
        points = cloud.points_lidar[::step].copy()  # not a view, which would keep the whole
        times_s = None if cloud.times_s is None else cloud.times_s[::step]
        thinned = PointCloud(cloud.stamp_s, points, times_s, sensor=cloud.sensor)
        if self._stretches.begins:
            if self._stretches.thinned:
                del self.clouds[1::2], self.points[1::2]
            self.clouds.append([])
            self.points.append(thinned.points_lidar.astype(np.float64))
        self.clouds[-1].append(thinned)

    def close(self, *, compared: bool) -> None:
        """Estimate its rotation, and the motions of the stretches that were kept."""
        interval_s = self.interval_s.median() or 0.0
        step = max(int(GAP_S / interval_s), 1) if interval_s else 1
        apart = [cloud.points_lidar for clouds in self.clouds for cloud in clouds[::step]]
        self.reach_m = body_reach_m(apart, np.asarray(self.T_base_lidar.rotation().matrix())[2], _CONFIG)
        self.clouds = [[beyond(cloud, self.reach_m) for cloud in clouds] for clouds in self.clouds]
        # With a stamp at the start of the revolution, deskewing would make the steps oscillate.
        middle = [[at_middle_of_turn(cloud, _CONFIG.cloud_odometry) for cloud in one] for one in self.clouds]
        if (turn_s := self.turn_s.median()) is None:
            self.turn = turn_of(middle, interval_s, _CONFIG)
        else:
            self.times_scale = times_scale(middle, turn_s, interval_s, _CONFIG)
        while self.clouds:
            clouds = self.clouds.pop(0)
            self.steps.append([])
            for cloud in clouds if compared else []:
                timed = at_middle_of_turn(retimed(cloud, self.times_scale), _CONFIG.cloud_odometry)
                self._track(timed if self.turn is None else self.turn.timed(timed))

    def _overlaps(self, cloud: PointCloud) -> bool:
        """Whether a cloud begins early, so it is of another lidar; if all do, times are in another unit."""
        before, self._stamps_s = self._newest, [*self._stamps_s[-2:], cloud.stamp_s]
        if before is None or before.times_s is None or not begins_early(before, cloud):
            return False
        span_s, steps_s = float(np.ptp(before.times_s)), np.diff(self._stamps_s).tolist()
        return len(steps_s) < 2 or any(unit_of(span_s, step_s) == 1.0 for step_s in steps_s)

    def _track(self, cloud: PointCloud) -> None:
        """The step from the previous cloud; after a gap, tracking starts again."""
        before = self._tracked
        if before is None or not 0.0 < cloud.stamp_s - before[0] < GAP_S or self._tracker is None:
            self._tracker, before, self._first = CloudTracker(_CONFIG, None), None, None
        tracked = self._tracker.follow(cloud)
        if self._first is not None and tracked.motion is not None:
            # The first was deskewed as if the robot stood still: repeat both with the estimated motion.
            self._tracker = CloudTracker(_CONFIG, None, first=FirstMap(self._tracker.twist))
            before = self._first.stamp_s, self._tracker.follow(self._first)
            tracked = self._tracker.follow(cloud)
        # A cloud without a match has only a predicted pose: no step starts there.
        self._tracked = (cloud.stamp_s, tracked) if before is None or tracked.motion else None
        self._first = cloud if before is None else None
        if before is not None and tracked.motion is not None:
            step = before[1].pose.between(tracked.pose)
            self.steps[-1].append(SensorStep(before[0], cloud.stamp_s, step))
