"""Where a 3D lidar is after every turn, and which turns are keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.answers import COMPUTED, Answers
from slam.config_clouds import CloudOdometryConfig
from slam.matching.cloud_points import base_points, deskewed, voxel_of
from slam.matching.planar import between
from slam.measurements import FloatArray, MotionEstimate, PointCloud
from slam.odometry.cloud_odometry import CloudOdometry
from slam.odometry.wheel_tracker import WheelTracker

# Beyond this no velocity of before tells where the robot is now.
_LONGEST_STEP_S = 1.0
_LOST_AFTER = 10
# A turn is deskewed again where the match tells a motion that moves its ends by more voxels than this.
_SKEWED_VOXELS, _DESKEWED_TIMES = 0.25, 3
# Changes of the rate of turn that are tried where a cloud does not fit.
_JERKS_RAD_S = (0.5, -0.5, 1.0, -1.0, 1.5, -1.5, 2.0, -2.0)


@dataclass(frozen=True, slots=True)
class TrackedCloud:
    """A cloud with its place.

    Attributes
    ----------
    points
        (N, 3) usable points, base frame, deskewed where that is possible.
    pose
        ``T_odom_base``.
    motion
        The match; None where nothing matched, and the pose is a guess.
    new_keyframe
        Whether the robot has moved on enough.
    """

    points: FloatArray
    pose: gtsam.Pose3
    motion: MotionEstimate | None
    new_keyframe: bool


@dataclass(frozen=True, slots=True)
class _Deskewed:
    """Usable points (N, 3) of a cloud, base frame, and the twist (6,) by which they were deskewed."""

    points: FloatArray
    twist: FloatArray


class CloudTracker:
    """State of the odometry."""

    def __init__(
        self, config: CloudOdometryConfig, wheels: WheelTracker | None, answers: Answers = COMPUTED
    ) -> None:
        self._config, self._wheels, self._answers = config, wheels, answers
        self._odometry: CloudOdometry | None = None
        self._pose = gtsam.Pose3()
        self._keyframe = gtsam.Pose3()
        self._stamp_s: float | None = None
        self._free_twist = np.zeros(6)
        self._sure_pose, self._sure_s = gtsam.Pose3(), -np.inf
        self._wheel_pose: FloatArray | None = None
        self._twist, self._twist_known = np.zeros(6), False
        self._lost = 0
        self.voxel_m = 0.0

    def track(self, cloud: PointCloud) -> TrackedCloud:
        """Find the pose of the next cloud at its stamp; where it cannot be matched it is guessed."""
        step_s = 0.0 if self._stamp_s is None else cloud.stamp_s - self._stamp_s
        guesses, before = self._guesses(cloud.stamp_s, step_s), self._pose
        expected = guesses[0] if guesses else before
        self._stamp_s = cloud.stamp_s
        seen = self._seen(cloud, self._twist_to(expected, cloud.stamp_s) if guesses else np.zeros(6))
        points = seen.points
        if len(points) < self._config.least_pairs:
            self._lost += 1
            return self._guessed(points, expected, new_keyframe=False)
        if self._odometry is None:
            self.voxel_m = voxel_of(points, self._config)
            self._odometry = CloudOdometry(self._config, self.voxel_m)
            self._sure_s = cloud.stamp_s
            return TrackedCloud(points, self._pose, None, new_keyframe=True)
        motion = self._answers.ask(
            "cloud", float(expected.x()), lambda: self._match(cloud, seen, guesses, before)
        )
        if motion is None:
            self._lost += 1
            return self._guessed(points, expected, new_keyframe=self._lost >= _LOST_AFTER)
        return self._matched(cloud, points, motion)

    def _match(
        self, cloud: PointCloud, seen: _Deskewed, guesses: Sequence[gtsam.Pose3], before: gtsam.Pose3
    ) -> MotionEstimate | None:
        """The match of a cloud, with a twist by which it fits where that of before does not."""
        assert self._odometry is not None
        motion = self._odometry.match(seen.points, guesses, before)
        if motion is None or not motion.converged:
            seen, motion = self._after_a_jerk(cloud, seen, motion)
        for _ in range(_DESKEWED_TIMES):
            if motion is None or not self._is_skewed(cloud, seen, motion):
                break
            again = self._seen(cloud, self._twist_to(_pose_of(motion), cloud.stamp_s))
            better = self._odometry.match(again.points, [_pose_of(motion)])
            if better is None or self._share(again, better) <= self._share(seen, motion):
                break
            seen, motion = again, better
        return motion

    def _after_a_jerk(
        self, cloud: PointCloud, seen: _Deskewed, motion: MotionEstimate | None
    ) -> tuple[_Deskewed, MotionEstimate | None]:
        """The best match of a robot that may have begun or ended to turn at once."""
        assert self._odometry is not None
        step_s = cloud.stamp_s - self._sure_s
        best = seen, motion
        if not 0.0 < step_s < _LONGEST_STEP_S:
            return best
        starts = []
        for turn_rad_s in _JERKS_RAD_S:
            turned = self._seen(cloud, seen.twist + np.array([0.0, 0.0, turn_rad_s, 0.0, 0.0, 0.0]))
            start = self._sure_pose.compose(gtsam.Pose3.Expmap(turned.twist * step_s))
            pose = self._odometry.nearby(turned.points, start)
            starts.append((self._odometry.agreement(turned.points, pose), turned, pose))
        _, turned, pose = max(starts, key=lambda one: one[0])
        found = self._odometry.match(turned.points, [pose])
        return (turned, found) if self._share(turned, found) > self._share(*best) else best

    def _seen(self, cloud: PointCloud, twist: FloatArray) -> _Deskewed:
        """A cloud deskewed by a twist (6,)."""
        return _Deskewed(base_points(cloud, twist, self._config), twist)

    def _share(self, seen: _Deskewed, motion: MotionEstimate | None) -> float:
        """How much of a cloud lies on planes where a match puts it."""
        assert self._odometry is not None
        return 0.0 if motion is None else self._odometry.agreement(seen.points, _pose_of(motion))

    def _is_skewed(self, cloud: PointCloud, seen: _Deskewed, motion: MotionEstimate) -> bool:
        """Whether the match tells another twist than the one by which a cloud was deskewed."""
        if cloud.times_s is None or not deskewed(cloud, self._config):
            return False
        off = self._twist_to(_pose_of(motion), cloud.stamp_s) - seen.twist
        turned_rad, moved_m = 0.5 * np.ptp(cloud.times_s) * np.linalg.norm(off.reshape(2, 3), axis=1)
        lever_m = float(np.sqrt(np.mean(np.sum(seen.points**2, axis=1))))
        return bool(turned_rad * lever_m + moved_m > _SKEWED_VOXELS * self.voxel_m)

    def _matched(self, cloud: PointCloud, points: FloatArray, motion: MotionEstimate) -> TrackedCloud:
        """Where the robot is, and with which velocity."""
        self._lost = 0
        pose = _pose_of(motion)
        if motion.converged:
            twist = self._learned(self._twist_to(pose, cloud.stamp_s), points, motion)
            self._twist_known = self._twist_known or cloud.stamp_s - self._sure_s < _LONGEST_STEP_S
            self._sure_pose, self._sure_s, self._twist = pose, cloud.stamp_s, twist
            if deskewed(cloud, self._config):
                points = base_points(cloud, twist, self._config)
        self._pose = pose
        return TrackedCloud(points, pose, motion, self._moved_on(pose))

    def _learned(self, twist: FloatArray, points: FloatArray, motion: MotionEstimate) -> FloatArray:
        """A twist (6,); in a direction that nothing determined, that of when it last was."""
        if not motion.degenerate:
            self._free_twist = twist
            return twist
        units = np.array([float(np.sqrt(np.mean(np.sum(points**2, axis=1))))] * 3 + [1.0] * 3)
        weak = units * motion.weak_direction
        weak /= np.linalg.norm(weak)
        return np.asarray(twist - weak * (weak @ (units * (twist - self._free_twist))) / units)

    def _twist_to(self, pose: gtsam.Pose3, stamp_s: float) -> FloatArray:
        """Velocity (6,), GTSAM's tangent, from the last sure pose to another; after a gap that of before."""
        step_s = stamp_s - self._sure_s
        if not 0.0 < step_s < _LONGEST_STEP_S:
            return self._twist
        return np.asarray(gtsam.Pose3.Logmap(self._sure_pose.between(pose)) / step_s)

    def add_keyframe(self, tracked: TrackedCloud) -> None:
        """Take a tracked cloud into the local map; of a lost one it is made anew."""
        assert self._odometry is not None
        if self._lost >= _LOST_AFTER:
            self._odometry.restart()
            self._lost, self._twist_known = 0, False
        self._odometry.add_keyframe(tracked.points, tracked.pose)
        self._keyframe = tracked.pose

    def _guesses(self, stamp_s: float, step_s: float) -> Sequence[gtsam.Pose3]:
        """Where the robot may be by now: by its wheels, by its velocity."""
        guesses = []
        if self._wheels is not None:
            before, now = self._wheel_pose, self._wheels.pose_at(stamp_s)
            self._wheel_pose = now
            if before is not None and now is not None:
                moved = between(before, now)
                if self._wheels.plausible(moved, step_s):
                    turn = gtsam.Rot3.Yaw(float(moved[2]))
                    shift = np.array([moved[0], moved[1], 0.0])
                    guesses.append(self._pose.compose(gtsam.Pose3(turn, shift)))
        # Nobody knows how long a robot that sees nothing goes on.
        if self._twist_known and 0.0 < step_s < _LONGEST_STEP_S and self._lost < _LOST_AFTER:
            guesses.append(self._pose.compose(gtsam.Pose3.Expmap(self._twist * step_s)))
        return guesses

    def _guessed(self, points: FloatArray, pose: gtsam.Pose3, *, new_keyframe: bool) -> TrackedCloud:
        """A cloud that did not match."""
        self._pose = pose
        return TrackedCloud(points, pose, None, new_keyframe)

    def _moved_on(self, pose: gtsam.Pose3) -> bool:
        """Whether the last keyframe is far enough behind."""
        step = self._keyframe.between(pose)
        turn_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
        way_m = float(np.linalg.norm(step.translation()))
        return (
            way_m > self._config.keyframe_voxels * self.voxel_m or turn_rad > self._config.keyframe_angle_rad
        )


def _pose_of(motion: MotionEstimate) -> gtsam.Pose3:
    """A match in space."""
    assert isinstance(motion.T_reference_base, gtsam.Pose3)
    return motion.T_reference_base
