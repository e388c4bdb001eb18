"""Bags of depth cameras with the topics, frames and encodings of their drivers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slam.measurements import CameraIntrinsics
from tools.layouts import messages as ros
from tools.layouts.messages import START_S, Sent
from tools.layouts.samples import CameraTruth, Sample, layout
from tools.layouts.world import OPTICAL, looked_at, placed, way

COUNT = 6
RATE_HZ = 15.0
STAMPS = [START_S + k / RATE_HZ for k in range(COUNT)]
LENS = CameraIntrinsics(305.0, 304.0, 158.0, 121.0, 320, 240)
DEPTH_LENS = CameraIntrinsics(212.0, 212.0, 211.0, 119.0, 424, 240)
WIDE = CameraIntrinsics(608.0, 608.0, 323.0, 181.0, 640, 360)
MOUNT = placed(0.1, 0.0, 0.9) @ OPTICAL  # on a robot
HELD = placed(0.0, 0.0, 1.3, pitch=0.1) @ OPTICAL
BESIDE = placed(-0.015, 0.0, 0.0)  # a colour camera in its depth camera's optical frame


def poses_of(mount: Any, count: int = COUNT) -> list[Any]:
    """Of a camera on the way."""
    return [base @ mount for base in way(count)]


def shots(lens: CameraIntrinsics, poses: list[Any], distortion: Any = None) -> list[Any]:
    """What it sees."""
    return [looked_at(lens, pose, distortion) for pose in poses]


def mm(depth_m: Any) -> Any:
    """Millimetres in 16 bits."""
    return np.rint(1000.0 * depth_m).astype(np.uint16)


def truth(poses: list[Any], lens: CameraIntrinsics = LENS, mount: Any = None, **more: Any) -> CameraTruth:
    """A camera with the stamps of all here."""
    return CameraTruth(lens, STAMPS, poses, mount, **more)


def one_lens(
    color: str,
    depth: str,
    frame: str,
    lens: CameraIntrinsics = LENS,
    mount: Any = HELD,
    infos: tuple[str, ...] = (),
    unit: str = "16UC1",
    stamps_s: list[float] = STAMPS,
) -> Iterator[Sent]:
    """Colour and depth of one lens."""
    for stamp_s, seen in zip(stamps_s, shots(lens, poses_of(mount, len(stamps_s))), strict=True):
        yield ros.image(color, stamp_s, seen.color, "rgb8", frame)
        pixels = mm(seen.depth_m) if unit == "16UC1" else seen.depth_m.astype("<f4")
        yield ros.image(depth, stamp_s, pixels, unit, frame)
        for topic in infos:
            yield ros.info(topic, stamp_s, lens, frame)


def two_lenses(
    color: str,
    depth: str,
    frames: tuple[str, str],
    mount: Any = HELD,
    named: Callable[[str], str] = lambda topic: topic.rpartition("/")[0] + "/camera_info",
    encoding: str = "rgb8",
) -> Iterator[Sent]:
    """Colour of a lens beside the depth camera's, in other sizes; frames of colour and of depth."""
    seen = shots(DEPTH_LENS, poses_of(mount)), shots(WIDE, poses_of(mount @ BESIDE))
    for k, stamp_s in enumerate(STAMPS):
        pixels = seen[1][k].color
        if encoding == "bgra8":
            pixels = np.dstack([pixels[..., ::-1], np.full(pixels.shape[:2], 255, np.uint8)])
        yield ros.image(color, stamp_s + 0.001, pixels, encoding, frames[0])
        yield ros.image(depth, stamp_s, mm(seen[0][k].depth_m), "16UC1", frames[1])
        yield ros.info(named(color), stamp_s + 0.001, WIDE, frames[0])
        yield ros.info(named(depth), stamp_s, DEPTH_LENS, frames[1])


