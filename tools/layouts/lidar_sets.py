"""Bags of public data sets with 3D lidars: topics, fields and frames as documented by their publishers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tools.layouts import messages as ros
from tools.layouts.camera_bags import LENS, looked_at
from tools.layouts.lidar_bags import COUNT, FIELDS, MOUNT, STAMPS, feel, livox, ring, truth, velodyne_at
from tools.layouts.lidars import TURN_S, ride
from tools.layouts.messages import Sent
from tools.layouts.samples import Sample, layout
from tools.layouts.world import placed, way


@layout("M2DGR", "lidar bags", "github.com/SJTU-ViSYS/M2DGR README: topics; truth as TUM text")
def _m2dgr(folder: Path) -> Sample:
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
def _mcd(folder: Path) -> Sample:
    said: list[Sent] = []
    points, parts, poses = ride(MOUNT)
    fields = FIELDS["Ouster PointCloud2"][3]
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
def _hilti(folder: Path) -> Sample:
    """Hesai with a clock in each point, five grey cameras, no tf."""
    said: list[Sent] = []
    points, parts, poses = ride(MOUNT)
    for k, stamp in enumerate(STAMPS):
        own = {
            "intensity": np.ones(len(points[k]), "<f4"),
            "timestamp": stamp + TURN_S * parts[k],
            "ring": ring(points[k]),
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
def _newer_college_bag(folder: Path) -> Sample:
    said: list[Sent] = []
    points, parts, poses = ride(MOUNT)
    fields = FIELDS["Ouster PointCloud2"][3]
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
def _kitti2bag(folder: Path) -> Sample:
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
def _urban_nav(folder: Path) -> Sample:
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
def _usyd(folder: Path) -> Sample:
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
def _backpack_3d(folder: Path) -> Sample:
    """Two lidars, one cloud a packet and not a turn; frames of a URDF that is not in the bag."""
    said: list[Sent] = []
    points, parts, poses = ride(MOUNT)
    for side in ("horizontal", "vertical"):
        for k in range(COUNT):
            for piece in range(36):
                chosen = (parts[k] >= piece / 36) & (parts[k] < (piece + 1) / 36)
                said.append(
                    ros.cloud(
                        f"{side}_laser_3d",
                        STAMPS[k] + TURN_S * piece / 36,
                        points[k][chosen],
                        f"{side}_vlp16_link",
                        {"intensity": np.ones(chosen.sum(), "<f4")},
                    )
                )
    said += feel("imu", "imu_link")
    cloud = truth(points, [np.floor(36 * part) / 36 for part in parts], poses)
    return Sample(ros.ros1(folder / "b3-2016-04-05-14-14-00.bag", said), cloud=cloud, imu=80)


@layout("PointCloud of ROS 1's first years", "lidar bags", "docs.ros.org sensor_msgs/PointCloud")
def _point_cloud_1(folder: Path) -> Sample:
    """Points as records, their times in a channel; a sonar says the same in 16 points."""
    points, parts, poses = ride(MOUNT)
    said = list(feel("/imu", "imu"))
    for k, stamp in enumerate(STAMPS):
        for topic, frame, chosen in (("/cloud", "lidar", slice(None)), ("/sonar", "sonar", slice(16))):
            items = [{"x": float(x), "y": float(y), "z": float(z)} for x, y, z in points[k][chosen]]
            times = {"name": "time", "values": TURN_S * parts[k][chosen]}
            channels = [{"name": "intensity", "values": np.ones(len(items))}, times]
            fields = {"points": items, "channels": channels}
            said.append(Sent(topic, ros.S + "PointCloud", stamp, fields, frame))
    return Sample(ros.ros1(folder / "old.bag", said), cloud=truth(points, parts, poses), imu=80)
