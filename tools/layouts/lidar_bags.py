"""Bags of 3D lidars, with the fields, frames and packets of their drivers."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tools.layouts import messages as ros
from tools.layouts.lidars import RINGS, TURN_S, ride, still
from tools.layouts.messages import START_S, Sent
from tools.layouts.samples import CloudTruth, Sample, layout
from tools.layouts.world import hits, placed, turn, way
from tools.pack_layouts import put

COUNT = 10
MOUNT = placed(0.1, 0.0, 1.0)
STAMPS = [START_S + TURN_S * k for k in range(COUNT)]


def truth(
    points: list[Any],
    parts: list[Any] | None,
    poses: list[Any],
    mount: Any = None,
    early_s: float = 0.0,
    **more: Any,
) -> CloudTruth:
    """Points whose times begin some seconds before the stamp."""
    times = None if parts is None else [TURN_S * part - early_s for part in parts]
    return CloudTruth(STAMPS, points, times, poses, mount, **more)


def feel(topic: str, frame: str, rate_hz: float = 100.0) -> Iterator[Sent]:
    """An IMU that stands still beside the lidar."""
    for row in still(START_S, TURN_S * COUNT, rate_hz):
        yield ros.imu(topic, float(row[0]), frame)


def livox(points: Any, part: Any, stamp_s: float, package: str, topic: str, frame: str) -> Sent:
    """A CustomMsg."""
    items = [
        {
            "offset_time": int(1e9 * TURN_S * at),
            "x": float(x),
            "y": float(y),
            "z": float(z),
            "reflectivity": 9,
            "tag": 16,
            "line": n % 4,
        }
        for n, ((x, y, z), at) in enumerate(zip(points, part, strict=True))
    ]
    fields = {"timebase": round(1e9 * stamp_s), "point_num": len(items), "points": items}
    return Sent(topic, f"{package}/msg/CustomMsg", stamp_s, fields, frame)


def _livox(package: str) -> Callable[[Path], Sample]:
    def write(folder: Path) -> Sample:
        points, parts, poses = ride(MOUNT, columns=120)
        said = [
            livox(points[k], parts[k], STAMPS[k], package, "/livox/lidar", "livox_frame")
            for k in range(COUNT)
        ]
        said += feel("/livox/imu", "livox_frame")
        path = (
            ros.ros1(folder / "livox.bag", said)
            if package.endswith("driver")
            else ros.ros2(folder / "livox", said)
        )
        return Sample(path, cloud=truth(points, parts, poses), imu=80)

    return write


layout("Livox CustomMsg, ROS 1", "lidar bags", "github.com/Livox-SDK/livox_ros_driver CustomMsg.msg")(
    _livox("livox_ros_driver")
)
layout("Livox CustomMsg, ROS 2", "lidar bags", "github.com/Livox-SDK/livox_ros_driver2 CustomMsg.msg")(
    _livox("livox_ros_driver2")
)


def ring(points: Any) -> Any:
    """The ring of each point, as `ride` has them."""
    return np.tile(np.arange(len(RINGS)), len(points) // len(RINGS)).astype("<u2")


FIELDS: dict[
    str, tuple[str, str, str, Callable[[Any, Any, float], dict[str, Any]], float, dict[str, Any]]
] = {
    "Velodyne PointCloud2": (
        "/velodyne_points",
        "velodyne",
        "github.com/ros-drivers/velodyne velodyne_pointcloud: time, ring",
        lambda p, at, s: {
            "intensity": np.ones(len(p), "<f4"),
            "ring": ring(p),
            "time": (TURN_S * (at - 1.0)).astype("<f4"),
        },
        TURN_S,
        {},
    ),
    "Ouster PointCloud2": (
        "/ouster/points",
        "os_sensor",
        "github.com/ouster-lidar/ouster-ros os_point.h: t, ring",
        lambda p, at, s: {
            "intensity": np.ones(len(p), "<f4"),
            "t": (1e9 * TURN_S * at).astype("<u4"),
            "reflectivity": np.ones(len(p), "<u2"),
            "ring": ring(p),
            "ambient": np.ones(len(p), "<u2"),
            "range": np.ones(len(p), "<u4"),
        },
        0.0,
        {"gap": 4, "rows": 16},
    ),
    "Hesai PointCloud2": (
        "/lidar_points",
        "hesai_lidar",
        "github.com/HesaiTechnology/HesaiLidar_ROS_2.0: timestamp float64",
        lambda p, at, s: {
            "intensity": np.ones(len(p), "<f4"),
            "ring": ring(p),
            "timestamp": s + TURN_S * at,
        },
        0.0,
        {},
    ),
    "RoboSense PointCloud2": (
        "/rslidar_points",
        "rslidar",
        "github.com/RoboSense-LiDAR/rslidar_sdk: XYZIRT",
        lambda p, at, s: {
            "intensity": np.ones(len(p), "<f4"),
            "ring": ring(p),
            "timestamp": s + TURN_S * (at - 1.0),
        },
        TURN_S,
        {},
    ),
    "Livox PointCloud2": (
        "/livox/lidar",
        "livox_frame",
        "livox_ros_driver2 README: PointXYZRTLT, timestamp in ns",
        lambda p, at, s: {
            "intensity": np.ones(len(p), "<f4"),
            "tag": np.ones(len(p), "u1"),
            "line": np.ones(len(p), "u1"),
            "timestamp": np.round(1e9 * (s + TURN_S * at)),
        },
        0.0,
        {},
    ),
    "PointCloud2 without times": (
        "/points",
        "lidar",
        "sensor_msgs/PointCloud2 of a simulator: x y z intensity",
        lambda p, at, s: {"intensity": np.ones(len(p), "<f4")},
        0.0,
        {},
    ),
}


def _driver(name: str) -> Callable[[Path], Sample]:
    topic, frame, _, fields, early_s, more = FIELDS[name]

    def write(folder: Path) -> Sample:
        points, parts, poses = ride(MOUNT)
        said = [
            ros.cloud(topic, STAMPS[k], points[k], frame, fields(points[k], parts[k], STAMPS[k]), **more)
            for k in range(COUNT)
        ]
        timed = None if name == "PointCloud2 without times" else parts
        return Sample(ros.ros2(folder / "drive", said), cloud=truth(points, timed, poses, early_s=early_s))

    return write


for _name in FIELDS:
    layout(_name, "lidar bags", FIELDS[_name][2])(_driver(_name))


def packets(pose: Any, stamp_s: float) -> list[dict[str, Any]]:
    """A turn of a VLP-16 as its manual has it: 76 packets of 12 blocks of two firings of 16 lasers."""
    order = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], float)
    packets_sent, block = [], 0
    for number in range(75):
        data = b""
        for _ in range(12):
            azimuth = 0.4 * block
            data += struct.pack("<HH", 0xEEFF, round(100 * azimuth) % 36000)
            for firing in (0.0, 0.2):
                bearing = np.radians(azimuth + firing)  # clockwise, as the driver turns it: from its x axis
                up = np.radians(order)
                rays = np.column_stack(
                    [np.cos(up) * np.cos(bearing), -np.cos(up) * np.sin(bearing), np.sin(up)]
                )
                ranges = hits(pose[:3, 3], rays @ pose[:3, :3].T)
                data += b"".join(struct.pack("<HB", round(float(r) / 0.002), 50) for r in ranges)
            block += 1
        at = stamp_s + TURN_S * number / 75
        data += struct.pack("<IBB", round(1e6 * at) % 3600000000, 0x37, 0x22)
        packets_sent.append({"stamp": ros.header(at, "")["stamp"], "data": np.frombuffer(data, np.uint8)})
    return packets_sent


@layout("VelodyneScan packets", "lidar bags", "VLP-16 user manual; velodyne_msgs/VelodyneScan")
def _velodyne_packets(folder: Path) -> Sample:
    poses = [base @ MOUNT for base in way(COUNT)]
    said = [
        Sent(
            "/velodyne_packets",
            "velodyne_msgs/msg/VelodyneScan",
            stamp,
            {"packets": packets(pose, stamp)},
            "velodyne",
        )
        for stamp, pose in zip(STAMPS, poses, strict=True)
    ]
    return Sample(
        ros.ros1(folder / "packets.bag", said), cloud=CloudTruth(STAMPS, [], None, poses, apart_m=0.08)
    )


@layout("Velodyne packets, .pcap", "3D lidar folders", "VLP-16 user manual; libpcap file format")
def _velodyne_pcap(folder: Path) -> Sample:
    """What a port of a computer heard: the lidar, its position packets, somebody's web page."""
    poses = [base @ MOUNT for base in way(COUNT)]
    heard = [(START_S, b"GET / HTTP/1.1", 80)]
    for stamp, pose in zip(STAMPS, poses, strict=True):
        heard.append((stamp, bytes(512), 8308))
        for number, one in enumerate(packets(pose, stamp)):
            heard.append((stamp + TURN_S * number / 75, one["data"].tobytes(), 2368))
    path = put(folder / "drive.pcap", captured(heard))
    # A turn ends with the packet in which the bearing passes zero.
    stamps = [STAMPS[0], *(stamp + TURN_S / 75 for stamp in STAMPS[1:])]
    return Sample(path, cloud=CloudTruth(stamps, [], None, poses, apart_m=0.08))


