"""Applies a calibration to frames, clouds, IMU readings and GNSS fixes."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np

from slam.config.calibration import CameraCorrection, CloudCorrection, GnssCorrection, ImuCorrection, Mounting
from slam.measurements import (
    AnyFloatArray,
    Float32Array,
    FloatArray,
    GnssFix,
    ImuReading,
    PointCloud,
    RgbdFrame,
)
from slam.vision.camera_frame import T_BODY_CAMERA


def corrected_frame(fix: CameraCorrection, frame: RgbdFrame) -> RgbdFrame:
    """Correct a frame; its images are copied only if they change."""
    color, depth_m, lens, mounting = frame.color, frame.depth_m, frame.intrinsics, frame.T_base_camera
    if fix.depth_scale != 1.0:
        depth_m = depth_m * np.float32(fix.depth_scale)
    if fix.mirrored:
        color, depth_m = color[:, ::-1].copy(), depth_m[:, ::-1].copy()
        lens = replace(lens, cx=lens.width - 1.0 - lens.cx)
    if fix.intrinsics is not None:
        lens = replace(lens, **fix.intrinsics.model_dump())
    if fix.T_base_camera is not None:
        mounting = mounted(fix.T_base_camera).compose(T_BODY_CAMERA)
    return replace(frame, color=color, depth_m=depth_m, intrinsics=lens, T_base_camera=mounting)


def corrected_cloud(fix: CloudCorrection, cloud: PointCloud) -> PointCloud:
    """Correct a cloud of a 3D lidar."""
    times_s = retimed(cloud, fix.times_scale).times_s
    if times_s is None and fix.turn_s != 0.0:
        times_s = turn_times(cloud.points_lidar, fix.turn_s, math.radians(fix.cut_deg))
    cloud = beyond(replace(cloud, times_s=times_s), fix.range_min_m)
    return replace(
        cloud,
        points_lidar=raised(cloud.points_lidar, fix.elevation_deg) * np.float32(fix.range_scale),
        T_base_lidar=cloud.T_base_lidar if fix.T_base_lidar is None else mounted(fix.T_base_lidar),
    )


def beyond(cloud: PointCloud, range_m: float) -> PointCloud:
    """Return a cloud without the points within a range, whose times are not of the remaining ones."""
    if range_m == 0.0:
        return cloud
    kept = np.sum(cloud.points_lidar**2, axis=1) > range_m**2
    times_s = None if cloud.times_s is None else cloud.times_s[kept]
    intensities = None if cloud.intensities is None else cloud.intensities[kept]
    return replace(cloud, points_lidar=cloud.points_lidar[kept], times_s=times_s, intensities=intensities)


def retimed(cloud: PointCloud, scale: float) -> PointCloud:
    """Return a cloud with scaled times of its points; by a negative scale also reversed within their span."""
    told_s = cloud.times_s
    if told_s is None:
        return cloud
    in_order_s = told_s if scale > 0.0 else told_s.min() + told_s.max() - told_s
    return replace(cloud, times_s=in_order_s if abs(scale) == 1.0 else abs(scale) * in_order_s)


def turn_times(points_lidar: AnyFloatArray, turn_s: float, cut_rad: float) -> FloatArray:
    """Times of a spinning lidar's points relative to the middle of a revolution, by bearing, in s, (N,).

    Parameters
    ----------
    points_lidar
        (N, 2 or 3), frame of the lidar; the time of a NaN point is 0.
    turn_s, cut_rad
        Duration of a revolution, < 0 clockwise, and the bearing at which it starts.
    """
    turns = (bearings_rad(points_lidar) - cut_rad) / math.tau
    times_s = turn_s * (turns - np.floor(turns) - 0.5)  # a tenth of the time of np.mod
    times_s[np.isnan(times_s)] = 0.0
    return times_s


def bearings_rad(points: AnyFloatArray) -> FloatArray:
    """Bearings of points (N, 3) about the vertical axis, counter-clockwise from x, (N,)."""
    return np.arctan2(points[:, 1], points[:, 0], dtype=np.float64)


def raised(points_lidar: Float32Array, elevation_deg: float) -> Float32Array:
    """Points with every beam rotated up, (N, 3); bearing and range are unchanged."""
    if elevation_deg == 0.0:
        return points_lidar
    across = np.maximum(np.hypot(points_lidar[:, 0], points_lidar[:, 1]), np.finfo(np.float32).tiny)
    turn_rad = math.radians(elevation_deg)
    outward = across * math.cos(turn_rad) - points_lidar[:, 2] * math.sin(turn_rad)
    up = across * math.sin(turn_rad) + points_lidar[:, 2] * math.cos(turn_rad)
    return np.column_stack([points_lidar[:, :2] * (outward / across)[:, None], up]).astype(np.float32)


def corrected_imu(fix: ImuCorrection, reading: ImuReading) -> ImuReading:
    """Correct an IMU reading."""
    mounting = reading.T_base_imu if fix.T_base_imu is None else mounted(fix.T_base_imu)
    rate, force = fix.gyro_scale * reading.gyro_rad_s, fix.force_scale * reading.specific_force_m_s2
    return replace(reading, gyro_rad_s=rate, specific_force_m_s2=force, T_base_imu=mounting)


def corrected_fix(correction: GnssCorrection, fix: GnssFix) -> GnssFix:
    """Correct a GNSS fix."""
    return fix if correction.antenna_m is None else replace(fix, antenna_m=np.array(correction.antenna_m))


def mounted(mounting: Mounting) -> gtsam.Pose3:
    """``T_base_body`` of a mounting."""
    yaw, pitch, roll = (
        math.radians(angle) for angle in (mounting.yaw_deg, mounting.pitch_deg, mounting.roll_deg)
    )
    return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array([mounting.x_m, mounting.y_m, mounting.z_m]))
