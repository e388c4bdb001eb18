"""Robots with 2D lidars: bags, CARMEN logs, and similar formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tools.layouts import messages as ros
from tools.layouts.camera_bags import LENS, looked_at, mm
from tools.layouts.messages import START_S, Sent
from tools.layouts.samples import CameraTruth, Sample, ScanTruth, layout
from tools.layouts.world import OPTICAL, placed, scanned, way
from tools.pack_layouts import numbers, put

COUNT = 30
STAMPS = [START_S + 0.1 * k for k in range(COUNT)]
FULL = np.radians(np.arange(360.0))
HALF = np.radians(np.arange(-90.0, 90.5, 1.0))


def seen(mount: tuple[float, float, float], bearings: Any, z: float = 0.3, count: int = COUNT) -> list[Any]:
    """Ranges of a scanner on the way."""
    x, y, yaw = mount
    return [scanned(base @ placed(x, y, z, yaw), bearings) for base in way(count)]


def _robot(
    topic: str,
    frame: str,
    mount: tuple[float, float, float],
    bearings: Any,
    step: float,
    said: list[Sent],
    odom: str = "/odom",
    base: str = "base_link",
) -> ScanTruth:
    """Scans, wheels and frames of a robot."""
    ranges = seen(mount, bearings)
    for stamp, one, pose in zip(STAMPS, ranges, way(COUNT), strict=True):
        said.append(ros.scan(topic, stamp, one, float(bearings[0]), step, frame))
        if odom:
            said.append(ros.odometry(odom, stamp - 0.01, pose, "odom", base))
    said.append(ros.tf(base, {frame: placed(mount[0], mount[1], 0.3, mount[2])}))
    return ScanTruth(STAMPS, bearings, ranges, mount)


@layout("TurtleBot 3", "2D robots", "emanual.robotis.com turtlebot3: topics")
def _turtlebot3(folder: Path) -> Sample:
    said: list[Sent] = []
    truth = _robot(
        "/scan", "base_scan", (-0.064, 0.0, 0.0), FULL, np.radians(1.0), said, base="base_footprint"
    )
    said += [ros.imu("/imu", stamp, "imu_link") for stamp in STAMPS]
    said += [
        ros.tf("odom", {"base_footprint": pose}, stamp, static=False)
        for stamp, pose in zip(STAMPS, way(COUNT), strict=True)
    ]
    said += [
        ros.squeezed("/camera/image_raw/compressed", stamp, b"\xff\xd8\xff", "jpeg", "camera")
        for stamp in STAMPS
    ]
    said.append(ros.tf("base_footprint", {"imu_link": placed(0.0, 0.0, 0.07)}))
    return Sample(ros.ros2(folder / "tb3", said), scans=(truth,), wheels=COUNT, imu=0)


@layout("TurtleBot 4", "2D robots", "turtlebot.github.io/turtlebot4-user-manual: topics, OAK-D")
def _turtlebot4(folder: Path) -> Sample:
    """A namespace, colour in a small preview, depth in another size, wheels and a filter."""
    said: list[Sent] = []
    space, mount = "/tb4_1", placed(-0.04, 0.0, 0.3) @ OPTICAL
    truth = _robot(
        f"{space}/scan", "rplidar_link", (-0.04, 0.0, 1.57), FULL, np.radians(1.0), said, f"{space}/odom"
    )
    frame = "oakd_rgb_camera_optical_frame"
    shown = STAMPS[::5]
    poses = [base @ mount for base in way(COUNT)[::5]]
    for stamp, pose in zip(shown, poses, strict=True):
        view = looked_at(LENS, pose)
        said.append(ros.image(f"{space}/oakd/rgb/image_raw", stamp, view.color[..., ::-1], "bgr8", frame))
        said.append(ros.info(f"{space}/oakd/rgb/camera_info", stamp, LENS, frame))
        said.append(ros.image(f"{space}/oakd/stereo/image_raw", stamp, mm(view.depth_m), "16UC1", frame))
        said.append(ros.info(f"{space}/oakd/stereo/camera_info", stamp, LENS, frame))
    said.append(ros.tf("base_link", {frame: mount}))
    camera = CameraTruth(LENS, shown, poses, mount)
    return Sample(ros.ros2(folder / "tb4", said), cameras=(camera,), scans=(truth,), wheels=COUNT)


@layout("wheels and a filter", "2D robots", "docs.ros.org robot_localization: odometry/filtered")
def _two_odometries(folder: Path) -> Sample:
    said: list[Sent] = []
    truth = _robot("/scan", "laser", (0.1, 0.0, 0.0), FULL, np.radians(1.0), said, "/wheel/odometry")
    said += [ros.odometry("/odometry/filtered", stamp, placed(), "odom", "base_link") for stamp in STAMPS]
    return Sample(ros.ros2(folder / "two", said), scans=(truth,), wheels=COUNT)


@layout("scan and a 3D cloud", "2D robots", "pointcloud_to_laserscan: a scan made of a cloud")
def _two_scanners(folder: Path) -> Sample:
    """Two scanners with mountings in tf: both are read."""
    said: list[Sent] = []
    front = _robot("/scan_front", "laser_front", (0.3, 0.2, 0.78), HALF, np.radians(1.0), said)
    rear = _robot("/scan_rear", "laser_rear", (-0.3, -0.2, -2.36), HALF, np.radians(1.0), said, odom="")
    return Sample(ros.ros2(folder / "agv", said, mcap=True), scans=(front, rear), wheels=COUNT)


@layout("two robots by namespaces", "2D robots", "wiki.ros.org/Names: tf frames with a prefix")
def _two_robots(folder: Path) -> Sample:
    said: list[Sent] = []
    for name in ("robot1", "robot2"):
        own: list[Sent] = []
        truth = _robot(
            f"/{name}/scan",
            f"{name}/laser",
            (0.1, 0.0, 0.0),
            FULL,
            np.radians(1.0),
            own,
            f"/{name}/odom",
            f"{name}/base_link",
        )
        said += own
    return Sample(ros.ros2(folder / "fleet", said), scans=(truth,), wheels=COUNT)


@layout("wheels in tf alone", "2D robots", "REP 105: odom to base_link, no odometry topic")
def _wheels_in_tf(folder: Path) -> Sample:
    said: list[Sent] = []
    truth = _robot("/scan", "laser", (0.1, 0.0, 0.0), FULL, np.radians(1.0), said, odom="")
    said += [
        ros.tf("odom", {"base_link": pose}, stamp - 0.01, static=False, old=True)
        for stamp, pose in zip(STAMPS, way(COUNT), strict=True)
    ]
    return Sample(ros.ros1(folder / "robot.bag", said), scans=(truth,), wheels=COUNT)


@layout("Path as the truth", "2D robots", "nav_msgs/Path named ground_truth")
def _path_truth(folder: Path) -> Sample:
    said: list[Sent] = []
    truth = _robot("/scan", "laser", (0.1, 0.0, 0.0), FULL, np.radians(1.0), said)
    said.append(ros.path("/ground_truth", STAMPS[-1], STAMPS, way(COUNT)))
    return Sample(ros.ros2(folder / "path", said), scans=(truth,), wheels=COUNT, moved=way(COUNT))


@layout("MIT Stata Center", "2D robots", "projects.csail.mit.edu/stata: PR2 topics base_scan, tf")
def _stata(folder: Path) -> Sample:
    """A PR2: base and tilting scanner, wheels and a filter in tf, Kinect."""
    said: list[Sent] = []
    truth = _robot(
        "/base_scan",
        "base_laser_link",
        (0.275, 0.0, 0.0),
        np.radians(np.arange(-130.0, 130.2, 1.0)),
        np.radians(1.0),
        said,
        "/base_odometry/odom",
        "base_footprint",
    )
    for stamp, pose, one in zip(STAMPS, way(COUNT), seen((0.0, 0.0, 0.0), HALF, 0.8), strict=True):
        said.append(ros.tf("odom_combined", {"base_footprint": pose}, stamp, static=False, old=True))
        said.append(
            ros.tf(
                "base_footprint",
                {
                    "base_laser_link": placed(0.275, 0.0, 0.3),
                    "laser_tilt_link": placed(0.0, 0.0, 0.8, pitch=0.5 * np.sin(5 * (stamp - START_S))),
                },
                stamp,
                static=False,
                old=True,
            )
        )
        said.append(ros.scan("/tilt_scan", stamp, one, float(HALF[0]), np.radians(1.0), "laser_tilt_link"))
        said.append(
            ros.odometry("/robot_pose_ekf/odom_combined", stamp, placed(), "odom_combined", "base_footprint")
        )
    said = [one for one in said if one.topic != "/tf_static"]
    return Sample(ros.ros1(folder / "2012-01-18-09-09-07.bag", said), scans=(truth,), wheels=COUNT)


@layout("Deutsches Museum 2D", "2D robots", "google-cartographer-ros public data, backpack_2d.urdf")
def _deutsches_museum(folder: Path) -> Sample:
    """Echoes of two scanners and an IMU, no wheels; the frames are in a URDF that comes apart."""
    bearings = np.radians(np.arange(-135.0, 135.2, 0.5))
    said: list[Sent] = []
    mount = (0.1007, 0.0, 0.0)
    ranges = seen(mount, bearings)
    for stamp, one in zip(STAMPS, ranges, strict=True):
        for topic, frame in (
            ("horizontal_laser_2d", "horizontal_laser_link"),
            ("vertical_laser_2d", "vertical_laser_link"),
        ):
            echoes = [{"echoes": [float(r)]} for r in one]
            fields = {
                "angle_min": bearings[0],
                "angle_max": bearings[-1],
                "angle_increment": np.radians(0.5),
                "range_min": 0.02,
                "range_max": 30.0,
                "ranges": echoes,
            }
            said.append(Sent(topic, ros.S + "MultiEchoLaserScan", stamp, fields, frame))
    said += [ros.imu("imu", START_S + 0.01 * k, "imu_link") for k in range(300)]
    urdf = put(folder / "elsewhere" / "backpack_2d.urdf", _URDF)
    path = ros.ros1(folder / "b2-2016-04-05.bag", said)
    return Sample(
        path, scans=(ScanTruth(STAMPS, bearings, ranges, mount),), mend=("--calibration", str(urdf))
    )


_URDF = """<robot name="cartographer_backpack_2d">
  <link name="imu_link"/><link name="horizontal_laser_link"/>
  <link name="vertical_laser_link"/><link name="base_link"/>
  <joint name="i" type="fixed"><parent link="base_link"/><child link="imu_link"/>
    <origin xyz="0 0 0"/></joint>
  <joint name="h" type="fixed"><parent link="base_link"/><child link="horizontal_laser_link"/>
    <origin xyz="0.1007 0 0.0558"/></joint>
  <joint name="v" type="fixed"><parent link="base_link"/><child link="vertical_laser_link"/>
    <origin xyz="0.1007 0 0.1814" rpy="1.5708 0 0"/></joint>
