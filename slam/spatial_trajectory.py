"""A pose for every camera frame once the keyframes are known, in SE(3)."""

from __future__ import annotations

from array import array
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.measurements import Trajectory


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


def _xyzw(rotation: gtsam.Rot3) -> list[float]:
    """Quaternion, scalar last."""
    q: Any = rotation.toQuaternion()
    return [q.x(), q.y(), q.z(), q.w()]
