"""Pairs of a lidar scan and the depth images nearest to it, with their truth, from a simulated drive.

Scans and images have the times of the sensors' own schedules, so a pair has the same time difference as on a
robot. Wheel odometry gives the motion in between, as in a log.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

import fusion
from slam.measurements import planar
from slam.simulation.drive import Drive
from slam.simulation.drive_faults import LIDAR
from slam.simulation.rigs import MountedCamera, MountedLidar
from slam.simulation.scene import Scene
from slam.simulation.sensor_clock import Schedule, generator
from slam.simulation.sensors import render_rgbd, scan_lidar

KEYFRAME_M, KEYFRAME_RAD = 0.5, 0.3
_TICK_S = 0.05
_NOISE = 1  # the stream of a sensor's noise, as the simulator draws it


@dataclass(frozen=True, slots=True)
class TrueImage:
    """A depth image and its truth.

    Attributes
    ----------
    depth
        As the camera gives it, levelled, and turned to where it looked when the scan was taken.
    true_depth_m, fault
        (H, W) what each pixel meets first, and what is wrong with its reading.
    T_laser_camera
        True pose of the optical frame in the laser's at the time of the scan.
    """

    depth: fusion.DepthImage
    true_depth_m: NDArray[np.float32]
    fault: NDArray[np.uint8]
    T_laser_camera: gtsam.Pose3


@dataclass(frozen=True, slots=True)
class TruePair:
    """A scan with its images, and the truth of both.

    Attributes
    ----------
    scan
        The lidar's curve.
    true_ranges_m, fault, obstacle
        (N,) of each beam: distance and id of what it meets first, what is wrong with its reading.
    images
        One for each camera.
    T_map_laser
        Where the laser stood.
    room
        Name of the room, or "between rooms".
    """

    scan: fusion.LidarCurve
    true_ranges_m: NDArray[np.float32]
    fault: NDArray[np.uint8]
    obstacle: NDArray[np.int32]
    images: tuple[TrueImage, ...]
    T_map_laser: gtsam.Pose2
    room: str


def simulate_pairs(drive: Drive, most: int) -> Iterator[TruePair]:
    """The pairs of a drive at its keyframes, in order.

    Parameters
    ----------
    most
        Where there are more keyframes, this many of them, evenly spread.
    """
    scene, lidar = Scene(drive.home), drive.rig.lidar
    assert lidar is not None
    for time_s in keyframe_times(drive, most):
        scan_at = _nearest(drive.schedules[LIDAR], time_s)
        yield _pair(drive, scene, lidar, scan_at)


def keyframe_times(drive: Drive, most: int) -> NDArray[np.float64]:
    """Seconds since the beginning: every `KEYFRAME_M` or `KEYFRAME_RAD`."""
    times = np.arange(0.0, drive.tour.duration_s, _TICK_S)
    poses = drive.tour.poses_at(times)
    kept, last = [0], poses[0]
    for index, pose in enumerate(poses):
        if np.hypot(*(pose - last)[:2]) >= KEYFRAME_M or abs(pose[2] - last[2]) >= KEYFRAME_RAD:
            kept.append(index)
            last = pose
    chosen = np.unique(np.linspace(0, len(kept) - 1, min(most, len(kept))).round().astype(int))
    return times[np.array(kept)[chosen]]


def true_camera_in_laser(lidar: MountedLidar, camera: MountedCamera) -> gtsam.Pose3:
    """``T_laser_camera`` as mounted."""
    return lidar.T_base_laser.between(camera.T_base_camera)


def _pair(drive: Drive, scene: Scene, lidar: MountedLidar, scan_at: int) -> TruePair:
    """One scan, and each camera's image nearest to it."""
    readings = drive.schedules[LIDAR]
    time_s = float(readings.true_s[scan_at])
    base = drive.base_at(time_s)
    T_map_laser = gtsam.Pose3(base).compose(lidar.T_base_laser)
    model = lidar.model
    seen = scan_lidar(scene, T_map_laser, model, generator(drive.seed, LIDAR, _NOISE, scan_at))
    scan = fusion.LidarCurve(seen.ranges_m, model.start_angle_rad, model.step_rad, model.range_max_m)
    room = next(
        (
            room.name
            for room in drive.home.rooms
            if room.rectangle[0] <= base.x() <= room.rectangle[2]
            and room.rectangle[1] <= base.y() <= room.rectangle[3]
        ),
        "between rooms",
    )
    return TruePair(
        scan=scan,
        true_ranges_m=seen.true_ranges_m,
        fault=seen.fault,
        obstacle=_obstacles(scene, T_map_laser, scan),
        images=tuple(_image(drive, scene, camera, scan_at) for camera in drive.rig.cameras),
        T_map_laser=planar(T_map_laser),
        room=room,
    )


def _image(drive: Drive, scene: Scene, camera: MountedCamera, scan_at: int) -> TrueImage:
    """The image nearest in time to a scan, turned by what the wheels say that the robot did in between."""
    scans, images = drive.schedules[LIDAR], drive.schedules[camera.name]
    image_at = _nearest(images, float(scans.true_s[scan_at]))
    image_s = float(images.true_s[image_at])
    T_map_camera = gtsam.Pose3(drive.base_at(image_s)).compose(camera.T_base_camera)
    random = generator(drive.seed, camera.name, _NOISE, image_at)
    seen = render_rgbd(scene, T_map_camera, camera.model, random)
    at_scan = drive.odometry_at(float(scans.stamps_s[scan_at]))
    turned = at_scan.between(drive.odometry_at(float(images.stamps_s[image_at]))).theta()
    intrinsics = camera.model.intrinsics
    assert drive.rig.lidar is not None
    T_map_laser = gtsam.Pose3(drive.base_at(float(scans.true_s[scan_at]))).compose(
        drive.rig.lidar.T_base_laser
    )
    return TrueImage(
        depth=fusion.DepthImage(
            seen.depth_m,
            fusion.Intrinsics(intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy),
            gtsam.Rot3.Rz(turned).compose(camera.T_base_camera.rotation()).matrix(),
        ),
        true_depth_m=seen.true_depth_m,
        fault=seen.fault,
        T_laser_camera=T_map_laser.between(T_map_camera),
    )


def _obstacles(scene: Scene, T_map_laser: gtsam.Pose3, scan: fusion.LidarCurve) -> NDArray[np.int32]:
    """(N,) ids of what the beams meet first."""
    bearings = scan.bearings_rad()
    directions = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(bearings.size)])
    origins = np.tile(T_map_laser.translation(), (bearings.size, 1))
    rays = np.hstack([origins, directions @ T_map_laser.rotation().matrix().T])
    return scene.cast(rays.astype(np.float32)).obstacle


def _nearest(readings: Schedule, time_s: float) -> int:
    """Index of the reading nearest to a time."""
    return int(np.argmin(np.abs(readings.true_s - time_s)))
