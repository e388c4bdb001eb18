"""Bags of cameras with rare encodings or without lens, and recordings of cameras without depth."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tools.layouts import messages as ros
from tools.layouts.camera_bags import COUNT, HELD, LENS, MOUNT, STAMPS, mm, one_lens, poses_of, shots, truth
from tools.layouts.messages import START_S, Sent
from tools.layouts.samples import CameraTruth, Sample, layout
from tools.layouts.world import way
from tools.pack_layouts import put


def _yuv(color: Any, form: str) -> Any:
    """Pixels of a camera that sends brightness and colour; colour of two pixels is shared."""
    yuv = cv2.cvtColor(color, cv2.COLOR_RGB2YUV)
    height, width = color.shape[:2]
    u, v = yuv[:, ::2, 1], yuv[:, ::2, 2]
    if form == "nv12":
        half = cv2.resize(yuv[..., 1:], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        return np.vstack([yuv[..., 0], half.reshape(height // 2, width)])
    chroma = np.empty((height, width), np.uint8)
    chroma[:, ::2], chroma[:, 1::2] = u, v
    pair = (yuv[..., 0], chroma) if form == "yuyv" else (chroma, yuv[..., 0])
    return np.dstack(pair)


def _bayer(color: Any) -> Any:
    """One colour a pixel: red first, blue at odd rows and columns."""
    out = color[..., 1].copy()
    out[::2, ::2], out[1::2, 1::2] = color[::2, ::2, 0], color[1::2, 1::2, 2]
    return out


def _encoded(
    name: str, encoding: str, source: str, pixels: Callable[[Any], Any], *, grey: bool = False
) -> None:
    """A sample of an encoding of colour."""

    def write(folder: Path) -> Sample:
        said, frame = [], "camera_color_optical_frame"
        for stamp_s, seen in zip(STAMPS, shots(LENS, poses_of(HELD)), strict=True):
            said.append(
                ros.image(
                    "/camera/color/image_raw",
                    stamp_s,
                    pixels(seen.color),
                    encoding,
                    frame,
                    LENS.width,
                    LENS.height,
                )
            )
            said.append(
                ros.image(
                    "/camera/aligned_depth_to_color/image_raw", stamp_s, mm(seen.depth_m), "16UC1", frame
                )
            )
            said.append(ros.info("/camera/color/camera_info", stamp_s, LENS, frame))
        return Sample(ros.ros2(folder / "bag", said), (truth(poses_of(HELD), grey=grey),))

    layout(name, "camera bags", source)(write)


_encoded(
    "colour yuv422_yuy2",
    "yuv422_yuy2",
    "sensor_msgs/image_encodings.hpp: YUYV",
    lambda color: _yuv(color, "yuyv"),
    grey=True,
)
_encoded(
    "colour yuv422 (UYVY)",
    "yuv422",
    "sensor_msgs/image_encodings.hpp: UYVY",
    lambda color: _yuv(color, "uyvy"),
    grey=True,
)
_encoded(
    "colour nv12", "nv12", "sensor_msgs/image_encodings.hpp", lambda color: _yuv(color, "nv12"), grey=True
)
_encoded("colour bayer_rggb8", "bayer_rggb8", "sensor_msgs/image_encodings.hpp", _bayer, grey=True)
_encoded(
    "grey mono8",
    "mono8",
    "sensor_msgs/image_encodings.hpp",
    lambda color: cv2.cvtColor(color, cv2.COLOR_RGB2GRAY),
    grey=True,
)


@layout(
    "no CameraInfo, lens in a yaml",
    "camera bags",
    "docs.ros.org camera_calibration_parsers: camera_info yaml",
)
def _without_info(folder: Path) -> Sample:
    """Colour and depth alone; the lens lies beside them in a file that ROS writes."""
    said = one_lens("/camera/color/image_raw", "/camera/depth/image_raw", "camera_optical")
    k = f"[{LENS.fx}, 0, {LENS.cx}, 0, {LENS.fy}, {LENS.cy}, 0, 0, 1]"
    text = (
        f"image_width: {LENS.width}\nimage_height: {LENS.height}\ncamera_name: camera\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {k}\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
        f"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
    )
    lens = put(folder / "elsewhere" / "camera.yaml", text)
    return Sample(ros.ros2(folder / "bag", said), (truth(poses_of(HELD)),), mend=("--calibration", str(lens)))


@layout("theora colour", "camera bags", "wiki.ros.org/theora_image_transport")
def _theora(folder: Path) -> Sample:
    """Video is not unpacked; depth alone makes no camera. Its republisher writes raw images."""
    topics = "/camera/color/image_raw", "/camera/depth/image_raw"
    raw = list(one_lens(*topics, "c", infos=("/camera/color/camera_info", "/camera/depth/camera_info")))
    said = [one for one in raw if one.topic != topics[0]]
    for stamp_s in STAMPS:
        fields = {"data": np.zeros(99)}
        said.append(Sent(f"{topics[0]}/theora", "theora_image_transport/msg/Packet", stamp_s, fields))
    path = ros.ros1(folder / "t.bag", said)
    written = ("republish theora raw", lambda: ros.ros2(folder / "raw", raw))
    return Sample(path, (truth(poses_of(HELD)),), refused="republish theora raw", by_hand=written)


@layout(
    "OpenLORIS-Scene .bag", "camera bags", "lifelong-robotic-vision.github.io/dataset/scene: rosbag topics"
)
def _open_loris_bag(folder: Path) -> Sample:
    """A robot: wheels, a depth camera aligned to colour, frames by tf_static."""
    frame, stamps = "d400_color", [START_S + k / 15.0 for k in range(16)]
    said = list(
        one_lens(
            "/d400/color/image_raw",
            "/d400/aligned_depth_to_color/image_raw",
            frame,
            infos=("/d400/color/camera_info", "/d400/aligned_depth_to_color/camera_info"),
            mount=MOUNT,
            stamps_s=stamps,
        )
    )
    said += [
        ros.odometry("/odom", stamp_s, base, "base_odom", "base_link")
        for stamp_s, base in zip(stamps, way(len(stamps)), strict=True)
    ]
    said += [ros.tf("base_link", {frame: MOUNT})]
    said += [ros.imu("/d400/gyro/sample", stamp_s, "d400_imu", force=False) for stamp_s in stamps]
    said += [ros.imu("/d400/accel/sample", stamp_s, "d400_imu", gyro=False) for stamp_s in stamps]
    camera = CameraTruth(LENS, stamps, poses_of(MOUNT, len(stamps)), MOUNT)
    return Sample(ros.ros1(folder / "home1-1.bag", said), (camera,), wheels=len(stamps))


@layout("EuRoC .bag", "camera bags", "projects.asl.ethz.ch/datasets kmavvisualinertialdatasets")
def _euroc_bag(folder: Path) -> Sample:
    said = [
        ros.image(f"/cam{n}/image_raw", stamp_s, seen.color[..., 0], "mono8", f"cam{n}")
        for n in (0, 1)
        for stamp_s, seen in zip(STAMPS, shots(LENS, poses_of(HELD)), strict=True)
    ]
    said += [ros.imu("/imu0", stamp_s, "imu4") for stamp_s in STAMPS]
    return Sample(ros.ros1(folder / "MH_01_easy.bag", said), refused=r"no depth|neither")


@layout("Azure Kinect .mkv", "camera bags", "learn.microsoft.com azure kinect-dk record-file-format")
def _azure_mkv(folder: Path) -> Sample:
    """Open3D's tool writes numbered images of 30 Hz, depth as colour sees it, and the lens."""
    head = (
        bytes.fromhex("1a45dfa3")
        + b"\x01\x00\x00\x00\x00\x00\x00\x1f"
        + b"\x42\x86\x81\x01\x42\xf7\x81\x01\x42\x82\x88matroska"
    )

    def extracted() -> Path:
        for k, seen in enumerate(shots(LENS, poses_of(HELD))):
            put(folder / "FOLDER" / "color" / f"{k:05d}.jpg", ros.coded(seen.color, ".jpg"))
            put(folder / "FOLDER" / "depth" / f"{k:05d}.png", mm(seen.depth_m))
        lens = [LENS.fx, 0, 0, 0, LENS.fy, 0, LENS.cx, LENS.cy, 1]
        intrinsics = {
            "width": LENS.width,
            "height": LENS.height,
            "intrinsic_matrix": lens,
            "color_mode": "MJPG_720P",
        }
        put(folder / "FOLDER" / "intrinsic.json", json.dumps(intrinsics))
        put(folder / "FOLDER" / "config.json", json.dumps({"path_dataset": "FOLDER"}))
        return folder / "FOLDER"

    tool = "azure_kinect_mkv_reader"
    cameras = (CameraTruth(LENS, [k / 30.0 for k in range(COUNT)], poses_of(HELD)),)
    path = put(folder / "output.mkv", head + bytes(500))
    return Sample(path, cameras, refused=tool, by_hand=(tool, extracted))


