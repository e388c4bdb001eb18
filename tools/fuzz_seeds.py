"""Small valid logs, definitions and maps of each format, which `tools/fuzz.py` damages.

Bags are written with rosbags and mcap, for ROS 1 and ROS 2.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import gtsam
import laspy
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import tools.layouts.all as _all_layouts  # noqa: F401  their writers put themselves on the list
from slam.measurements import CameraIntrinsics, LaserScan
from slam.simulation import ros_messages as ros
from slam.storage import ros_messages as kinds
from tools.layouts.samples import LAYOUTS
from tools.pack_layouts import CAMERAS, Footage
from tools.pack_lidars import LIDARS, Turns
from tools.pack_scenes import SCENES

_START_S = 1000.0
# Record3D packs by a library that not every machine has.
_LEFT_OUT = {"tum"} if find_spec("liblzfse") else {"tum", "record3d"}
_FOOTAGE = CAMERAS | SCENES
_PUBLISHED = tuple(name for name in (*_FOOTAGE, *LIDARS) if name not in _LEFT_OUT)
_PACKED = "sensor_msgs/msg/CompressedImage"
KINDS = (
    ros.LASER_SCAN,
    ros.IMAGE,
    ros.ODOMETRY,
    kinds.POINT_CLOUD,
    kinds.TRANSFORMS,
    _PACKED,
    ros.CAMERA_INFO,
)
# Of readers that have no packer of their own: what `tools/layouts` writes.
_SAMPLES = {
    "player": "Player log of Radish",
    "rawseeds": "Rawseeds",
    "nuscenes": "nuScenes, sweeps of one scene",
    "las": "LAS clouds",
    "laz": "LAS clouds",
    "nyu_dumps": "NYU Depth V2, raw dumps",
    "pcap": "Velodyne packets, .pcap",
    "ouster": "Ouster packets, .pcap",
    "point_cloud": "PointCloud of ROS 1's first years",
    "foxglove": "Foxglove, a lidar as protobuf",
    "foxglove_json": "Foxglove, a flat lidar as JSON",
}
LOGS = ("carmen", "tum", "ply", "ply_text", "pcd", "pcd_packed", "bin", *_PUBLISHED, *_SAMPLES)

_ROS1 = get_typestore(Stores.ROS1_NOETIC)
_ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kinds.TRANSFORMS))

Sent = tuple[str, str, float, bytes]


@cache
def messages() -> list[Sent]:
    """Serialised messages of a robot that drives for one second with every sensor."""
    rng = np.random.default_rng(1)
    lens = CameraIntrinsics(30.0, 30.0, 16.0, 12.0, 32, 24)
    mounts = dict.fromkeys(
        ("laser", "lidar", "optical"), gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.3]))
    )
    sent = [("/tf_static", kinds.TRANSFORMS, _START_S, kinds.transforms(_START_S, "base_link", mounts))]
    for k in range(10):
        at_s = _START_S + 0.1 * k
        pose = gtsam.Pose3(gtsam.Pose2(0.05 * k, 0.0, 0.01 * k))
        scan = LaserScan(at_s, rng.uniform(0.5, 7.0, 90).astype(np.float32), -1.5, 0.03, 8.0)
        points, ring = rng.normal(size=(50, 3)).astype(np.float32), np.zeros(50, np.uint16)
        color = rng.integers(0, 256, (24, 32, 3), dtype=np.uint8)
        depth = rng.integers(500, 4000, (24, 32), dtype=np.uint16)
        picture, distances = (
            ros.image(pixels, encoding, at_s, "optical")
            for pixels, encoding in ((color, "rgb8"), (depth, "16UC1"))
        )
        sent += [
            ("/odom", ros.ODOMETRY, at_s, ros.odometry(at_s, pose, (0.5, 0.1), "odom", "base_link")),
            ("/scan", ros.LASER_SCAN, at_s, ros.laser_scan(scan, "laser", 0.1, 0.1)),
            ("/points", kinds.POINT_CLOUD, at_s, ros.point_cloud(points, {"ring": ring}, at_s, "lidar")),
            ("/camera/depth/camera_info", ros.CAMERA_INFO, at_s, ros.camera_info(lens, at_s, "optical")),
            ("/camera/color/image_raw", ros.IMAGE, at_s, picture),
            ("/camera/depth/image_raw", ros.IMAGE, at_s, distances),
            ("/rear/depth/camera_info", ros.CAMERA_INFO, at_s, ros.camera_info(lens, at_s, "optical")),
            ("/rear/color/image_raw/compressed", _PACKED, at_s, _packed(picture, color, "png", b"")),
            (
                "/rear/depth/image_raw/compressedDepth",
                _PACKED,
                at_s,
                _packed(distances, depth, "16UC1; compressedDepth png", bytes(12)),
            ),
        ]
    store = kinds.typestore()
    return [
        (topic, kind, at_s, bytes(store.serialize_cdr(message, kind))) for topic, kind, at_s, message in sent
    ]


def _packed(raw: Any, pixels: np.ndarray, form: str, before: bytes) -> Any:
    """A CompressedImage of what a raw message shows."""
    done, content = cv2.imencode(".png", pixels)
    assert done
    data = np.frombuffer(before + content.tobytes(), np.uint8)
    return kinds.typestore().types[_PACKED](header=raw.header, format=form, data=data)


def write(path: Path, name: str, messages: list[Sent], definitions: dict[str, str]) -> Path:
    """A bag by one of the writers; ``definitions`` replaces those of message types."""
    return BAGS[name](path, messages, definitions)


def _write_mcap(
    packing: CompressionType, language: str = "ros2msg"
) -> Callable[[Path, list[Sent], dict[str, str]], Path]:
    """MCAP by the package mcap."""

    def written(path: Path, messages: list[Sent], definitions: dict[str, str]) -> Path:
        path = path.with_suffix(".mcap")
        with path.open("wb") as file:
            bag = McapWriter(file, chunk_size=16384, compression=packing)
            bag.start()
            topics: dict[str, int] = {}
            for topic, kind, at_s, content in messages:
                if topic not in topics:
                    text = definitions.get(kind, kinds.typestore().generate_msgdef(kind, ros_version=2)[0])
                    schema = bag.register_schema(kind, language, text.encode())
                    topics[topic] = bag.register_channel(topic, "cdr", schema)
                bag.add_message(topics[topic], round(at_s * 1e9), content, round(at_s * 1e9))
            bag.finish()
        return path

    return written


def _write_db3(path: Path, messages: list[Sent], definitions: dict[str, str]) -> Path:
    """rosbag2's SQLite by the package rosbags."""
    with Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        topics: dict[str, Any] = {}
        for topic, kind, at_s, content in messages:
            if topic not in topics:
                given: dict[str, Any] = {"typestore": kinds.typestore()}
                if kind in definitions:
                    given = {"msgdef": definitions[kind], "rihs01": "RIHS01_" + "0" * 64}
                topics[topic] = bag.add_connection(topic, kind, **given)
            bag.write(topics[topic], round(at_s * 1e9), content)
    (inside,) = path.glob("*.db3")
    return inside.replace(path.with_suffix(".db3"))