</robot>
"""


def _basic(said: list[Sent]) -> ScanTruth:
    return _robot("/scan", "laser", (0.1, 0.0, 0.0), FULL, np.radians(1.0), said)


@layout("rosbag2 split in files", "2D robots", "github.com/ros2/rosbag2 README: splitting files")
def _split_bag(folder: Path) -> Sample:
    """Two databases of one recording, metadata.yaml beside them."""
    said: list[Sent] = []
    truth = _basic(said)
    middle = START_S + 1.5
    early = ros.ros2(folder / "a", [one for one in said if one.stamp_s < middle])
    late = ros.ros2(folder / "b", [one for one in said if one.stamp_s >= middle])
    place = folder / "rosbag2_2023_11_14-22_13_20"
    place.mkdir()
    (early / "a.db3").rename(place / f"{place.name}_0.db3")
    (late / "b.db3").rename(place / f"{place.name}_1.db3")
    names = [f"{place.name}_{k}.db3" for k in (0, 1)]
    text = (early / "metadata.yaml").read_text().replace("a.db3", names[0])
    put(place / "metadata.yaml", text.replace(f"- {names[0]}", f"- {names[0]}\n  - {names[1]}", 1))
    return Sample(place, scans=(truth,), wheels=COUNT)


def _zstd(by: str) -> Callable[[Path], Sample]:
    """A bag that its recorder compressed, by file or by message."""

    def write(folder: Path) -> Sample:
        said: list[Sent] = []
        truth = _basic(said)
        return Sample(ros.ros2(folder / "z", said, packed=by), scans=(truth,), wheels=COUNT)

    return write


for _by in ("file", "message"):
    _source = f"github.com/ros2/rosbag2 README: compression mode {_by}"
    layout(f"rosbag2, zstd by {_by}", "2D robots", _source)(_zstd(_by.upper()))


def _carmen(kind: str) -> str:
    """A log of one robot: wheels and scans in the words of CARMEN's logger."""
    lines = "# CARMEN Logfile\nPARAM robot_frontlaser_offset 0.1 nohost 0\n"
    lines += "PARAM robot_front_laser_max 81.9 nohost 0\n"
    for k, (base, ranges) in enumerate(zip(way(COUNT), seen((0.1, 0.0, 0.0), HALF), strict=True)):
        yaw = float(np.arctan2(base[1, 0], base[0, 0]))
        robot = [base[0, 3], base[1, 3], yaw]
        laser = base @ placed(0.1)
        own = [laser[0, 3], laser[1, 3], yaw]
        at = f"{0.2 * k + 10:.6f}"
        lines += f"ODOM {numbers(robot)} 0.1 0.02 0 {at} host {at}\n"
        if kind == "FLASER":
            row = " ".join(f"{r:.2f}" for r in ranges)
            lines += f"FLASER {len(ranges)} {row} {numbers(own)} {numbers(robot)} {at} host {at}\n"
        else:
            angles = f"{HALF[0]:.6f} {HALF[-1] - HALF[0]:.6f} {np.radians(1.0):.6f}"
            head = f"{kind} 0 {angles} 81.9 0.01 0 {len(ranges)}"
            tail = (
                f"{numbers(own)} {numbers(robot)} 0.1 0.02 0.3 0.3 1000000 "
                if kind.startswith("ROBOT")
                else ""
            )
            lines += f"{head} {' '.join(f'{r:.3f}' for r in ranges)} 0 {tail}{at} host {at}\n"
    return lines