@layout("EuRoC folder", "camera bags", "projects.asl.ethz.ch/datasets ASL format")
def _euroc_folder(folder: Path) -> Sample:
    for camera in ("cam0", "cam1"):
        put(
            folder / "MH_01" / "mav0" / camera / "data.csv",
            "#timestamp [ns],filename\n1403636579763555584,1403636579763555584.png\n",
        )
        put(
            folder / "MH_01" / "mav0" / camera / "data" / "1403636579763555584.png",
            np.zeros((48, 75), np.uint8),
        )
    put(
        folder / "MH_01" / "mav0" / "imu0" / "data.csv",
        "#timestamp [ns],w_RS_S_x\n1403636579758555392,-0.099,0.147,0.0272,8.14,-0.375,-2.4\n",
    )
    return Sample(folder / "MH_01", refused="neither depth nor a lidar")


@layout("TUM-VI folder", "camera bags", "cvg.cit.tum.de/data/datasets/visual-inertial-dataset: EuRoC format")
def _tum_vi(folder: Path) -> Sample:
    sample = _euroc_folder(folder)
    (folder / "MH_01").rename(folder / "dataset-room1_512_16")
    put(folder / "dataset-room1_512_16" / "dso" / "camchain.yaml", "cam0:\n  camera_model: pinhole\n")
    return Sample(folder / "dataset-room1_512_16", refused=sample.refused)


@layout("ADVIO", "camera bags", "github.com/AaltoVision/ADVIO README: iphone/frames.mov, csv")
def _advio(folder: Path) -> Sample:
    place = folder / "advio-01"
    put(place / "iphone" / "frames.mov", bytes(200))
    for name in ("frames", "accelerometer", "gyro", "arkit"):
        put(place / "iphone" / f"{name}.csv", "0.0,0,0,0\n")
    put(place / "ground-truth" / "poses.csv", "0.0,0,0,0,1,0,0,0\n")
    return Sample(place, refused="neither depth nor a lidar")
