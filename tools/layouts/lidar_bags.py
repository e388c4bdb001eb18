"""Bags of 3D lidars, with the fields, frames and packets of their drivers."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tools.layouts import messages as ros
from tools.layouts.camera_bags import LENS, looked_at
from tools.layouts.lidars import RINGS, TURN_S, ride, still
from tools.layouts.messages import START_S, Sent
from tools.layouts.samples import CloudTruth, Sample, layout
from tools.layouts.world import hits, placed, turn, way

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


def _ring(points: Any) -> Any:
    return np.tile(np.arange(len(RINGS)), len(points) // len(RINGS)).astype("<u2")


_FIELDS: dict[
    str, tuple[str, str, str, Callable[[Any, Any, float], dict[str, Any]], float, dict[str, Any]]
] = {
    "Velodyne PointCloud2": (
        "/velodyne_points",
        "velodyne",
        "github.com/ros-drivers/velodyne velodyne_pointcloud: time, ring",
        lambda p, at, s: {
            "intensity": np.ones(len(p), "<f4"),
            "ring": _ring(p),
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
            "ring": _ring(p),
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
            "ring": _ring(p),
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
            "ring": _ring(p),
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
    topic, frame, _, fields, early_s, more = _FIELDS[name]

    def write(folder: Path) -> Sample:
        points, parts, poses = ride(MOUNT)
        said = [
            ros.cloud(topic, STAMPS[k], points[k], frame, fields(points[k], parts[k], STAMPS[k]), **more)
            for k in range(COUNT)
        ]
        timed = None if name == "PointCloud2 without times" else parts
        return Sample(ros.ros2(folder / "drive", said), cloud=truth(points, timed, poses, early_s=early_s))

    return write


for _name in _FIELDS:
    layout(_name, "lidar bags", _FIELDS[_name][2])(_driver(_name))


def packets(pose: Any, stamp_s: float) -> list[dict[str, Any]]:
    """A turn of a VLP-16 as its manual has it: 76 packets of 12 blocks of two firings of 16 lasers."""
    order = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], float)
    told, block = [], 0
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
        told.append({"stamp": ros.header(at, "")["stamp"], "data": np.frombuffer(data, np.uint8)})
    return told


@layout("VelodyneScan packets", "lidar bags", "VLP-16 user manual; velodyne_msgs/VelodyneScan")
def velodyne_packets(folder: Path) -> Sample:
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


@layout("Ouster packets", "lidar bags", "ouster-ros PacketMsg.msg")
def ouster_packets(folder: Path) -> Sample:
    said = [
        Sent(
            "/ouster/lidar_packets",
            "ouster_sensor_msgs/msg/PacketMsg",
            START_S + 0.001 * k,
            {"buf": np.zeros(12608, np.uint8)},
        )
        for k in range(30)
    ]
    return Sample(ros.ros2(folder / "os", said), refused=r"ouster_ros.*replay")


def velodyne_at(topic: str, frame: str, mount: Any, said: list[Sent]) -> tuple[Any, ...]:
    """Clouds of a Velodyne on a robot."""
    points, parts, poses = ride(mount)
    fields = _FIELDS["Velodyne PointCloud2"][3]
    said += [
        ros.cloud(topic, STAMPS[k], points[k], frame, fields(points[k], parts[k], 0.0)) for k in range(COUNT)
    ]
    return points, parts, poses


@layout("two lidars and wheels", "lidar bags", "REP 105; a robot with /front and /rear lidars")
def two_lidars(folder: Path) -> Sample:
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


@layout("M2DGR", "lidar bags", "github.com/SJTU-ViSYS/M2DGR README: topics; truth as TUM text")
def m2dgr(folder: Path) -> Sample:
    """Six cameras without depth, a Velodyne, two IMUs, GNSS, no tf."""
    said: list[Sent] = []
    points, parts, poses = velodyne_at("/velodyne_points", "velodyne", MOUNT, said)
    said += feel("/handsfree/imu", "imu")
    said += feel("/camera/imu", "camera_imu")
    picture = ros.coded(looked_at(LENS, placed(0, 0, 1)).color, ".jpg")
    for stamp in STAMPS:
        for side in ("third", "left", "right", "head"):
            said.append(
                ros.squeezed(
                    f"/camera/{side}/image_raw/compressed", stamp, picture, "bgr8; jpeg compressed bgr8", side
                )
            )
        said.append(
            Sent(
                "/ublox/fix",
                ros.S + "NavSatFix",
                stamp,
                {
                    "latitude": 31.0,
                    "longitude": 121.4,
                    "altitude": 20.0,
                    "position_covariance": np.eye(3),
                    "position_covariance_type": 2,
                },
                "gps",
            )
        )
    path = ros.ros1(folder / "street_01.bag", said)
    return Sample(path, cloud=truth(points, parts, poses, early_s=TURN_S), imu=80)


@layout("MCD, Ouster and Livox", "lidar bags", "mcdviral.github.io/UserManual.html")
def mcd(folder: Path) -> Sample:
    said: list[Sent] = []
    points, parts, poses = ride(MOUNT)
    fields = _FIELDS["Ouster PointCloud2"][3]
    for k, stamp in enumerate(STAMPS):
        own = fields(points[k], parts[k], stamp)
        own["ring"] = own["ring"].astype("u1")
        said.append(ros.cloud("/os_cloud_node/points", stamp, points[k], "os_sensor", own, gap=4, rows=16))
        said.append(
            livox(
                points[k][:400],
                parts[k][:400],
                stamp + 0.01,
                "livox_ros_driver",
                "/livox/lidar",
                "livox_frame",
            )
        )
    said += [
        *feel("/vn100/imu", "vn100"),
        *feel("/os_cloud_node/imu", "os_imu"),
        *feel("/d455b/imu", "d455b"),
    ]
    said += [
        ros.image("/d455b/color/image_raw", stamp, looked_at(LENS, placed(0, 0, 1)).color, "rgb8", "d455b")
        for stamp in STAMPS[:3]
    ]
    return Sample(ros.ros1(folder / "ntu_day_01.bag", said), cloud=truth(points, parts, poses), imu=80)


@layout("Hilti 2022", "lidar bags", "hilti-challenge.com/dataset-2022: topics")
def hilti(folder: Path) -> Sample:
    """Hesai with a clock in each point, five grey cameras, no tf."""
    said: list[Sent] = []
    points, parts, poses = ride(MOUNT)
    for k, stamp in enumerate(STAMPS):
        own = {
            "intensity": np.ones(len(points[k]), "<f4"),
            "timestamp": stamp + TURN_S * parts[k],
            "ring": _ring(points[k]),
        }
        said.append(ros.cloud("/hesai/pandar", stamp, points[k], "PandarXT-32", own, gap=4))
    said += feel("/alphasense/imu", "imu_sensor_frame")
    grey = looked_at(LENS, placed(0, 0, 1)).color[..., 0]
    said += [
        ros.image(f"/alphasense/cam{n}/image_raw", stamp, grey, "mono8", f"cam{n}")
        for stamp in STAMPS[:4]
        for n in range(5)
    ]
    return Sample(
        ros.ros1(folder / "exp01_construction_ground_level.bag", said),
        cloud=truth(points, parts, poses),
        imu=80,
    )


@layout("Newer College 2021, multi-cam", "lidar bags", "ori-drs.github.io/newer-college-dataset/multi-cam")
def newer_college_bag(folder: Path) -> Sample:
    said: list[Sent] = []
    points, parts, poses = ride(MOUNT)
    fields = _FIELDS["Ouster PointCloud2"][3]
    said += [
        ros.cloud(
            "/os_cloud_node/points",
            STAMPS[k],
            points[k],
            "os_lidar",
            fields(points[k], parts[k], 0.0),
            gap=4,
            rows=16,
        )
        for k in range(COUNT)
    ]
    said += [*feel("/os_cloud_node/imu", "os_imu"), *feel("/alphasense_driver_ros/imu", "imu_sensor_frame")]
    said.append(
        ros.tf(
            "os_sensor",
            {"os_lidar": placed(0.0, 0.0, 0.036, yaw=np.pi), "os_imu": placed(0.006, -0.012, 0.008)},
        )
    )
    return Sample(
        ros.ros1(folder / "quad-easy.bag", said),
        cloud=truth(points, parts, poses, placed(0.0, 0.0, 0.036, yaw=np.pi)),
        imu=80,
    )


@layout("KITTI by kitti2bag", "lidar bags", "github.com/tomas789/kitti2bag kitti2bag.py: topics, frames")
def kitti2bag(folder: Path) -> Sample:
    """Clouds without times; tf has the truth from world to base_link."""
    said: list[Sent] = []
    points, _, poses = ride(placed(-0.8, 0.3, 0.9))
    mount = placed(-0.8, 0.3, 0.9)
    for k, (stamp, base) in enumerate(zip(STAMPS, way(COUNT), strict=True)):
        said.append(
            ros.cloud(
                "/kitti/velo/pointcloud", stamp, points[k], "velo_link", {"i": np.ones(len(points[k]), "<f4")}
            )
        )
        said.append(ros.imu("/kitti/oxts/imu", stamp, "imu_link"))
        said.append(ros.tf("world", {"base_link": base}, stamp, static=False))
        said.append(
            ros.image(
                "/kitti/camera_gray_left/image_raw",
                stamp,
                looked_at(LENS, placed(0, 0, 1)).color[..., 0],
                "mono8",
                "camera_gray_left",
            )
        )
    said.append(ros.tf("base_link", {"imu_link": placed()}))
    said.append(ros.tf("imu_link", {"velo_link": mount}))
    return Sample(
        ros.ros1(folder / "kitti_2011_09_26_drive_0001_synced.bag", said),
        cloud=truth(points, None, poses, mount),
    )


@layout("UrbanNav", "lidar bags", "github.com/IPNL-POLYU/UrbanNavDataset: topics")
def urban_nav(folder: Path) -> Sample:
    said: list[Sent] = []
    points, parts, poses = velodyne_at("/velodyne_points", "velodyne", MOUNT, said)
    said += feel("/imu/data", "imu_link")
    said += [
        ros.image("/camera/image_color", stamp, looked_at(LENS, placed(0, 0, 1)).color, "bgr8", "camera")
        for stamp in STAMPS[:3]
    ]
    said += [
        Sent(
            "/novatel_data/inspvax",
            ros.S + "NavSatFix",
            stamp,
            {
                "latitude": 22.3,
                "longitude": 114.1,
                "position_covariance": np.eye(3),
                "position_covariance_type": 2,
            },
            "span",
        )
        for stamp in STAMPS
    ]
    return Sample(
        ros.ros1(folder / "UrbanNav-HK.bag", said), cloud=truth(points, parts, poses, early_s=TURN_S), imu=80
    )


@layout("USYD Campus", "lidar bags", "its.acfr.usyd.edu.au/datasets/usyd-campus-dataset: topics")
def usyd(folder: Path) -> Sample:
    """A car: wheels, a Velodyne, tf; six cameras without depth."""
    said: list[Sent] = []
    points, parts, poses = velodyne_at("/velodyne/front/points", "velodyne_front_link", MOUNT, said)
    said += feel("/vn100/imu", "vn100")
    said += [
        ros.odometry("/vn100/odometry", stamp, base) for stamp, base in zip(STAMPS, way(COUNT), strict=True)
    ]
    said.append(ros.tf("base_link", {"velodyne_front_link": MOUNT, "vn100": placed()}))
    return Sample(
        ros.ros1(folder / "week1.bag", said),
        cloud=truth(points, parts, poses, MOUNT, TURN_S),
        wheels=COUNT,
        imu=80,
    )


@layout("Cartographer backpack 3D", "lidar bags", "google-cartographer-ros: public data, backpack_3d.urdf")
def backpack_3d(folder: Path) -> Sample:
    """Two lidars, one cloud a packet and not a turn; frames of a URDF that is not in the bag."""
    said: list[Sent] = []
    points, parts, poses = ride(MOUNT)
    for side in ("horizontal", "vertical"):
        for k in range(COUNT):
            for piece in range(8):
                chosen = (parts[k] >= piece / 8) & (parts[k] < (piece + 1) / 8)
                said.append(
                    ros.cloud(
                        f"{side}_laser_3d",
                        STAMPS[k] + TURN_S * piece / 8,
                        points[k][chosen],
                        f"{side}_vlp16_link",
                        {"intensity": np.ones(chosen.sum(), "<f4")},
                    )
                )
    said += feel("imu", "imu_link")
    cloud = truth(points, [np.floor(8 * part) / 8 for part in parts], poses)
    return Sample(ros.ros1(folder / "b3-2016-04-05-14-14-00.bag", said), cloud=cloud, imu=80)


@layout("PointCloud of ROS 1's first years", "lidar bags", "docs.ros.org sensor_msgs/PointCloud")
def point_cloud_1(folder: Path) -> Sample:
    points = ride(MOUNT, 1)[0][0][:100]
    fields = {"points": [{"x": float(x), "y": float(y), "z": float(z)} for x, y, z in points]}
    said = [Sent("/cloud", ros.S + "PointCloud", stamp, fields, "lidar") for stamp in STAMPS]
    return Sample(ros.ros1(folder / "old.bag", said), refused="point_cloud_converter")
