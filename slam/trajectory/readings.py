"""The log's readings, in log order, and the pose of each once the keyframes are known."""

from __future__ import annotations

from array import array

import numpy as np
from numpy.typing import NDArray

from slam.measurements import FloatArray, Trajectory
from slam.trajectory.spread import spread_correction, steadied


class Readings:
    """Stamps and motion of every reading; numbers only, so that it stays small on a long log."""

    def __init__(self) -> None:
        self._stamps_s = array("d")
        self._wheel_poses = array("d")
        self._scan_readings = array("q")
        self._scan_poses = array("d")
        self._scan_variances = array("d")
        self._scan_sure = array("b")
        self._keyframe_scans = array("q")

    @property
    def scan_count(self) -> int:
        """Scans so far."""
        return len(self._scan_readings)

    def add_wheel(self, stamp_s: float, pose: FloatArray | None) -> None:
        """A reading with the wheels' pose (3,), odom frame; None where there is none."""
        self._stamps_s.append(stamp_s)
        self._wheel_poses.extend((np.nan,) * 3 if pose is None else pose)

    def add_scan(
        self,
        stamp_s: float,
        pose: FloatArray,
        wheel_pose: FloatArray | None,
        *,
        variances: FloatArray | None = None,
        sure: bool = True,
    ) -> None:
        """A scan with its pose (3,) in the odometry frame; one that is not sure is no anchor for others.

        Parameters
        ----------
        variances
            (3,) of the pose against the scans around it, along the base's axes; None where nothing measured
            it.
        """
        self._scan_variances.extend((np.nan,) * 3 if variances is None else variances)
        self._scan_readings.append(len(self._stamps_s))
        self._scan_sure.append(sure)
        self._scan_poses.extend(pose)
        self.add_wheel(stamp_s, wheel_pose)

    def mark_keyframe(self) -> None:
        """The newest scan is a keyframe."""
        self._keyframe_scans.append(self.scan_count - 1)

    def keyframe_scans(self) -> NDArray[np.int64]:
        """(K,) scan number of each keyframe."""
        return np.array(self._keyframe_scans)

    def trajectory(self, keyframe_poses: FloatArray) -> Trajectory:
        """A pose for every reading.

        Parameters
        ----------
        keyframe_poses
            (K, 3) optimised poses, map frame, K > 0.
        """
        stamps = np.array(self._stamps_s)
        wheel_poses = np.array(self._wheel_poses).reshape(-1, 3)
        known = np.flatnonzero(~np.isnan(wheel_poses[:, 0]))
        if known.size:
            # Only what came before the first odometry reading is unknown: the wheels had not turned yet.
            wheel_poses[: known[0]] = wheel_poses[known[0]]
        scan_poses = self._scans_of(keyframe_poses, wheel_poses if known.size else None)
        sure = np.array(self._scan_sure, dtype=np.bool_)
        sure[self.keyframe_scans()] = True
        scans, scan_poses = np.array(self._scan_readings)[sure], scan_poses[sure]
        if not known.size:
            wheel_poses = self._motion_without_wheels(stamps, scans, scan_poses)
        return Trajectory.from_planar(stamps, spread_correction(wheel_poses, scans, scan_poses))

    def _scans_of(self, keyframe_poses: FloatArray, wheel_poses: FloatArray | None) -> FloatArray:
        """(S, 3) poses of the scans: as matched between keyframes, noise taken out by the wheels' way."""
        keyframes = self.keyframe_scans()
        matched = spread_correction(np.array(self._scan_poses).reshape(-1, 3), keyframes, keyframe_poses)
        if wheel_poses is None:
            return matched
        bridged = spread_correction(wheel_poses[np.array(self._scan_readings)], keyframes, keyframe_poses)
        return steadied(matched, bridged, np.array(self._scan_variances).reshape(-1, 3), keyframes)

    @staticmethod
    def _motion_without_wheels(
        stamps: FloatArray, scans: NDArray[np.int64], scan_poses: FloatArray
    ) -> FloatArray:
        """Motion that only tells how far between two scans, in time, each reading lies."""
        motion = np.zeros((stamps.size, 3))
        before = np.clip(np.searchsorted(scans, np.arange(stamps.size), side="right") - 1, 0, scans.size - 1)
        after = np.clip(before + 1, 0, scans.size - 1)
        span = stamps[scans[after]] - stamps[scans[before]]
        share = np.zeros(stamps.size)
        known = span > 0.0
        share[known] = ((stamps - stamps[scans[before]])[known] / span[known]).clip(0.0, 1.0)
        turn = (scan_poses[after, 2] - scan_poses[before, 2] + np.pi) % (2.0 * np.pi) - np.pi
        motion[:, :2] = scan_poses[before, :2] + share[:, None] * (
            scan_poses[after, :2] - scan_poses[before, :2]
        )
        motion[:, 2] = scan_poses[before, 2] + share * turn
        return motion