@layout("RealSense Viewer .bag", "camera bags", "librealsense doc/rs-record, src/media/ros/ros_file_format.h")
def _realsense_viewer(folder: Path) -> Sample:
    """Depth in tenths of millimetres, colour of another lens, infrared and IMU; record times begin at 0."""
    poses, said = poses_of(HELD), []
    near, wide = shots(DEPTH_LENS, poses), shots(WIDE, poses_of(HELD @ BESIDE))
    device, s = "/device_0", START_S
    pose = ros.posed(np.linalg.inv(BESIDE))
    moved = {"translation": pose["position"], "rotation": pose["orientation"]}
    said.append(
        Sent(
            f"{device}/sensor_0/Depth_0/info/camera_info",
            ros.S + "CameraInfo",
            s,
            ros.info("", s, DEPTH_LENS, "").fields,
        )
    )
    said.append(
        Sent(
            f"{device}/sensor_1/Color_0/info/camera_info",
            ros.S + "CameraInfo",
            s,
            ros.info("", s, WIDE, "").fields,
        )
    )
    said.append(
        Sent(f"{device}/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", s, {"data": 0.0001})
    )
    said.append(Sent(f"{device}/sensor_0/Depth_0/tf/0", ros.G + "Transform", s, {"rotation": {"w": 1.0}}))
    said.append(Sent(f"{device}/sensor_1/Color_0/tf/0", ros.G + "Transform", s, moved))
    for k, stamp_s in enumerate(STAMPS):
        steps = np.rint(10000.0 * near[k].depth_m).clip(0, 65535).astype(np.uint16)
        said.append(ros.image(f"{device}/sensor_0/Depth_0/image/data", stamp_s, steps, "mono16", "0"))
        said.append(
            ros.image(
                f"{device}/sensor_0/Infrared_1/image/data", stamp_s, near[k].color[..., 0], "mono8", "0"
            )
        )
        said.append(
            ros.image(f"{device}/sensor_1/Color_0/image/data", stamp_s + 0.002, wide[k].color, "rgb8", "0")
        )
        said.append(ros.imu(f"{device}/sensor_2/Accel_0/imu/data", stamp_s, "0", gyro=False))
        said.append(ros.imu(f"{device}/sensor_2/Gyro_0/imu/data", stamp_s, "0", force=False))
    for one in said:
        one.late_s -= START_S
    stamps = [stamp_s + 0.002 for stamp_s in STAMPS]
    return Sample(ros.ros1(folder / "20231114_221320.bag", said), (CameraTruth(DEPTH_LENS, stamps, poses),))


def _rs_frames() -> list[Sent]:
    """RealSense's frames, as its driver sends them: camera_link is the depth camera's body."""
    body = placed()
    frames = {"camera_depth_frame": body, "camera_color_frame": placed(0.0, 0.015, 0.0)}
    optical = [
        ros.tf(f"camera_{name}_frame", {f"camera_{name}_optical_frame": OPTICAL})
        for name in ("depth", "color")
    ]
    return [ros.tf("camera_link", frames), *optical]


@layout(
    "realsense2_camera, ROS 2, depth not aligned",
    "camera bags",
    "github.com/IntelRealSense/realsense-ros README, topics",
)
def _realsense_ros2(folder: Path) -> Sample:
    space = "/camera/camera"
    messages = list(
        two_lenses(
            f"{space}/color/image_raw",
            f"{space}/depth/image_rect_raw",
            ("camera_color_optical_frame", "camera_depth_optical_frame"),
        )
    )
    pose = {"rotation": np.eye(3), "translation": [0.015, 0.0, 0.0]}
    messages.append(
        Sent(f"{space}/extrinsics/depth_to_color", "realsense2_camera_msgs/msg/Extrinsics", START_S, pose)
    )
    stamps = [stamp_s + 0.001 for stamp_s in STAMPS]
    return Sample(ros.ros2(folder / "rs", messages), (CameraTruth(DEPTH_LENS, stamps, poses_of(HELD)),))


@layout(
    "realsense2_camera, ROS 1, aligned and compressed",
    "camera bags",
    "realsense-ros ros1-legacy README: align_depth",
)
def _realsense_ros1(folder: Path) -> Sample:
    """What a recorder takes of everything: raw depth, aligned depth, infrared, tf."""
    frame, said = "camera_color_optical_frame", _rs_frames()
    mount = placed(0.0, 0.015, 0.0) @ OPTICAL
    at = placed(0.0, 0.0, 1.3)
    seen = shots(LENS, poses_of(at @ mount))
    raw = shots(DEPTH_LENS, poses_of(at @ OPTICAL))
    for k, stamp_s in enumerate(STAMPS):
        content = ros.coded(seen[k].color, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 95)
        said.append(
            ros.squeezed(
                "/camera/color/image_raw/compressed", stamp_s, content, "rgb8; jpeg compressed bgr8", frame
            )
        )
        said.append(ros.info("/camera/color/camera_info", stamp_s, LENS, frame))
        said.append(
            ros.image(
                "/camera/aligned_depth_to_color/image_raw", stamp_s, mm(seen[k].depth_m), "16UC1", frame
            )
        )
        said.append(ros.info("/camera/aligned_depth_to_color/camera_info", stamp_s, LENS, frame))
        said.append(
            ros.image(
                "/camera/depth/image_rect_raw",
                stamp_s,
                mm(raw[k].depth_m),
                "16UC1",
                "camera_depth_optical_frame",
            )
        )
        said.append(ros.info("/camera/depth/camera_info", stamp_s, DEPTH_LENS, "camera_depth_optical_frame"))
        said.append(
            ros.image(
                "/camera/infra1/image_rect_raw",
                stamp_s,
                raw[k].color[..., 1],
                "mono8",
                "camera_infra1_optical_frame",
            )
        )
    return Sample(
        ros.ros1(folder / "drive.bag", said, packed="LZ4"), (truth(poses_of(at @ mount), mount=mount),)
    )