def _carmen_layout(kind: str, title: str) -> None:
    def write(folder: Path) -> Sample:
        path = put(folder / "csail.log", _carmen(kind))
        mount = None if kind.startswith("RAW") else (0.1, 0.0, 0.0)
        truth = ScanTruth([0.2 * k for k in range(COUNT)], HALF, seen((0.1, 0.0, 0.0), HALF), mount)
        return Sample(path, scans=(truth,), wheels=COUNT)

    layout(title, "2D robots", "carmen.sourceforge.net logger_file_format; radish.sourceforge.net")(write)


_carmen_layout("FLASER", "CARMEN, FLASER")
_carmen_layout("ROBOTLASER1", "CARMEN, ROBOTLASER1")
_carmen_layout("RAWLASER1", "CARMEN, RAWLASER1")


@layout("CARMEN, relations beside gfs.log", "2D robots", "openslam.org gmapping logs: intel.gfs.log")
def _gfs_log(folder: Path) -> Sample:
    """GMapping's corrected log: robot poses are corrected ones, ODOM lines are raw."""
    text = _carmen("FLASER").replace(
        "# CARMEN Logfile\n",
        "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n",
    )
    path = put(folder / "intel.gfs.log", text)
    truth = ScanTruth([0.2 * k for k in range(COUNT)], HALF, seen((0.1, 0.0, 0.0), HALF), (0.1, 0.0, 0.0))
    return Sample(path, scans=(truth,), wheels=COUNT)


