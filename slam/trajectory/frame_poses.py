"""A pose for every camera frame once the keyframes are known, in SE(3)."""

from __future__ import annotations

from array import array
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.measurements import FloatArray, Trajectory


class FramePoses:
    """Stamps and odometry poses of every frame; numbers only, so that it stays small on a long log."""

    def __init__(self) -> None:
        self._stamps_s = array("d")
        self._poses = array("d")
        self._keyframes = array("q")

    def __len__(self) -> int:
        return len(self._stamps_s)

    def add(self, stamp_s: float, T_odom_camera: gtsam.Pose3) -> None:
        """Take a frame."""
        self._stamps_s.append(stamp_s)
        self._poses.extend(T_odom_camera.matrix()[:3].ravel())

    def mark_keyframe(self) -> None:
        """The newest frame is a keyframe."""
        self._keyframes.append(len(self) - 1)

    def keyframes(self) -> NDArray[np.int64]:
        """(K,) frame number of each keyframe."""
        return np.array(self._keyframes, dtype=np.int64)

    def trajectory(self, keyframe_poses: list[gtsam.Pose3], T_camera_base: gtsam.Pose3) -> Trajectory:
        """A pose of the base for every frame.

        The correction of the odometry at a keyframe fades into that of the next in proportion to the frames
        between; before the first and after the last it stays.

        Parameters
        ----------
        keyframe_poses
            (K,) optimised ``T_map_camera``, K > 0.
        """
        keyframes = self.keyframes()
        corrections = [
            pose.compose(self._pose(int(frame)).inverse())
            for pose, frame in zip(keyframe_poses, keyframes, strict=True)
        ]
        positions = np.empty((len(self), 3))
        quaternions = np.empty((len(self), 4))
        for frame in range(len(self)):
            right = int(np.searchsorted(keyframes, frame))
            left = max(right - 1, 0)
            right = min(right, len(keyframes) - 1)
            span = keyframes[right] - keyframes[left]
            share = (frame - keyframes[left]) / span if span else 0.0
            correction = corrections[left].slerp(float(share), corrections[right])
            pose = correction.compose(self._pose(frame)).compose(T_camera_base)
            positions[frame] = pose.translation()
            quaternions[frame] = _xyzw(pose.rotation())
        return Trajectory(np.array(self._stamps_s), positions, quaternions)

    def _pose(self, frame: int) -> gtsam.Pose3:
        """``T_odom_camera`` of a frame."""
        matrix = np.array(self._poses[12 * frame : 12 * frame + 12]).reshape(3, 4)
        return gtsam.Pose3(gtsam.Rot3(matrix[:, :3]), matrix[:, 3])


def at_stamps(trajectory: Trajectory, stamps_s: FloatArray) -> Trajectory:
    """A pose for each of other stamps (N,), in the order of the trajectory's own and near them.

    The motion to the pose before, or for the first to the one after, is taken as even.
    """
    own_s = trajectory.stamps_s
    if len(own_s) < 2 or np.array_equal(own_s, stamps_s):
        return replace(trajectory, stamps_s=stamps_s)
    poses = [
        gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), position)
        for (x, y, z, w), position in zip(trajectory.quaternions_xyzw, trajectory.positions_m, strict=True)
    ]
    positions, quaternions = np.empty((len(own_s), 3)), np.empty((len(own_s), 4))
    for n, stamp_s in enumerate(stamps_s):
        left = max(n - 1, 0)
        step_s = own_s[left + 1] - own_s[left]
        share = (stamp_s - own_s[left]) / step_s if step_s > 0.0 else float(n > 0)
        pose = poses[left].slerp(float(np.clip(share, -1.0, 2.0)), poses[left + 1])
        positions[n], quaternions[n] = pose.translation(), _xyzw(pose.rotation())
    return Trajectory(stamps_s, positions, quaternions)


def _xyzw(rotation: gtsam.Rot3) -> list[float]:
    """Quaternion, scalar last."""
    q: Any = rotation.toQuaternion()
    return [q.x(), q.y(), q.z(), q.w()]