@layout(
    "Azure Kinect ROS driver", "camera bags", "github.com/microsoft/Azure_Kinect_ROS_Driver docs/usage.md"
)
def _azure_kinect(folder: Path) -> Sample:
    """Colour with eight coefficients of distortion, depth in the colour camera's geometry."""
    bent = (0.078, -0.09, 0.0004, -0.0002, 0.03, 0.06, -0.08, 0.028)
    frame, said = "rgb_camera_link", []
    poses = poses_of(HELD)
    seen, own = shots(LENS, poses, bent), shots(DEPTH_LENS, poses)
    for k, stamp_s in enumerate(STAMPS):
        pixels = np.dstack([seen[k].color[..., ::-1], np.full(seen[k].depth_m.shape, 255, np.uint8)])
        said.append(ros.image("/rgb/image_raw", stamp_s, pixels, "bgra8", frame))
        said.append(ros.info("/rgb/camera_info", stamp_s, LENS, frame, bent, "rational_polynomial"))
        said.append(ros.image("/depth_to_rgb/image_raw", stamp_s, mm(seen[k].depth_m), "16UC1", frame))
        said.append(ros.info("/depth_to_rgb/camera_info", stamp_s, LENS, frame, bent, "rational_polynomial"))
        said.append(ros.image("/depth/image_raw", stamp_s, mm(own[k].depth_m), "16UC1", "depth_camera_link"))
        said.append(ros.info("/depth/camera_info", stamp_s, DEPTH_LENS, "depth_camera_link"))
        said.append(
            ros.image("/ir/image_raw", stamp_s, mm(own[k].depth_m) // 9, "mono16", "depth_camera_link")
        )
        said.append(ros.imu("/imu", stamp_s, "imu_link"))
    return Sample(ros.ros1(folder / "k4a.bag", said), (truth(poses),))


@layout("depthai_ros, OAK-D", "camera bags", "docs.luxonis.com depthai ROS driver; depthai_ros_driver topics")
def _oak(folder: Path) -> Sample:
    said = list(
        one_lens(
            "/oak/rgb/image_raw",
            "/oak/stereo/image_raw",
            "oak_rgb_camera_optical_frame",
            infos=("/oak/rgb/camera_info", "/oak/stereo/camera_info"),
        )
    )
    said += [ros.imu("/oak/imu/data", stamp_s, "oak_imu_frame") for stamp_s in STAMPS]
    frames = {"oak_rgb_camera_frame": placed(0.0, 0.0, 0.0)}
    said += [ros.tf("oak", frames), ros.tf("oak_rgb_camera_frame", {"oak_rgb_camera_optical_frame": OPTICAL})]
    return Sample(ros.ros2(folder / "oak", said), (truth(poses_of(HELD), mount=OPTICAL),))


@layout(
    "OrbbecSDK_ROS2, Gemini", "camera bags", "orbbec.github.io/OrbbecSDK_ROS2, topics; frames by tf_static"
)
def _orbbec(folder: Path) -> Sample:
    said = list(
        two_lenses(
            "/camera/color/image_raw",
            "/camera/depth/image_raw",
            ("camera_color_optical_frame", "camera_depth_optical_frame"),
            placed(0.0, 0.0, 1.3) @ OPTICAL,
        )
    )
    stamps = [stamp_s + 0.001 for stamp_s in STAMPS]
    cameras = (CameraTruth(DEPTH_LENS, stamps, poses_of(placed(0.0, 0.0, 1.3) @ OPTICAL), OPTICAL),)
    return Sample(ros.ros2(folder / "orbbec", [*said, *_rs_frames()]), cameras)


@layout("zed_wrapper", "camera bags", "stereolabs.com/docs/ros/zed-node: topics, REP 118 metres")
def _zed(folder: Path) -> Sample:
    """Depth in metres, a visual odometry that is no wheels."""
    frame = "zed_left_camera_optical_frame"
    space = "/zed/zed_node"
    said = list(
        one_lens(
            f"{space}/rgb/image_rect_color",
            f"{space}/depth/depth_registered",
            frame,
            infos=(f"{space}/rgb/camera_info", f"{space}/depth/camera_info"),
            unit="32FC1",
        )
    )
    said += [
        ros.odometry(f"{space}/odom", stamp_s, pose, "odom", "zed_camera_link")
        for stamp_s, pose in zip(STAMPS, way(COUNT), strict=True)
    ]
    said += [
        ros.tf("zed_camera_link", {"zed_left_camera_frame": placed(0.0, 0.06, 0.0)}),
        ros.tf("zed_left_camera_frame", {frame: OPTICAL}),
    ]
    said += [
        ros.tf("odom", {"zed_camera_link": pose}, stamp_s, static=False)
        for stamp_s, pose in zip(STAMPS, way(COUNT), strict=True)
    ]
    return Sample(
        ros.ros2(folder / "zed", said, mcap=True),
        (truth(poses_of(HELD), mount=placed(0.0, 0.06, 0.0) @ OPTICAL),),
    )


@layout("openni_launch, Kinect", "camera bags", "wiki.ros.org/openni_launch: depth_registered")
def _openni(folder: Path) -> Sample:
    frame = "camera_rgb_optical_frame"
    said = one_lens(
        "/camera/rgb/image_color",
        "/camera/depth_registered/image_raw",
        frame,
        infos=("/camera/rgb/camera_info", "/camera/depth_registered/camera_info"),
    )
    return Sample(ros.ros1(folder / "kinect.bag", said, packed="BZ2"), (truth(poses_of(HELD)),))


@layout("TUM RGB-D .bag", "camera bags", "cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats: ROS bag")
def _tum_bag(folder: Path) -> Sample:
    """Tf holds the truth of a motion capture: neither wheels nor a mounting."""
    frame = "/openni_rgb_optical_frame"
    said = list(
        one_lens(
            "/camera/rgb/image_color",
            "/camera/depth/image",
            frame,
            infos=("/camera/rgb/camera_info", "/camera/depth/camera_info"),
            unit="32FC1",
        )
    )
    inner = [
        ("/kinect", "/openni_camera", placed(0.01, 0.02, 0.0)),
        ("/openni_camera", "/openni_rgb_frame", placed(0.0, -0.02, 0.0)),
        ("/openni_rgb_frame", frame, OPTICAL),
    ]
    for stamp_s, base in zip(STAMPS, way(COUNT), strict=True):
        said.append(
            ros.tf("/world", {"/kinect": base @ placed(0.0, 0.0, 1.3)}, stamp_s, static=False, old=True)
        )
        said += [
            ros.tf(parent, {child: pose}, stamp_s, static=False, old=True) for parent, child, pose in inner
        ]
    held = placed(0.0, 0.0, 1.3, pitch=0.1) @ OPTICAL
    return Sample(ros.ros1(folder / "rgbd_dataset_freiburg1_xyz.bag", said), (truth(poses_of(held)),))


@layout("uHumans2", "camera bags", "web.mit.edu/sparklab/datasets/uHumans2")
def _uhumans(folder: Path) -> Sample:
    """Simulated: depth in metres, the truth as odometry in tf."""
    frame = "left_cam"
    said = list(
        one_lens(
            "/tesse/left_cam/rgb/image_raw",
            "/tesse/depth_cam/mono/image_raw",
            frame,
            infos=("/tesse/left_cam/camera_info", "/tesse/depth_cam/camera_info"),
            unit="32FC1",
            mount=MOUNT,
        )
    )
    said += [
        ros.odometry("/tesse/odom", stamp_s, base, "world", "base_link_gt")
        for stamp_s, base in zip(STAMPS, way(COUNT), strict=True)
    ]
    said += [ros.imu("/tesse/imu/clean/imu", stamp_s, "base_link_gt") for stamp_s in STAMPS]
    said.append(ros.tf("base_link_gt", {frame: MOUNT}))
    return Sample(
        ros.ros1(folder / "uHumans2_office_s1_00h.bag", said), (truth(poses_of(MOUNT), mount=MOUNT),)
    )


@layout("compressed and compressedDepth", "camera bags", "wiki.ros.org/compressed_depth_image_transport")
def _compressed(folder: Path) -> Sample:
    said, frame = [], "camera_rgb_optical_frame"
    for stamp_s, seen in zip(STAMPS, shots(LENS, poses_of(HELD)), strict=True):
        said.append(
            ros.squeezed(
                "/camera/rgb/image_rect_color/compressed",
                stamp_s,
                ros.coded(seen.color, ".jpg", cv2.IMWRITE_JPEG_QUALITY, 95),
                "bgr8; jpeg compressed bgr8",
                frame,
            )
        )
        content = bytes(12) + ros.coded(mm(seen.depth_m), ".png")
        said.append(
            ros.squeezed(
                "/camera/depth_registered/image_raw/compressedDepth",
                stamp_s,
                content,
                "16UC1; compressedDepth",
                frame,
            )
        )
        said.append(ros.info("/camera/rgb/camera_info", stamp_s, LENS, frame))
    return Sample(ros.ros1(folder / "c.bag", said), (truth(poses_of(HELD)),))
