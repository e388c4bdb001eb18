"""Converts readings to ROS 2 messages (types of Humble), without ROS."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.measurements import CameraIntrinsics, Float32Array, FloatArray, GnssFix, LaserScan
from slam.simulation.carmen_writer import written_ranges_m
from slam.storage.ros_messages import cloud_message, header, new, pose_message, vector

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
NAVSAT = "sensor_msgs/msg/NavSatFix"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"

DEPTH_STEPS_PER_M = 1000.0  # 16UC1 depth is in millimetres, by REP-118


def laser_scan(scan: LaserScan, frame_id: str, range_min_m: float, period_s: float) -> Any:
    """A LaserScan message with ranges in whole millimetres; no return is ``inf``, invalid ``nan`` (REP-117).

    The scan is instantaneous, so the time between beams is zero.
    """
    # As in the log of the drive.
    printed = np.round(written_ranges_m(scan), 3)
    ranges = np.where(np.isfinite(scan.ranges_m), printed, scan.ranges_m)
    return new(
        LASER_SCAN,
        header=header(scan.stamp_s, frame_id),
        angle_min=scan.start_angle_rad,
        angle_max=scan.start_angle_rad + scan.step_rad * (scan.ranges_m.size - 1),
        angle_increment=scan.step_rad,
        time_increment=0.0,
        scan_time=period_s,
        range_min=range_min_m,
        range_max=scan.range_max_m,
        ranges=ranges.astype(np.float32),
        intensities=np.zeros(0, dtype=np.float32),
    )


def point_cloud(
    points_laser: Float32Array, further: dict[str, NDArray[Any]], stamp_s: float, frame_id: str
) -> Any:
    """A PointCloud2 message of x, y, z and further fields (N,) of the points, one unordered row."""
    columns = {**dict(zip("xyz", points_laser.T.astype(np.float32), strict=True)), **further}
    kinds = [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()]
    packed = np.empty(len(points_laser), np.dtype(kinds))
    for name, values in columns.items():
        packed[name] = values
    return cloud_message(packed, stamp_s, frame_id)


def imu(stamp_s: float, gyro_rad_s: FloatArray, specific_force_m_s2: FloatArray, frame_id: str) -> Any:
    """An Imu message without orientation; covariances of zero mean unknown."""
    return new(
        IMU,
        header=header(stamp_s, frame_id),
        orientation=new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0, *[0.0] * 8]),
        angular_velocity=vector(gyro_rad_s),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(specific_force_m_s2),
        linear_acceleration_covariance=np.zeros(9),
    )


def navsat(fix: GnssFix, frame_id: str) -> Any:
    """A NavSatFix message of GPS without corrections."""
    assert fix.covariance_m2 is not None
    return new(
        NAVSAT,
        header=header(fix.stamp_s, frame_id),
        status=new("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        latitude=fix.latitude_deg,
        longitude=fix.longitude_deg,
        altitude=fix.altitude_m,
        position_covariance=fix.covariance_m2.ravel(),
        position_covariance_type=2,  # its diagonal is known
    )


def camera_info(intrinsics: CameraIntrinsics, stamp_s: float, frame_id: str) -> Any:
    """A CameraInfo message of a pinhole camera without distortion."""
    k = [[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]]
    region = new(
        "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return new(
        CAMERA_INFO,
        header=header(stamp_s, frame_id),
        height=intrinsics.height,
        width=intrinsics.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=np.array(k).ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([np.array(k), np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def odometry(
    stamp_s: float, pose: gtsam.Pose3, twist: tuple[float, float], frame_id: str, child_frame_id: str
) -> Any:
    """An Odometry message; covariances of zero mean unknown."""
    twist_message = new(
        "geometry_msgs/msg/Twist",
        linear=vector(np.array([twist[0], 0.0, 0.0])),
        angular=vector(np.array([0.0, 0.0, twist[1]])),
    )
    return new(
        ODOMETRY,
        header=header(stamp_s, frame_id),
        child_frame_id=child_frame_id,
        pose=new("geometry_msgs/msg/PoseWithCovariance", pose=pose_message(pose), covariance=np.zeros(36)),
        twist=new("geometry_msgs/msg/TwistWithCovariance", twist=twist_message, covariance=np.zeros(36)),
    )


def image(
    pixels: NDArray[np.uint8] | NDArray[np.uint16], encoding: str, stamp_s: float, frame_id: str
) -> Any:
    """An Image message of little-endian rows without padding."""
    height, width = pixels.shape[:2]
    little = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<"))
    data = little.view(np.uint8).reshape(-1)
    return new(
        IMAGE,
        header=header(stamp_s, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=data.size // height,
        data=data,
    )