def captured(packets: list[tuple[float, bytes, int]], most: int = 1480) -> bytes:
    """A capture of datagrams to ports, those that are longer than a frame in fragments."""
    content = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    for number, (at, data, port) in enumerate(packets):
        datagram = struct.pack(">HHHH", port, port, 8 + len(data), 0) + data
        for start in range(0, len(datagram), most):
            part = datagram[start : start + most]
            fragment = (start // 8) | (0x2000 if start + most < len(datagram) else 0)
            about = 0x45, 0, 20 + len(part), number & 0xFFFF, fragment, 64, 17, 0
            head = struct.pack(">BBHHHBBH", *about) + bytes((192, 168, 1, 201, 255, 255, 255, 255))
            frame = bytes(12) + b"\x08\x00" + head + part
            seconds, rest = divmod(round(1e6 * at), 10**6)
            content += struct.pack("<IIII", seconds, rest, len(frame), len(frame)) + frame
    return content


@layout(
    "Ouster driver, all it sends",
    "lidar bags",
    "github.com/ouster-lidar/ouster-ros README: proc_mask IMG|PCL|IMU|SCAN",
)
def _ouster_driver(folder: Path) -> Sample:
    """Clouds, pictures of their ranges and brightness in 16 bits, a ring as a scan, IMU, frames."""
    sits = placed(0.0, 0.0, 0.036, yaw=np.pi)
    points, parts, poses = ride(MOUNT)
    fields, said = FIELDS["Ouster PointCloud2"][3], list(feel("/ouster/imu", "os_imu"))
    steps = (np.arange(64 * 1024).reshape(64, 1024) % 9000).astype("<u2")
    for k, stamp in enumerate(STAMPS):
        own = fields(points[k], parts[k], stamp)
        said.append(ros.cloud("/ouster/points", stamp, points[k], "os_lidar", own, gap=4, rows=16))
        said.append(ros.scan("/ouster/scan", stamp, np.full(360, 3.0), -np.pi, np.radians(1.0), "os_lidar"))
        for name in ("range", "signal", "nearir", "reflec"):
            said.append(ros.image(f"/ouster/{name}_image", stamp, steps, "mono16", "os_lidar"))
    said.append(ros.tf("os_sensor", {"os_lidar": sits, "os_imu": placed(0.006, -0.012, 0.008)}))
    return Sample(ros.ros2(folder / "ouster", said), cloud=truth(points, parts, poses, sits), imu=80)


def velodyne_at(topic: str, frame: str, mount: Any, said: list[Sent]) -> tuple[Any, ...]:
    """Clouds of a Velodyne on a robot."""
    points, parts, poses = ride(mount)
    fields = FIELDS["Velodyne PointCloud2"][3]
    said += [
        ros.cloud(topic, STAMPS[k], points[k], frame, fields(points[k], parts[k], 0.0)) for k in range(COUNT)
    ]
    return points, parts, poses


@layout("two lidars and wheels", "lidar bags", "REP 105; a robot with /front and /rear lidars")
def _two_lidars(folder: Path) -> Sample:
    """One of both is read, the one in front has the wider view."""
    said: list[Sent] = []
    points, parts, poses = velodyne_at("/front/points", "front_lidar", MOUNT, said)
    behind = placed(-0.4, 0.0, 0.6, yaw=3.0)
    half, half_at = turn(behind, RINGS[:8])
    said += [
        ros.cloud(
            "/rear/points",
            stamp,
            half[: len(half) // 2],
            "rear_lidar",
            {"time": (TURN_S * half_at[: len(half) // 2]).astype("<f4")},
        )
        for stamp in STAMPS
    ]
    said += [ros.odometry("/odom", stamp, base) for stamp, base in zip(STAMPS, way(COUNT), strict=True)]
    said.append(ros.tf("base_link", {"front_lidar": MOUNT, "rear_lidar": behind}))
    return Sample(
        ros.ros2(folder / "robot", said), cloud=truth(points, parts, poses, MOUNT, TURN_S), wheels=COUNT
    )
