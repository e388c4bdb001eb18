"""Track a 3D lidar revolution by revolution, and select keyframes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from fusion.estimation import gate
from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.estimates import MotionEstimate
from slam.matching.cloud_points import base_points, deskewed, usable_intensities, voxel_of
from slam.matching.local_cloud import REACH
from slam.measurements import Float32Array, FloatArray, ImuReading, PointCloud, spatial
from slam.odometry.cloud_odometry import CloudOdometry
from slam.odometry.cloud_velocity import LONGEST_STEP_S, CloudVelocity
from slam.odometry.imu_tracker import ImuTracker
from slam.odometry.predictor import LEAST_SHARE, Predictor
from slam.odometry.turn_matcher import DeskewedCloud, TurnMatcher, pose_of
from slam.odometry.unobserved_path import UnobservedPath
from slam.odometry.wheel_tracker import WheelMoment, WheelTracker
from slam.result_cache import COMPUTED, ResultCache

# Sigma of a direction without measurement, for the IMU: its own guess is no measurement.
_UNSEEN_M = 100.0


@dataclass(frozen=True, slots=True)
class TrackedCloud:
    """A cloud with its pose.

    Attributes
    ----------
    points
        (N, 3) usable points, base frame, deskewed if possible.
    pose
        ``T_odom_base``.
    motion
        The match; None if nothing matched and the pose is a guess.
    new_keyframe
        Whether the robot has moved far enough for a keyframe.
    unseen_m
        Distance by its velocity since the previous cloud, if nothing measured this motion and it is longer
        than the range of a match; otherwise 0.
    """

    points: FloatArray
    pose: gtsam.Pose3
    motion: MotionEstimate | None
    new_keyframe: bool
    unseen_m: float = 0.0


@dataclass(frozen=True, slots=True)
class FirstMap:
    """What is known at the first cloud.

    Attributes
    ----------
    twist
        (6,) as `CloudVelocity.twist`, of a robot that moves at the beginning; None if it stands still or its
        motion is unknown.
    change
        (6,) of the twist per second.
    keyframes
        Points (N, 3) of later clouds and the position (3,) of their lidar, frame of the first cloud's base.
    """

    twist: FloatArray | None = None
    change: FloatArray = field(default_factory=lambda: np.zeros(6))
    keyframes: Sequence[tuple[FloatArray, FloatArray]] = ()


NO_MAP = FirstMap()


class CloudTracker:
    """State of the odometry."""

    def __init__(
        self,
        config: Config,
        wheels: WheelTracker | None,
        result_cache: ResultCache = COMPUTED,
        imu: ImuTracker | None = None,
        first: FirstMap = NO_MAP,
    ) -> None:
        self._config, self._wheels, self._result_cache = config, wheels, result_cache
        self._imu = imu
        self._turns = config.cloud_odometry
        self._odometry: CloudOdometry | None = None
        self._matcher: TurnMatcher | None = None
        self._velocity, self._first = CloudVelocity(first.twist), first
        # Without wheels or an IMU, the motion along a tunnel is unknown.
        self._open = UnobservedPath(config.wheels.greatest_speed_m_s)
        self._cloud: PointCloud | None = None
        self._pose = gtsam.Pose3()
        self._keyframe = gtsam.Pose3()
        self._stamp_s: float | None = None
        self._wheel_pose: WheelMoment | None = None
        self.by_wheels = Predictor(config.prediction.memory_scans, LEAST_SHARE)
        self._lost = 0
        self._rolls: deque[tuple[float, FloatArray]] = deque()
        self.voxel_m = 0.0

    @property
    def twist(self) -> FloatArray:
        """(6,) velocity from the last certain match."""
        return self._velocity.twist

    def track(self, cloud: PointCloud) -> TrackedCloud:
        """Find the pose of the next cloud at its stamp; without a match it is a guess."""
        step_s = 0.0 if self._stamp_s is None else cloud.stamp_s - self._stamp_s
        by_imu = None if self._imu is None else self._imu.predicted(cloud.stamp_s)
        turned = None if self._imu is None else self._imu.turned(cloud.stamp_s)
        guesses, before = self._guesses(cloud, step_s, by_imu), self._pose
        if by_imu is None and turned is not None:
            guesses = [gtsam.Pose3(turned, guess.translation()) for guess in guesses]
        expected = guesses[0] if guesses else before
        self._stamp_s = cloud.stamp_s
        if self._imu is not None and deskewed(cloud, self._turns):
            straight = self._imu.straightened(cloud, self._velocity.twist)
            cloud, self._velocity.rotated = straight, straight is not cloud
        self._cloud = cloud
        moves = guesses or self._matcher is None
        twist = self._velocity.at(expected, cloud.stamp_s) if moves else np.zeros(6)
        turn = DeskewedCloud.of(cloud, twist, self._turns)
        if len(turn.points) < self._turns.least_pairs:
            self._lost += 1
            return self._guessed(turn.points, expected, new_keyframe=False)
        if self._matcher is None:
            return self._begun(cloud, turn)
        unseen_m = 0.0 if guesses or step_s < LONGEST_STEP_S else self._velocity.speed_m_s * step_s
        if unseen_m > REACH * self.voxel_m:
            # A fit around the previous place would be another place that looks like it.
            self._lost = self._config.match.lost_after
            ahead = gtsam.Pose3(gtsam.Rot3(), step_s * self._velocity.twist[3:])
            guessed = self._guessed(turn.points, before.compose(ahead), new_keyframe=True)
            return replace(guessed, unseen_m=unseen_m)
        matcher, odometry = self._matcher, self._odometry
        assert odometry is not None
        motion, settles = self._result_cache.cached(
            "cloud",
            float(expected.x()),
            lambda: (
                matcher.match(cloud, turn, guesses, before, step_s, turn_known=turned is not None),
                odometry.settles,
            ),
        )
        # The guess of an IMU does not depend on such a match.
        if by_imu is None and motion is not None and motion.degenerate:
            odometry.note_open(settles=settles)
        if motion is None or not self._believed(motion, by_imu):
            self._lost += 1
            return self._guessed(
                turn.points, expected, new_keyframe=self._lost >= self._config.match.lost_after
            )
        return self._matched(cloud, turn, motion)

    def moves_on(self, step_s: float) -> bool:
        """Return whether the robot may be far enough for a keyframe after a time, by its velocity."""
        return not self._velocity.known or self._moved_on(
            self._pose.compose(gtsam.Pose3.Expmap(self.twist * step_s))
        )

    def follow(self, cloud: PointCloud) -> TrackedCloud:
        """`track`, and add the cloud to the local map if the robot has moved far enough."""
        tracked = self.track(cloud)
        if tracked.new_keyframe:
            self.add_keyframe(tracked)
        return tracked

    def intensities(self) -> Float32Array | None:
        """(N,) of the points of the newest tracked cloud; None if it has none."""
        return None if self._cloud is None else usable_intensities(self._cloud, self._turns)

    def roll(self, stamp_s: float, pose: FloatArray) -> None:
        """Add a pose of the wheels, (3,) in their odom frame."""
        self._rolls.append((stamp_s, pose))
        # Longer than the longest time between two states of the IMU.
        while stamp_s - self._rolls[0][0] > 4.0 * LONGEST_STEP_S:
            self._rolls.popleft()

    def hear(self, reading: ImuReading) -> None:
        """Add a reading of the IMU; without clouds for long, IMU and wheels continue the track."""
        assert self._imu is not None
        self._imu.add(reading)
        due_s = self._imu.due_s()
        if due_s is not None and (pose := self._imu.predicted(due_s)) is not None:
            self._imu.took(due_s, pose, None, self._rolled(due_s))

    def add_keyframe(self, tracked: TrackedCloud) -> None:
        """Add a tracked cloud to the local map; if tracking was lost, start a new local map."""
        assert self._odometry is not None and self._cloud is not None
        if self._lost >= self._config.match.lost_after:
            self._odometry.restart()
            self._lost = 0
            self._velocity.known = False
            if self._imu is not None:
                self._imu.restart()
        self._open.add_keyframe()
        self._odometry.add_keyframe(tracked.points, tracked.pose, self._cloud.T_base_lidar.translation())
        self._keyframe = tracked.pose

    def _guesses(self, cloud: PointCloud, step_s: float, by_imu: gtsam.Pose3 | None) -> Sequence[gtsam.Pose3]:
        """Predict the pose of the robot: by its IMU, by its wheels; without an IMU by its velocity."""
        guesses = [] if by_imu is None else [by_imu]
        if self._wheels is not None:
            self.by_wheels.guesses.clear()
            # The middle of a revolution is no time of the log.
            now = self._wheels.moment(cloud.stamp_s, in_order=cloud.times_s is None)
            before, self._wheel_pose = self._wheel_pose, now
            moved = self._wheels.motion(before, self._wheel_pose, step_s)
            if moved is not None:
                self.by_wheels.predict(moved, self._wheels.covariance(moved))
                guesses.append(self._pose.compose(spatial(gtsam.Pose2(*moved))))
        # It is unknown how long a robot without measurements moves on.
        if (
            by_imu is None
            and self._velocity.known
            and abs(step_s) < LONGEST_STEP_S
            and self._lost < self._config.match.lost_after
        ):
            guesses.append(self._pose.compose(gtsam.Pose3.Expmap(self._velocity.twist * step_s)))
        return guesses

    def _begun(self, cloud: PointCloud, turn: DeskewedCloud) -> TrackedCloud:
        """Start with the first cloud, the reference for all later ones."""
        self.voxel_m = voxel_of(turn.points, self._turns)
        self._odometry = CloudOdometry(self._config, self.voxel_m)
        self._matcher = TurnMatcher(self._turns, self._odometry, self._velocity, self.voxel_m)
        self._velocity.begin(cloud.stamp_s)
        self._odometry.begin(self._first.keyframes)
        if self._first.keyframes:
            # A gyroscope may know more about its rotation than the clouds after it.
            known = self._imu is not None
            if self._velocity.known and not self._velocity.rotated:
                turn = self._matcher.fitted(cloud, turn, self._pose)
                self._velocity.twist = turn.twist
            motion = self._matcher.match(cloud, turn, [self._pose], self._pose, 0.0, turn_known=known)
            if motion is not None and motion.converged and not motion.degenerate:
                return replace(self._matched(cloud, turn, motion), new_keyframe=True)
        self._feed(np.diag([self._config.match.floor_rad**2] * 3 + [self._config.match.floor_m**2] * 3))
        return TrackedCloud(turn.points, self._pose, None, new_keyframe=True)

    def _matched(self, cloud: PointCloud, turn: DeskewedCloud, motion: MotionEstimate) -> TrackedCloud:
        """Return pose and velocity from a match."""
        if self._lost == 0 and motion.converged and not motion.degenerate:
            self._judge_wheels(self._pose.between(pose_of(motion)))
        self._lost = 0
        self._pose = pose_of(motion)
        if cloud.times_s is not None and deskewed(cloud, self._turns):
            moved = self._velocity.misplaced(self._pose, cloud.stamp_s, np.asarray(cloud.times_s))
            motion = replace(motion, covariance=motion.covariance + np.outer(moved, moved))
        points, measured, new_keyframe = turn.points, motion.covariance, self._moved_on(self._pose)
        if motion.converged:
            if new_keyframe and deskewed(cloud, self._turns):
                points = base_points(cloud, self._velocity.at(self._pose, cloud.stamp_s), self._turns)
            self._velocity.learn(self._pose, cloud.stamp_s, turn.arms_m, motion)
            if self._wheels is not None:
                self._wheels.see(self._velocity.speed_m_s)
        self._feed(measured + _UNSEEN_M**2 * np.outer(motion.weak_direction, motion.weak_direction))
        certain = motion.converged and not motion.degenerate
        by_imu = None if certain or self._imu is None else self._imu.off(self._pose)
        if by_imu is None:
            motion = self._open.widened(cloud.stamp_s, motion, self._velocity.twist)
        else:
            motion = replace(motion, covariance=by_imu)
        return TrackedCloud(points, self._pose, motion, new_keyframe)

    def _judge_wheels(self, step: gtsam.Pose3) -> None:
        """Learn the uncertainty of the wheels from a matched step."""
        if self._wheels is not None and self.by_wheels.guesses:
            matched = np.array([step.x(), step.y(), step.rotation().yaw()])
            self._wheels.learn_scale(self.by_wheels.guesses[0].pose, matched)
            self.by_wheels.judge(matched)

    def _believed(self, motion: MotionEstimate, by_imu: gtsam.Pose3 | None) -> bool:
        """Return whether a match agrees with the IMU's prediction; a usual fit may be off by a voxel more.

        After unmeasured seconds, a street matches wherever it looks the same.
        """
        if by_imu is None or self._imu is None:
            return True
        offset, covariance = gtsam.Pose3.Logmap(by_imu.between(pose_of(motion))), motion.covariance
        if motion.converged:
            slack = [self._config.keyframes.angle_rad] * 3 + [self.voxel_m] * 3
            covariance = covariance + np.diag(np.square(slack))

        def agrees(covariance: FloatArray) -> bool:
            return bool(offset @ np.linalg.solve(covariance, offset) <= gate(6))

        # A match that agrees without the spread, which is slow to compute, also agrees with it.
        if agrees(covariance):
            return True
        return (spread := self._imu.spread()) is not None and agrees(covariance + spread)

    def _guessed(self, points: FloatArray, pose: gtsam.Pose3, *, new_keyframe: bool) -> TrackedCloud:
        """Handle a cloud that did not match."""
        self._pose = pose
        self._feed(None)
        return TrackedCloud(points, pose, None, new_keyframe)

    def _feed(self, covariance: FloatArray | None) -> None:
        """Give the IMU the pose of the robot, with covariance (6, 6); None for a guess."""
        if self._imu is None or self._stamp_s is None:
            return
        unseen = covariance is None or float(np.trace(covariance)) > _UNSEEN_M**2
        self._imu.took(self._stamp_s, self._pose, covariance, self._rolled(self._stamp_s) if unseen else None)

    def _rolled(self, stamp_s: float) -> tuple[gtsam.Pose3, FloatArray] | None:
        """Return the wheel motion since the newest state of the IMU, with its covariance (6, 6)."""
        assert self._imu is not None
        state = self._imu.state
        if self._wheels is None or state is None:
            return None
        stamps_s = [rolled_s for rolled_s, _ in self._rolls]
        if not stamps_s or stamps_s[0] > state.stamp_s or stamps_s[-1] < stamp_s - GAP_S:
            return None
        rows = np.array([pose for _, pose in self._rolls])
        rows[:, 2] = np.unwrap(rows[:, 2])
        ends = np.array([np.interp([state.stamp_s, stamp_s], stamps_s, column) for column in rows.T])
        begun, ended = (WheelMoment(end, 0.0) for end in ends.T)
        moved = self._wheels.motion(begun, ended, stamp_s - state.stamp_s)
        if moved is None:
            return None
        planar = self.by_wheels.rescaled(moved, self._wheels.covariance(moved)).covariance
        # Wheels do not measure roll and pitch; vertical motion is as small as lateral motion.
        covariance = np.diag([1.0, 1.0, planar[2, 2], planar[0, 0], planar[1, 1], planar[1, 1]])
        return spatial(gtsam.Pose2(*moved)), covariance

    def _moved_on(self, pose: gtsam.Pose3) -> bool:
        """Return whether the last keyframe is far enough away."""
        step = self._keyframe.between(pose)
        turn_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
        path_m = float(np.linalg.norm(step.translation()))
        moved = path_m > self._turns.keyframe_voxels * self.voxel_m
        return moved or turn_rad > self._config.keyframes.angle_rad