@layout("Player log of Radish", "2D robots", "playerstage.sourceforge.net writelog: version 0.3")
def _player_log(folder: Path) -> Sample:
    """Messages of an interface each, what the lidar's place is among them."""
    lines = "## Player version 2.0.0\n## File version 0.3.0\n## Format:\n"
    lines += "1090517113.000 16777343 6665 laser 00 004 001 +0.100 +0.000 0.000 0.150 0.150\n"
    mount = (0.1, 0.0, 0.0)
    ranges = seen(mount, HALF)
    for k, (base, one) in enumerate(zip(way(COUNT), ranges, strict=True)):
        yaw = float(np.arctan2(base[1, 0], base[0, 0]))
        at = f"{1090517113 + 0.2 * k:014.3f}"
        place = f"{base[0, 3]:+07.3f} {base[1, 3]:+07.3f} {yaw:+07.3f}"
        lines += f"{at} 16777343 6665 position2d 00 001 001 {place} +00.000 +00.000 +00.000 0\n"
        lines += f"{at} 16777343 6665 sonar 00 001 001 16" + " 5.000" * 16 + "\n"
        row = " ".join(f"{r:.3f} 0" for r in one)
        angles = f"-1.5708 +1.5708 +0.01745329 +81.92 {len(one):04d}"
        lines += f"{at} 16777343 6665 laser 00 001 001 {k:04d} {angles} {row}\n"
    truth = ScanTruth([0.2 * k for k in range(COUNT)], HALF, ranges, mount)
    return Sample(put(folder / "run.log", lines), scans=(truth,), wheels=COUNT)