def _write_ros1(packing: str) -> Callable[[Path, list[Sent], dict[str, str]], Path]:
    """A ROS 1 bag by the package rosbags."""

    def written(path: Path, messages: list[Sent], definitions: dict[str, str]) -> Path:
        bag = Writer1(path.with_suffix(".bag"))
        if packing:
            bag.set_compression(Writer1.CompressionFormat[packing])
        with bag:
            topics: dict[str, Any] = {}
            for topic, kind, at_s, content in messages:
                if topic not in topics:
                    given: dict[str, Any] = {"typestore": _ROS1}
                    if kind in definitions:
                        given = {"msgdef": definitions[kind], "md5sum": "0" * 32}
                    topics[topic] = bag.add_connection(topic, kind, **given)
                bag.write(topics[topic], round(at_s * 1e9), kinds.typestore().cdr_to_ros1(content, kind))
        return path.with_suffix(".bag")

    return written


BAGS: dict[str, Callable[[Path, list[Sent], dict[str, str]], Path]] = {
    "mcap": _write_mcap(CompressionType.ZSTD),
    "mcap_plain": _write_mcap(CompressionType.NONE),
    "db3": _write_db3,
    "bag": _write_ros1(""),
    "bag_lz4": _write_ros1("LZ4"),
    "idl": _write_mcap(CompressionType.NONE, "ros2idl"),
}


def write_log(folder: Path, name: str) -> Path:
    """Write a log that is no bag; returns the path to open. Its files are to be damaged."""
    if name in _PUBLISHED:
        return _write_published(folder, name)
    if name in _SAMPLES:
        path = LAYOUTS[_SAMPLES[name]].write(folder).path
        for file in sorted(path.iterdir()) if name == "laz" else ():
            laspy.read(file).write(file.with_suffix(".laz"), laz_backend=laspy.LazBackend.Lazrs)
            file.unlink()
        return path
    return (
        _write_carmen(folder)
        if name == "carmen"
        else _write_tum(folder)
        if name == "tum"
        else _write_points(folder, name)
    )


