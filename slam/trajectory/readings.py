"""Readings of the log, in log order, and the pose of each once the keyframes are known."""

from __future__ import annotations

import math
from array import array
from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np
import scipy
from numpy.typing import NDArray

from fusion.estimation import TINY
from slam.estimates import Trajectory
from slam.measurements import BoolArray, FloatArray, Pose, spatial
from slam.trajectory.poses import Poses
from slam.trajectory.spread import spread_correction, steadied


class Readings:
    """Stamps and motion of every reading; only numbers, so that it stays small for a long log.

    Attributes
    ----------
    bridged
        (6, 6) by reading number: covariance if only an IMU led to this reading, GTSAM's tangent.
    before_first
        (6,) motion from the first scan's pose to its reported stamp, see `at_stamps`.
    """

    def __init__(self) -> None:
        self.bridged: dict[int, FloatArray] = {}
        self.before_first: FloatArray = np.full(6, np.nan)
        self._stamps_s = array("d")
        self._reported_s = array("d")
        self._wheel_poses = array("d")
        self._scan_readings = array("q")
        self._scan_poses = array("d")
        self._scan_variances = array("d")
        self._scan_trusted = array("b")
        self._keyframe_scans = array("q")

    @property
    def scan_count(self) -> int:
        """Number of scans, clouds or frames so far that have a pose."""
        return len(self._scan_readings)

    def add_wheel(self, stamp_s: float, pose: FloatArray | None, reported_s: float | None = None) -> None:
        """Add a reading with the wheels' pose (3,), odom frame; None if there is none."""
        self._stamps_s.append(stamp_s)
        self._reported_s.append(stamp_s if reported_s is None else reported_s)
        self._wheel_poses.extend((np.nan,) * 3 if pose is None else pose)

    def add_scan(
        self,
        stamp_s: float,
        pose: Pose,
        wheel_pose: FloatArray | None = None,
        *,
        covariance: FloatArray | None = None,
        trusted: bool = True,
        reported_s: float | None = None,
    ) -> None:
        """Add a scan with its pose in the odometry frame; an untrusted one is no anchor for others.

        Parameters
        ----------
        covariance
            (d, d) of the pose against the scans around it, GTSAM's order; None if nothing measured it.
        reported_s
            Stamp in the log, if it differs from that of the pose.
        """
        variances = [math.nan] * 6
        if covariance is not None:
            own = covariance.diagonal().tolist()
            # Of position and rotation along x, y, z, from GTSAM's order; zero for axes that a plane lacks.
            variances = [*own[:2], 0.0, 0.0, 0.0, own[2]] if len(own) == 3 else own[3:] + own[:3]
        self._scan_variances.extend(variances)
        self._scan_readings.append(len(self._stamps_s))
        self._scan_trusted.append(trusted)
        self._scan_poses.extend(spatial(pose).matrix()[:3].ravel().tolist())
        self.add_wheel(stamp_s, wheel_pose, reported_s)

    def restamp(self, scans: NDArray[np.int64], stamps_s: FloatArray) -> None:
        """Correct the times (M,) of scans (M,)."""
        for reading, stamp_s in zip(np.array(self._scan_readings)[scans], stamps_s, strict=True):
            self._stamps_s[reading] = self._reported_s[reading] = stamp_s

    def read_wheels_at(self, ahead_s: float, scans: NDArray[np.int64] | None = None) -> None:
        """Read the wheels' pose of each reading again: their stamps are ahead by this offset.

        Wheel stamps that run backward start a new sequence: the log order is that of the readings.

        Parameters
        ----------
        scans
            (M,) the only scans to update.
        """
        stamps_s, poses = np.array(self._stamps_s), np.array(self._wheel_poses).reshape(-1, 3)
        updated = np.arange(len(poses)) if scans is None else np.array(self._scan_readings)[scans]
        of_wheels = ~np.isnan(poses[:, 0])
        of_wheels[self._scan_readings] = False
        wheel_readings = np.flatnonzero(of_wheels)
        breaks = wheel_readings[1:][np.diff(stamps_s[wheel_readings]) < 0.0]
        for part in np.split(np.arange(len(poses)), breaks) if wheel_readings.size else []:
            known, part = part[of_wheels[part]], np.intersect1d(part, updated)
            rows = np.column_stack([poses[known, :2], np.unwrap(poses[known, 2])])
            for column, values in enumerate(rows.T):
                poses[part, column] = np.interp(stamps_s[part] + ahead_s, stamps_s[known], values)
        self._wheel_poses = array("d", poses.ravel())

    def mark_keyframe(self) -> None:
        """Mark the newest scan as a keyframe."""
        self._keyframe_scans.append(self.scan_count - 1)

    def keyframe_scans(self) -> NDArray[np.int64]:
        """(K,) scan number of each keyframe."""
        return np.array(self._keyframe_scans, dtype=np.int64)

    def scan_stamps_s(self) -> FloatArray:
        """(S,) stamps of the scans in the log."""
        return np.array(self._reported_s)[np.array(self._scan_readings, dtype=np.int64)]

    def keyframe_wheels(self) -> FloatArray:
        """(K, 3) pose of the wheels at each keyframe, odom frame; NaN if there is none."""
        return np.array(self._wheel_poses).reshape(-1, 3)[self.keyframe_readings()]

    def keyframe_readings(self) -> NDArray[np.int64]:
        """(K,) number of each keyframe among all readings."""
        return np.array(self._scan_readings, dtype=np.int64)[self.keyframe_scans()]

    def placed(self) -> NDArray[np.int64]:
        """Numbers of the readings with a pose from a scan; the path between is by wheels, or a guess."""
        return np.array(self._scan_readings, dtype=np.int64)[self._trusted()]

    def fixed(self, open_sigma_m: float) -> NDArray[np.int64]:
        """As `placed`, without wheels only those with a smaller sigma: scans that leave no direction open."""
        placed = self.placed()
        if self.wheels() is not None:
            return placed
        variances = np.array(self._scan_variances).reshape(-1, 6)[self._trusted(), :2].max(axis=1)
        return placed[~(variances >= open_sigma_m**2)]

    def wheels(self) -> Poses | None:
        """The wheels' pose at every reading, odom frame; None without wheels."""
        rows = np.array(self._wheel_poses).reshape(-1, 3)
        known = np.flatnonzero(~np.isnan(rows[:, 0]))
        if not known.size:
            return None
        # Only what came before the first odometry reading is unknown: the wheels had not turned yet.
        rows[: known[0]] = rows[known[0]]
        return Poses.planar(rows)

    def trajectory(self, keyframe_poses: Sequence[Pose]) -> Trajectory:
        """Return the pose of every reading.

        Parameters
        ----------
        keyframe_poses
            (K,) optimised poses, map frame, K > 0.
        """
        stamps_s, motion = np.array(self._stamps_s), self.wheels()
        trusted, scans = self._trusted(), self.placed()
        poses = self._scans_of(Poses.of(keyframe_poses), motion)[trusted]
        if motion is None:
            motion = _motion_without_wheels(stamps_s, scans, poses)
        spread = spread_correction(motion, scans, poses).trajectory(stamps_s)
        return at_stamps(spread, np.array(self._reported_s), (self._scan_readings[0], self.before_first))

    def _trusted(self) -> BoolArray:
        """Return (S,) which scans are anchors for the others: keyframes, and trusted scans."""
        trusted = np.array(self._scan_trusted, dtype=np.bool_)
        trusted[self.keyframe_scans()] = True
        return trusted

    def _scans_of(self, keyframe_poses: Poses, wheels: Poses | None) -> Poses:
        """Return the poses of the scans: as matched between keyframes, smoothed by the wheel motion."""
        keyframes, variances = self.keyframe_scans(), np.array(self._scan_variances).reshape(-1, 6)
        rows = np.array(self._scan_poses).reshape(-1, 3, 4)
        odometry = Poses(rows[:, :, 3], scipy.spatial.transform.Rotation.from_matrix(rows[:, :, :3]))
        matched = spread_correction(odometry, keyframes, keyframe_poses, np.isnan(variances[:, 0]))
        if wheels is None:
            return matched
        bridged = spread_correction(wheels[np.array(self._scan_readings)], keyframes, keyframe_poses)
        return steadied(matched, bridged, variances, keyframes)