@layout("Rawseeds", "2D robots", "rawseeds.org file formats: SICK_FRONT.csv, ODOMETRY_XYT.csv")
def _rawseeds(folder: Path) -> Sample:
    """A table a sensor; where they sit is in none of them."""
    name, ranges = "Bicocca_2009-02-25b", seen((0.0, 0.0, 0.0), HALF)
    tables = dict.fromkeys(("SICK_FRONT", "SICK_REAR", "ODOMETRY_XYT", "GROUNDTRUTH"), "")
    for k, (base, one) in enumerate(zip(way(COUNT), ranges, strict=True)):
        at = f"{1235578000 + 0.1 * k:.6f}"
        for scanner in ("SICK_FRONT", "SICK_REAR"):
            tables[scanner] += f"{at}, {len(one)}, 0, " + ", ".join(f"{r:.3f}" for r in one) + "\n"
        place = f"{base[0, 3]:.5f}, {base[1, 3]:.5f}, {np.arctan2(base[1, 0], base[0, 0]):.5f}"
        tables["ODOMETRY_XYT"] += f"{at}, {k}, 0, 0, {place}\n"
        tables["GROUNDTRUTH"] += f"{at}, {place}, 0.001, 0, 0, 0, 0.001, 0, 0, 0, 0.001\n"
    for table, text in tables.items():
        put(folder / name / f"{name}-{table}.csv", text)
    scans = ScanTruth([0.1 * k for k in range(COUNT)], HALF, ranges)
    return Sample(folder / name, scans=(scans,), wheels=COUNT, moved=way(COUNT))


@layout("MRPT .rawlog", "2D robots", "docs.mrpt.org rawlog format; mrpt_rawlog rawlog_play_node: odom, scan")
def _rawlog(folder: Path) -> Sample:
    """Classes of MRPT, written one behind the other; its node plays them as a robot's topics."""
    said: list[Sent] = []
    truth = _robot("/laser", "laser", (0.1, 0.0, 0.0), FULL, np.radians(1.0), said)
    path = put(folder / "dataset.rawlog", b"\x80CObservation2DRangeScan" + bytes(300))
    played = ("rawlog_play_node", lambda: ros.ros2(folder / "bag", said))
    return Sample(path, scans=(truth,), wheels=COUNT, refused=r"(?i)rawlog", by_hand=played)


@layout(
    "slam_toolbox's pose graph", "2D robots", "github.com/SteveMacenski/slam_toolbox README: serialization"
)
def _posegraph(folder: Path) -> Sample:
    """What is left of a run beside the bag that it was made from."""
    said: list[Sent] = []
    truth = _basic(said)
    put(folder / "map.posegraph", b"\x16\x00\x00\x00\x00\x00\x00\x00serialization::archive" + bytes(200))
    given = ("the recording that it was made from", lambda: ros.ros2(folder / "bag", said))
    path = folder / "map.posegraph"
    return Sample(path, scans=(truth,), wheels=COUNT, refused="map.*bag", by_hand=given)
