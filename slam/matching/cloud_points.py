"""From a turn of a 3D lidar to the points that are matched: checked, deskewed, in the base frame."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from fusion.height_band import thin_to_voxels
from slam.config.clouds import CloudOdometryConfig
from slam.measurements import FloatArray, PointCloud

# Times that span less than the first are no turn, more than the second are by no clock of a lidar.
_SHORTEST_TURN_S, _LONGEST_TURN_S = 2e-3, 2.0
# A turn is cut into so many slices; within one the robot stands.
SLICES = 64


def base_points(cloud: PointCloud, twist: FloatArray, config: CloudOdometryConfig) -> FloatArray:
    """(M, 3) usable points in the base frame at the cloud's stamp.

    Parameters
    ----------
    twist
        (6,) motion of the base a second, GTSAM's tangent, by which the turn is deskewed where the points'
        times are known.
    """
    points = np.asarray(cloud.points_lidar, dtype=np.float64).reshape(-1, 3)
    with np.errstate(invalid="ignore", over="ignore"):
        squares = np.einsum("ij,ij->i", points, points)
        usable = (squares >= config.range_min_m**2) & (squares <= config.range_max_m**2)
    T = cloud.T_base_lidar
    points = points[usable] @ T.rotation().matrix().T + T.translation()
    if not deskewed(cloud, config) or not twist.any():
        return points
    return _deskewed(points, np.asarray(cloud.times_s)[usable], twist)


def deskewed(cloud: PointCloud, config: CloudOdometryConfig) -> bool:
    """Whether the motion within a turn is undone."""
    return config.deskew and cloud.times_s is not None and turn_known(cloud.times_s)


def at_middle_of_turn(cloud: PointCloud, config: CloudOdometryConfig) -> PointCloud:
    """The same points, stamped in the middle of the turn where it is deskewed.

    There a twist that is a bit off moves nothing to first order. At the beginning it moves the pose, the next
    twist is off by as much the other way, and so on, without end.
    """
    if not deskewed(cloud, config) or cloud.times_s is None:
        return cloud
    after_s = 0.5 * float(cloud.times_s.min() + cloud.times_s.max())
    return replace(cloud, stamp_s=cloud.stamp_s + after_s, times_s=cloud.times_s - after_s)


def turn_known(times_s: FloatArray) -> bool:
    """Whether the times of points are those of a turn, not all the same or by some other clock."""
    if not len(times_s) or not np.isfinite(times_s).all():
        return False
    span_s = float(np.ptp(times_s))
    return _SHORTEST_TURN_S <= span_s <= _LONGEST_TURN_S and bool(np.abs(times_s).max() <= _LONGEST_TURN_S)


def voxel_of(points: FloatArray, config: CloudOdometryConfig) -> float:
    """The side of a voxel: as configured, else a share of the median range."""
    if config.voxel_m is not None:
        return config.voxel_m
    median_m = float(np.median(np.linalg.norm(points, axis=1)))
    return float(np.clip(config.scale_share * median_m, config.least_voxel_m, config.greatest_voxel_m))


def thinned(points: FloatArray, voxel_m: float) -> FloatArray:
    """One point a voxel."""
    return thin_to_voxels(points, voxel_m)


def _deskewed(points: FloatArray, times_s: FloatArray, twist: FloatArray) -> FloatArray:
    """Points as they would be seen at the stamp, by a constant twist."""
    first_s, last_s = float(times_s.min()), float(times_s.max())
    if last_s <= first_s:
        return points
    slices = np.minimum(((times_s - first_s) / (last_s - first_s) * SLICES).astype(np.int64), SLICES - 1)
    middles_s = first_s + (np.arange(SLICES) + 0.5) * (last_s - first_s) / SLICES
    poses = [gtsam.Pose3.Expmap(twist * time_s) for time_s in middles_s]
    rotations = np.array([pose.rotation().matrix() for pose in poses])
    shifts = np.array([pose.translation() for pose in poses])
    return np.asarray(np.einsum("nij,nj->ni", rotations[slices], points) + shifts[slices])
