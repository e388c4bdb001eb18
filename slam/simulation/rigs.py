"""Robots with mounted sensors: the rigs of the three papers, and two simple ones.

Frame base: on the floor under the robot's centre, x forward, y left, z up. Camera poses are of the optical
frame: z forward, x right and y down in the image. If a paper gives no offset, the sensor is above the centre
and a comment says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.simulation.imu import ADIS_16448, MountedImu
from slam.simulation.sensor_models import (
    HOKUYO_URG_04LX,
    KINECT_V1,
    REALSENSE_D435I,
    RPLIDAR_A2,
    SICK_LMS_180,
    VLP_16,
    XTION_PRO_LIVE,
    CameraModel,
    LidarModel,
    RingLidarModel,
)


@dataclass(frozen=True, slots=True)
class MountedLidar:
    """A 2D lidar and its pose on the robot."""

    model: LidarModel
    T_base_laser: gtsam.Pose3


@dataclass(frozen=True, slots=True)
class MountedRingLidar:
    """A 3D lidar and its pose on the robot."""

    model: RingLidarModel
    T_base_laser: gtsam.Pose3


@dataclass(frozen=True, slots=True)
class MountedCamera:
    """A depth camera, the pose of its optical frame on the robot, and its name there."""

    model: CameraModel
    T_base_camera: gtsam.Pose3
    name: str


@dataclass(frozen=True, slots=True)
class Rig:
    """A robot: an upright cylinder about its base, with its sensors."""

    name: str
    lidar: MountedLidar | None
    cameras: tuple[MountedCamera, ...]
    robot_radius_m: float
    robot_height_m: float
    lidar_3d: MountedRingLidar | None = None
    imu: MountedImu | None = None


def camera_pose(
    position_m: tuple[float, float, float],
    yaw_rad: float = 0.0,
    pitch_rad: float = 0.0,
    roll_rad: float = 0.0,
) -> gtsam.Pose3:
    """Return ``T_base_camera`` of a camera with a body that looks along x before its rotation.

    Parameters
    ----------
    position_m
        Position of the optical centre, base frame.
    yaw_rad, pitch_rad, roll_rad
        Rotation of the body about z, then y, then x (the optical axis): a positive pitch looks down; with a
        roll of pi / 2, the right edge of the image points to the floor, with -pi / 2 to the ceiling.
    """
    body = gtsam.Rot3.Ypr(yaw_rad, pitch_rad, roll_rad)
    # Columns are the optical x, y, z in the body: right, down, forward.
    optical = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    return gtsam.Pose3(body.compose(optical), np.array(position_m))


def laser_pose(x_m: float, y_m: float, z_m: float) -> gtsam.Pose3:
    """Return ``T_base_laser`` of a level lidar that looks forward."""
    return gtsam.Pose3(gtsam.Rot3(), np.array([x_m, y_m, z_m]))


# IMU of `simulate --imu`: behind and beside the centre, pointing left, not exactly level.
ROBOT_IMU = MountedImu(
    ADIS_16448, gtsam.Pose3(gtsam.Rot3.Ypr(0.5 * math.pi, 0.05, -0.03), np.array([-0.06, 0.04, 0.12]))
)


def _li2020() -> Rig:
    """Low mobile robot; the paper gives no heights. The lidar's plane passes over its boxes 2 and 4."""
    return Rig(
        "li2020",
        MountedLidar(RPLIDAR_A2, laser_pose(0.0, 0.0, 0.3)),
        # Above the lidar, pitched down slightly, so that it sees the floor from 0.8 m on.
        (MountedCamera(KINECT_V1, camera_pose((0.1, 0.0, 0.45), pitch_rad=math.radians(8.0)), "camera"),),
        robot_radius_m=0.2,
        robot_height_m=0.5,
    )


def _yang2021(name: str, lidar: MountedLidar | None) -> Rig:
    """Camera at h = 0.68 m; workspace and offsets are not given: above the centre, 15 degrees down."""
    camera = camera_pose((0.0, 0.0, 0.68), pitch_rad=math.radians(15.0))
    return Rig(name, lidar, (MountedCamera(REALSENSE_D435I, camera, "camera"),), 0.2, 0.75)


# Robot@Home: x, y and yaw of RGBD_1 ... RGBD_4 from the dataset; height 0.92 m from Xu2024.
_ROBOT_AT_HOME_CAMERAS = (
    ("RGBD_1", 0.271, -0.031, -45.0),
    ("RGBD_2", 0.240, -0.045, -90.0),
    ("RGBD_3", 0.271, 0.031, 45.0),
    ("RGBD_4", 0.285, 0.000, 0.0),
)


def _xu2024() -> Rig:
    """Robot@Home: four cameras, rotated by 90 degrees, cover 180 degrees.

    An image rotated by 90 degrees counter-clockwise is upright. Each then has a horizontal view of 48
    degrees, at intervals of 45, so neighbours overlap by 3; the panorama extends from 114 degrees right to 69
    left.
    """
    cameras = tuple(
        MountedCamera(
            XTION_PRO_LIVE,
            camera_pose((x, y, 0.92), yaw_rad=math.radians(yaw), roll_rad=-0.5 * math.pi),
            name,
        )
        for name, x, y, yaw in _ROBOT_AT_HOME_CAMERAS
    )
    lidar = MountedLidar(HOKUYO_URG_04LX, laser_pose(0.205, 0.0, 0.31))
    return Rig("xu2024", lidar, cameras, robot_radius_m=0.25, robot_height_m=1.1)


def _turtlebot(name: str, lidar_z_m: float, camera_z_m: float) -> Rig:
    """Xu2024's own robot with one of its two pairs of heights; offsets are those of a Turtlebot 2's plates.

    The paper uses a Kinect 2; here it is a Kinect 1, because its faults are those in the papers.
    """
    camera = MountedCamera(KINECT_V1, camera_pose((-0.087, 0.0, camera_z_m)), "camera")
    lidar = MountedLidar(HOKUYO_URG_04LX, laser_pose(0.1, 0.0, lidar_z_m))
    return Rig(name, lidar, (camera,), robot_radius_m=0.18, robot_height_m=max(lidar_z_m, camera_z_m) + 0.06)


def _sick2d() -> Rig:
    """A research robot like those of the logs: only a SICK at the front."""
    return Rig("sick2d", MountedLidar(SICK_LMS_180, laser_pose(0.1, 0.0, 0.35)), (), 0.25, 0.5)


def _lidar3d() -> Rig:
    """A 16-ring lidar on a mast, and a camera in front of it and below."""
    return Rig(
        "lidar3d",
        None,
        (MountedCamera(REALSENSE_D435I, camera_pose((0.15, 0.0, 0.5)), "camera"),),
        robot_radius_m=0.22,
        robot_height_m=0.8,
        lidar_3d=MountedRingLidar(VLP_16, laser_pose(0.0, 0.0, 0.72)),
    )


RIGS: dict[str, Rig] = {
    rig.name: rig
    for rig in (
        _li2020(),
        _yang2021("yang2021", None),
        # Not in the paper: the same robot with a lidar, to compare the map of its camera with a lidar's.
        _yang2021("yang2021_lidar", MountedLidar(RPLIDAR_A2, laser_pose(0.05, 0.0, 0.25))),
        _xu2024(),
        _turtlebot("turtlebot_low", 0.25, 0.96),
        _turtlebot("turtlebot_high", 0.31, 0.25),
        _sick2d(),
        _lidar3d(),
    )
}