def _write_published(folder: Path, name: str) -> Path:
    """Three frames of a camera, or three revolutions of a lidar, in the layout of a data set."""
    rng = np.random.default_rng(0)
    poses = [gtsam.Pose3(gtsam.Rot3.Yaw(0.1 * k), np.array([0.1 * k, 0.0, 0.0])).matrix() for k in range(3)]
    if name in LIDARS:
        points = [rng.uniform(-40.0, 40.0, (60, 3)).astype(np.float32) for _ in poses]
        imu = np.column_stack([0.05 * np.arange(6), np.full((6, 3), 0.1), np.full((6, 3), 5.0)])
        times = [np.linspace(0.0, 0.09, 60)] * 3
        return LIDARS[name](folder, Turns([0.0, 0.1, 0.2], points, times, poses, imu))
    colors = [rng.integers(0, 256, (24, 32, 3), np.uint8) for _ in poses]
    depths = [rng.integers(500, 4000, (24, 32)).astype(np.uint16) for _ in poses]
    lens = CameraIntrinsics(30.0, 30.0, 15.5, 11.5, 32, 24)
    return _FOOTAGE[name](folder, Footage([0.0, 1 / 30, 2 / 30], colors, depths, poses, lens))


def _write_carmen(folder: Path) -> Path:
    """Two seconds of scans and odometry."""
    beams = " ".join(f"{1.0 + 0.01 * k:.2f}" for k in range(90))
    lines = ["PARAM robot_front_laser_max 8.0 0.0 host 0.0"]
    for k in range(20):
        pose = f"{0.05 * k:.3f} 0.0 {0.01 * k:.3f}"
        lines.append(f"ODOM {pose} 0.5 0.1 0 {1.0 + 0.1 * k:.2f} host {1.0 + 0.1 * k:.2f}")
        lines.append(f"FLASER 90 {beams} {pose} {pose} {1.0 + 0.1 * k:.2f} host {1.0 + 0.1 * k:.2f}")
    (folder / "drive.log").write_text("\n".join(lines) + "\n")
    return folder / "drive.log"


def _write_tum(folder: Path) -> Path:
    """Five frames of a camera with its lens."""
    rng = np.random.default_rng(0)
    for kind, pixels in (
        ("rgb", rng.integers(0, 256, (24, 32, 3), np.uint8)),
        ("depth", rng.integers(500, 9000, (24, 32), np.uint16)),
    ):
        names = [f"{kind}{k}.{'jpg' if kind == 'rgb' and k % 2 else 'png'}" for k in range(5)]
        for name in names:
            cv2.imwrite(str(folder / name), pixels)
        (folder / f"{kind}.txt").write_text(
            "".join(f"{0.1 * k:.1f} {name}\n" for k, name in enumerate(names))
        )
    (folder / "calibration.yaml").write_text(
        "intrinsics: {fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5, width: 32, height: 24}\n"
        "depth_steps_per_m: 1000\n"
        "T_base_camera: {translation_m: [0.1, 0.0, 0.5], quaternion_xyzw: [0.0, 0.0, 0.0, 1.0]}\n"
    )
    return folder


def _write_points(folder: Path, name: str) -> Path:
    """Three clouds of a format."""
    points = np.random.default_rng(0).normal(size=(50, 4)).astype("<f4")
    text = "".join(" ".join(f"{value:.3f}" for value in row) + "\n" for row in points).encode()
    fields = b"".join(b"property float %s\n" % axis for axis in (b"x", b"y", b"z", b"intensity"))
    pcd = b"VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
    pcd += b"WIDTH 50\nHEIGHT 1\nPOINTS 50\nDATA "
    columns = points.T.tobytes()
    runs = b"".join(
        bytes([len(part) - 1]) + part for part in (columns[at : at + 32] for at in range(0, len(columns), 32))
    )
    sizes = np.array([len(runs), len(columns)], "<u4").tobytes()
    content = {
        "ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 50\n"
        + fields
        + b"end_header\n"
        + points.tobytes(),
        "ply_text": b"ply\nformat ascii 1.0\nelement vertex 50\n" + fields + b"end_header\n" + text,
        "pcd": pcd + b"binary\n" + points.tobytes(),
        "pcd_packed": pcd + b"binary_compressed\n" + sizes + runs,
        "bin": points.tobytes(),
    }[name]
    for k in range(3):
        (folder / f"{k}.{name.partition('_')[0]}").write_bytes(content)
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n")
    return folder
