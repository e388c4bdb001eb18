"""Writes a drive as a rosbag2 in MCAP, as a stream; equal drives give equal bytes."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import gtsam
import numpy as np

from slam.simulation import ros_messages as ros
from slam.simulation.drive import Drive
from slam.simulation.events import CloudEvent, DriveEvent, ImageEvent, OdometryEvent, ScanEvent
from slam.simulation.tum_writer import depth_steps
from slam.storage import ros_messages as messages

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

BAG_FILES = ("log.mcap", "metadata.yaml")
ODOM_FRAME, BASE_FRAME, IMU_FRAME = "odom", "base_link", "imu"
LASER_FRAME, LASER_3D_FRAME = "laser", "laser_3d"


def camera_frame(camera: str) -> str:
    """Return the name of a camera's optical frame."""
    return f"{camera_topic(camera)[1:]}_optical_frame"


def camera_topic(camera: str) -> str:
    """Return the topic prefix of a camera: ``/camera`` for "camera", ``/camera_1`` for "RGBD_1"."""
    plain = camera.lower().removeprefix("rgbd_")
    return f"/{plain}" if plain.startswith("camera") else f"/camera_{plain}"


class BagWriter:
    """A rosbag2; use it as a context manager.

    Topics: ``/scan``, ``/points`` (3D lidar), ``/imu``, ``/odom``, ``/tf`` (odom to base_link),
    ``/tf_static`` and for each camera ``color/image_raw``, ``color/camera_info``, ``depth/image_raw``,
    ``depth/camera_info``. A message's header has the sensor's stamp; the bag's time is the true arrival time.
    The ground truth (map to odom) is not in the bag.

    Parameters
    ----------
    folder
        Created, with ``log.mcap`` and ``metadata.yaml``; its name must be ``log``.
    compress
        Compress the chunks with zstd.
    """

    def __init__(self, folder: Path, drive: Drive, first_stamp_s: float, *, compress: bool = False) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        self._drive = drive
        self._writer = Writer(folder, version=messages.BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        if compress:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._connections: dict[str, Connection] = {}
        self._first_stamp_s = first_stamp_s
        self._felt = iter(()) if drive.imu is None else drive.imu.messages(first_stamp_s, IMU_FRAME)
        self._next = next(self._felt, None)

    def __enter__(self) -> Self:
        self._writer.open()
        self._connect()
        self._send(
            "/tf_static",
            self._first_stamp_s,
            messages.transforms(self._first_stamp_s, BASE_FRAME, mounts(self._drive)),
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the bag; after an error without its index, so that it does not look complete."""
        self._writer.__exit__(kind, error, trace)

    def write(self, event: DriveEvent) -> None:
        """Write a reading, after the IMU readings until then; the ground truth is left out."""
        while self._next is not None and self._next[0] <= event.true_stamp_s:
            self._send("/imu", *self._next)
            self._next = next(self._felt, None)
        if isinstance(event, ScanEvent):
            self._scan(event)
        elif isinstance(event, CloudEvent):
            ring = {"ring": event.ring.astype(np.uint16)}
            message = ros.point_cloud(event.points_laser, ring, event.stamp_s, LASER_3D_FRAME)
            self._send("/points", event.true_stamp_s, message)
        elif isinstance(event, ImageEvent):
            self._image(event)
        elif isinstance(event, OdometryEvent):
            self._odometry(event)

    def _connect(self) -> None:
        """Announce all topics in a fixed order, also those that may stay empty."""
        topics = {"/tf_static": messages.TRANSFORMS, "/tf": messages.TRANSFORMS, "/odom": ros.ODOMETRY}
        if self._drive.rig.lidar is not None:
            topics["/scan"] = ros.LASER_SCAN
        if self._drive.rig.lidar_3d is not None:
            topics["/points"] = messages.POINT_CLOUD
        if self._drive.imu is not None:
            topics["/imu"] = ros.IMU
        for camera in self._drive.rig.cameras:
            for kind in ("color", "depth"):
                topics[f"{camera_topic(camera.name)}/{kind}/image_raw"] = ros.IMAGE
                topics[f"{camera_topic(camera.name)}/{kind}/camera_info"] = ros.CAMERA_INFO
        for topic, kind in topics.items():
            self._connections[topic] = self._writer.add_connection(
                topic,
                kind,
                typestore=messages.typestore(),
                offered_qos_profiles=[messages.latched()] if topic == "/tf_static" else (),
            )

    def _send(self, topic: str, true_stamp_s: float, message: Any) -> None:
        """Write one message."""
        connection = self._connections[topic]
        content = messages.typestore().serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, messages.nanoseconds(true_stamp_s), content)

    def _scan(self, event: ScanEvent) -> None:
        """Write a scan."""
        lidar = self._drive.rig.lidar
        if lidar is not None:
            model = lidar.model
            message = ros.laser_scan(event.scan, LASER_FRAME, model.range_min_m, 1.0 / model.rate_hz)
            self._send("/scan", event.true_stamp_s, message)

    def _image(self, event: ImageEvent) -> None:
        """Write one camera: two images and their intrinsics; depth is registered to colour."""
        frame, at_s = event.frame, event.true_stamp_s
        topic, frame_id = camera_topic(frame.sensor), camera_frame(frame.sensor)
        depth = depth_steps(frame.depth_m, ros.DEPTH_STEPS_PER_M)
        images = {
            "color": ros.image(frame.color, "rgb8", frame.stamp_s, frame_id),
            "depth": ros.image(depth, "16UC1", frame.stamp_s, frame_id),
        }
        info = ros.camera_info(frame.intrinsics, frame.stamp_s, frame_id)
        for kind, image in images.items():
            self._send(f"{topic}/{kind}/image_raw", at_s, image)
            self._send(f"{topic}/{kind}/camera_info", at_s, info)

    def _odometry(self, event: OdometryEvent) -> None:
        """Write the wheel odometry as a message and as a transform."""
        stamp_s, pose = event.reading.stamp_s, gtsam.Pose3(event.reading.T_odom_base)
        message = ros.odometry(stamp_s, pose, event.twist, ODOM_FRAME, BASE_FRAME)
        self._send("/odom", event.true_stamp_s, message)
        self._send("/tf", event.true_stamp_s, messages.transforms(stamp_s, ODOM_FRAME, {BASE_FRAME: pose}))


def mounts(drive: Drive) -> dict[str, gtsam.Pose3]:
    """Return the mounting of each sensor on the robot, by the frame's name."""
    poses = {camera_frame(camera.name): camera.T_base_camera for camera in drive.rig.cameras}
    if drive.rig.lidar is not None:
        poses[LASER_FRAME] = drive.rig.lidar.T_base_laser
    if drive.rig.lidar_3d is not None:
        poses[LASER_3D_FRAME] = drive.rig.lidar_3d.T_base_laser
    if drive.rig.imu is not None:
        poses[IMU_FRAME] = drive.rig.imu.T_body_imu
    return poses
