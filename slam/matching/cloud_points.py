"""Convert a revolution of a 3D lidar to points for matching: checked, deskewed, in the base frame."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ZERO, kernel
from slam.config.clouds import CloudOdometryConfig
from slam.measurements import Float32Array, FloatArray, PointCloud

# Shortest and longest time span of a revolution.
_SHORTEST_TURN_S, _LONGEST_TURN_S = 2e-3, 2.0
# A revolution has so many slices; within one the pose is constant.
SLICES = 64


def base_points(cloud: PointCloud, twist: FloatArray, config: CloudOdometryConfig) -> FloatArray:
    """Return (M, 3) usable points in the base frame at the cloud's stamp.

    Parameters
    ----------
    twist
        (6,) motion of the base per second, GTSAM's tangent, for deskewing if the points' times are known.
    """
    placed, numbers = _usable(cloud, config)
    if len(placed) and cloud.times_s is not None and deskewed(cloud, config) and twist.any():
        _straighten(placed, np.asarray(cloud.times_s, dtype=np.float64)[numbers], twist)
    return placed


def usable_intensities(cloud: PointCloud, config: CloudOdometryConfig) -> Float32Array | None:
    """Return (M,) intensities of the points of `base_points`; None if the cloud has none."""
    return None if cloud.intensities is None else cloud.intensities[_usable(cloud, config)[1]]


def deskewed(cloud: PointCloud, config: CloudOdometryConfig) -> bool:
    """Return whether the motion within a revolution is corrected."""
    return config.deskew and cloud.times_s is not None and turn_known(cloud.times_s)


def at_middle_of_turn(cloud: PointCloud, config: CloudOdometryConfig) -> PointCloud:
    """Return the same points, stamped at the middle of the revolution if it is deskewed.

    There, a small error of the twist has no first-order effect. At the start, it shifts the pose, the next
    twist is wrong by as much in the other direction, and so on.
    """
    if not deskewed(cloud, config) or cloud.times_s is None:
        return cloud
    after_s = 0.5 * float(cloud.times_s.min() + cloud.times_s.max())
    return replace(cloud, stamp_s=cloud.stamp_s + after_s, times_s=cloud.times_s - after_s)


def turn_known(times_s: FloatArray) -> bool:
    """Return whether the times of points span a revolution: not all equal, and not of another clock."""
    if not len(times_s):
        return False
    first_s, last_s = float(times_s.min()), float(times_s.max())  # NaN if one is
    return _SHORTEST_TURN_S <= last_s - first_s <= _LONGEST_TURN_S >= max(-first_s, last_s)


def voxel_of(points: FloatArray, config: CloudOdometryConfig) -> float:
    """Return the side of a voxel: as configured, else a share of the median range."""
    if config.voxel_m is not None:
        return config.voxel_m
    median_m = float(np.median(np.linalg.norm(points, axis=1)))
    return float(np.clip(config.scale_share * median_m, config.least_voxel_m, config.greatest_voxel_m))


def _usable(cloud: PointCloud, config: CloudOdometryConfig) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return (M, 3) points that are neither too near nor too far, base frame, and their indices (M,)."""
    points = np.asarray(cloud.points_lidar).reshape(-1, 3)
    T = cloud.T_base_lidar
    placed, numbers = np.empty((len(points), 3)), np.empty(len(points), np.int64)
    rotation, least_m, most_m = T.rotation().matrix(), config.range_min_m, config.range_max_m
    count = _within(points, rotation, T.translation(), least_m**2, most_m**2, placed, numbers)
    return placed[:count], numbers[:count]


def _straighten(points: FloatArray, times_s: FloatArray, twist: FloatArray) -> None:
    """Deskew points to the stamp with a constant twist."""
    first_s, last_s = float(times_s.min()), float(times_s.max())
    if last_s <= first_s:
        return
    middles_s = first_s + (np.arange(SLICES) + 0.5) * (last_s - first_s) / SLICES
    poses = [gtsam.Pose3.Expmap(twist * time_s) for time_s in middles_s]
    rotations = np.array([pose.rotation().matrix() for pose in poses])
    shifts = np.array([pose.translation() for pose in poses])
    _move(points, (times_s - first_s) / (last_s - first_s) * SLICES, rotations, shifts)


@kernel
def _within(points, rotation, shift, least, most, placed, numbers):  # type: ignore[no-untyped-def]
    """Write transformed points (N, 3) between two squared distances, and indices; return their number."""
    count = ZERO
    for i in range(points.shape[0]):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        z = np.float64(points[i, 2])
        square = x * x + y * y + z * z
        if least <= square <= most:
            for k in range(3):
                placed[count, k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z + shift[k]
            numbers[count] = i
            count += 1
    return count


@kernel
def _move(points, slices, rotations, shifts):  # type: ignore[no-untyped-def]
    """Transform each point (N, 3), in place, by the pose of its slice (N,)."""
    last = rotations.shape[0] - 1
    for i in range(points.shape[0]):
        n = min(int(slices[i]), last)
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        for k in range(3):
            points[i, k] = (
                rotations[n, k, 0] * x + rotations[n, k, 1] * y + rotations[n, k, 2] * z + shifts[n, k]
            )
