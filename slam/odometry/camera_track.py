"""Poses of a camera at all matched frames, interpolated for any time of the run."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from dataclasses import dataclass

import gtsam
import numpy as np

from fusion.time_alignment import GAP_S
from slam.measurements import FloatArray

# Between frames farther apart than this, or so long after the newest one, the pose is unknown.
_LONGEST_GAP_S = 0.25
# Sigma of an extrapolated pose as a share of the extrapolation; of an interpolated one it is less.
_EXTRAPOLATION_SHARE = 0.2
_INTERPOLATION_SHARE = 0.05
# Sigma of the velocity of a camera that was matched only once: radians and metres per second.
_UNKNOWN_SPEED = 0.5


@dataclass(frozen=True, slots=True)
class CameraPose:
    """Pose of a camera at some time.

    Attributes
    ----------
    pose
        ``T_odom_camera``.
    covariance
        (6, 6) of the pose against the local map, GTSAM's order, camera frame.
    segment
        Poses of different segments have no known motion between them.
    """

    pose: gtsam.Pose3
    covariance: FloatArray
    segment: int


class CameraTrack:
    """Growing columns of numbers only, so that it stays small in long logs."""

    def __init__(self) -> None:
        self._stamps = array("d")
        self._poses = array("d")
        self._covariances = array("f")
        self._segments = array("l")
        self._lost = False

    def add(self, stamp_s: float, pose: CameraPose) -> None:
        """Add the next frame; a stamp that does not increase restarts the track."""
        if self._stamps and stamp_s <= self._stamps[-1]:
            for column in (self._stamps, self._poses, self._covariances, self._segments):
                del column[:]
        self._stamps.append(stamp_s)
        self._poses.extend(pose.pose.matrix().ravel())
        self._covariances.extend(np.asarray(pose.covariance).ravel())
        self._segments.append(pose.segment)
        self._lost = False

    def lose(self) -> None:
        """A frame has matched nothing: do not extrapolate the newest pose."""
        self._lost = True

    def newest_motion(self) -> tuple[float, float, FloatArray] | None:
        """Return stamps of the last two frames and the twist (6,) between, camera frame; None if unknown."""
        twist = self._twist(len(self._stamps) - 2, GAP_S)
        return None if twist is None else (self._stamps[-2], self._stamps[-1], twist)

    def at(self, stamp_s: float, clock_sigma_s: float) -> CameraPose | None:
        """Return the camera pose at a stamp between its frames or shortly outside; None if unknown.

        Parameters
        ----------
        clock_sigma_s
            Standard deviation of the stamp against the camera's own.
        """
        if not self._stamps:
            return None
        after = max(bisect_right(self._stamps, stamp_s), 1)
        before = after - 1
        elapsed_s = stamp_s - self._stamps[before]
        if after < len(self._stamps) and elapsed_s > 0.0:
            return self._between(before, elapsed_s, clock_sigma_s)
        if elapsed_s <= -_LONGEST_GAP_S:
            return None
        if after == len(self._stamps) and (self._lost or elapsed_s >= _LONGEST_GAP_S):
            return None
        twist = self._twist(before - 1)
        if twist is None and after < len(self._stamps):
            twist = self._twist(before)
        pose = self._pose(before)
        if twist is None:
            sigmas = np.full(6, _UNKNOWN_SPEED * abs(elapsed_s))
        else:
            pose = pose.compose(gtsam.Pose3.Expmap(twist * elapsed_s))
            sigmas = np.abs(twist) * np.hypot(_EXTRAPOLATION_SHARE * elapsed_s, clock_sigma_s)
        return CameraPose(pose, self._covariance(before) + np.diag(sigmas**2), self._segments[before])

    def _between(self, before: int, elapsed_s: float, clock_sigma_s: float) -> CameraPose | None:
        """Interpolate at constant velocity between two frames."""
        twist = self._twist(before)
        if twist is None:
            return None
        step_s = self._stamps[before + 1] - self._stamps[before]
        nearer = before if elapsed_s <= 0.5 * step_s else before + 1
        away_s = min(elapsed_s, step_s - elapsed_s)
        sigmas = np.abs(twist) * np.hypot(_INTERPOLATION_SHARE * away_s, clock_sigma_s)
        pose = self._pose(before).compose(gtsam.Pose3.Expmap(twist * elapsed_s))
        return CameraPose(pose, self._covariance(nearer) + np.diag(sigmas**2), self._segments[before])

    def _twist(self, before: int, longest_s: float = _LONGEST_GAP_S) -> FloatArray | None:
        """Return the twist (6,) from a frame to the next; None without a known motion."""
        if before < 0 or self._segments[before] != self._segments[before + 1]:
            return None
        step_s = self._stamps[before + 1] - self._stamps[before]
        if step_s >= longest_s:
            return None
        return np.asarray(gtsam.Pose3.Logmap(self._pose(before).between(self._pose(before + 1))) / step_s)

    def _pose(self, number: int) -> gtsam.Pose3:
        """Return ``T_odom_camera`` at a frame."""
        row = self._poses[16 * number : 16 * (number + 1)]
        return gtsam.Pose3(np.array(row).reshape(4, 4))

    def _covariance(self, number: int) -> FloatArray:
        """Return the covariance (6, 6) at a frame."""
        return np.array(self._covariances[36 * number : 36 * (number + 1)], dtype=np.float64).reshape(6, 6)