def at_stamps(
    trajectory: Trajectory, stamps_s: FloatArray, measured: tuple[int, FloatArray] | None = None
) -> Trajectory:
    """Return a pose for each of other stamps (N,), in the order of the trajectory's own and near them.

    It is on the parabola through a pose and its neighbours: at the beginning of a corner, a car half a
    revolution earlier has another heading than constant motion predicts.

    Parameters
    ----------
    measured
        Number of a pose, and its motion (6,) to the other stamp, GTSAM's tangent, NaN where unknown: at the
        first pose a corner may just have begun, which later ones do not show.
    """
    own_s = trajectory.stamps_s
    if len(own_s) < 2 or np.array_equal(own_s, stamps_s):
        return Trajectory(stamps_s, trajectory.positions_m, trajectory.quaternions_xyzw)
    poses, steps_s = trajectory.poses(), np.diff(own_s)
    steps_s[steps_s <= 0.0] = 1.0 / TINY  # a repeated or late stamp gives no motion
    twists = np.array([gtsam.Pose3.Logmap(last.between(next_)) for last, next_ in pairwise(poses)])
    around_s = np.pad(steps_s, 1, mode="edge")
    near_s = np.minimum(around_s[:-1], around_s[1:])[:, None]
    late_s = np.clip((stamps_s - own_s)[:, None], -near_s, near_s)
    steps_s = steps_s[:, None]
    rates, changes = twists / steps_s, np.zeros((len(poses), 6))
    changes[1:-1] = 2.0 * np.diff(rates, axis=0) / (steps_s[1:] + steps_s[:-1])
    # The first and last pose are on the parabola of their neighbour.
    changes[[0, -1]] = changes[[1, -2]]
    speeds = rates - 0.5 * steps_s * changes[:-1]
    speeds = np.vstack([speeds, rates[-1:] + 0.5 * steps_s[-1:] * changes[-1:]])
    offsets = late_s * (speeds + 0.5 * late_s * changes)
    if measured is not None:
        offsets[measured[0]] = np.where(np.isnan(measured[1]), offsets[measured[0]], measured[1])
    moved = [pose.compose(gtsam.Pose3.Expmap(offset)) for pose, offset in zip(poses, offsets, strict=True)]
    return Poses.of(moved).trajectory(stamps_s)


def _motion_without_wheels(stamps_s: FloatArray, scans: NDArray[np.int64], poses: Poses) -> Poses:
    """Return a motion that only gives the share of time between two scans for each reading."""
    numbers = np.arange(stamps_s.size)
    before = np.clip(np.searchsorted(scans, numbers, side="right") - 1, 0, scans.size - 1)
    after = np.clip(before + 1, 0, scans.size - 1)
    span = stamps_s[scans[after]] - stamps_s[scans[before]]
    share = np.zeros((stamps_s.size, 1))
    known = span > 0.0
    share[known, 0] = ((stamps_s - stamps_s[scans[before]])[known] / span[known]).clip(0.0, 1.0)
    first, last = poses[before], poses[after]
    turn = (last.rotations * first.rotations.inv()).as_rotvec()
    return first.moved(share * np.hstack([last.positions_m - first.positions_m, turn]))
