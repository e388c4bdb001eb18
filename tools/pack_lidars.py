"""Write clouds of a lidar in the layouts of public data sets; see `tools/pack_layouts.py`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from tools.pack_layouts import numbers, put, quaternion, tum_line

# As published for urban39: the left lidar in the vehicle.
TILTED = np.array(
    [
        [-0.516377, -0.702254, -0.490096, -0.334623],
        [0.491997, -0.711704, 0.501414, 0.431973],
        [-0.700923, 0.0177927, 0.713015, 1.94043],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
TILTED[:3, :3] = gtsam.Rot3.ClosestTo(TILTED[:3, :3]).matrix()


@dataclass(frozen=True)
class Turns:
    """Turns of a lidar: stamps, (N, 3) points with z up, (N,) times after the stamp, poses of the lidar.

    Of an IMU (M, 7) stamps, turn rates and forces in its own frame; without rows there is none.
    """

    stamps_s: list[float]
    points: list[Any]
    times_s: list[Any]
    poses: list[Any]
    imu: Any = field(default_factory=lambda: np.zeros((0, 7)))


def _imu(path: Path, turns: Turns, line: Callable[[float, Any, Any], str], head: str = "") -> None:
    """The file of an IMU, a line for each stamp, rate and force; none where there is no IMU."""
    if len(turns.imu):
        put(path, head + "".join(line(row[0], row[1:4], row[4:7]) + "\n" for row in turns.imu))


def _xsens(first_s: float) -> Callable[[float, Any, Any], str]:
    """Of MulRan and HeLiPR: quaternion, angles, rates, forces, magnetic field."""

    def line(stamp_s: float, rates: Any, forces: Any) -> str:
        others = numbers([0, 0, 0, 1, 0, 0, 0], ",")
        return f"{round(1e9 * (stamp_s + first_s))},{others},{numbers([*rates, *forces, 7, 8, 9], ',')}"

    return line


def _structured(fields: str, **columns: Any) -> bytes:
    """Rows of named columns, little-endian without gaps."""
    kinds = [(name, f"<{kind}") for name, kind in (field.split() for field in fields.split(","))]
    table = np.zeros(len(columns["x"]), np.dtype(kinds))
    for name, values in columns.items():
        table[name] = values
    return table.tobytes()


def _xyz(points: Any) -> dict[str, Any]:
    return dict(zip("xyz", points.T, strict=True))


def _rpy(pose: Any) -> list[float]:
    roll, pitch, yaw = gtsam.Rot3(pose[:3, :3]).rpy()
    return [roll, pitch, yaw]


def kitti_raw(folder: Path, turns: Turns) -> Path:
    """KITTI raw, synced; latitude and longitude are a car's near Karlsruhe."""
    drive = folder / "2011_09_26" / "2011_09_26_drive_0001_sync"
    put(drive.parent / "calib_imu_to_velo.txt", "calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    T_imu_velo = np.eye(4)
    T_imu_velo[:3, 3] = (0.8, -0.3, 0.8)
    radius, first = 6378137.0, np.radians([49.0, 8.4])
    scale, stamps, felt_at = np.cos(first[0]), "", ""
    for number, (stamp_s, points, _, _) in enumerate(_turns(turns)):
        row = np.column_stack([points, np.ones(len(points))]).astype("<f4")
        put(drive / "velodyne_points" / "data" / f"{number:010d}.bin", row.tobytes())
        stamps += f"2011-09-26 13:02:{25 + stamp_s:012.9f}\n"
    once_a_cloud = np.column_stack([turns.stamps_s, np.zeros((len(turns.stamps_s), 6))])
    for number, felt in enumerate(turns.imu if len(turns.imu) else once_a_cloud):
        felt_at += f"2011-09-26 13:02:{25 + felt[0]:012.9f}\n"
        imu = turns.poses[int(np.searchsorted(turns.stamps_s, felt[0], "right")) - 1] @ np.linalg.inv(
            T_imu_velo
        )
        east = scale * radius * first[1] + imu[0, 3]
        north = scale * radius * np.log(np.tan(np.pi / 4 + first[0] / 2)) + imu[1, 3]
        latitude = np.degrees(2 * np.arctan(np.exp(north / (scale * radius))) - np.pi / 2)
        place = [latitude, np.degrees(east / (scale * radius)), 112.0 + imu[2, 3], *_rpy(imu)]
        # Five speeds, forces and rates on the vehicle's axes and on level ones, two errors, five states.
        rates, forces, level = felt[1:4], felt[4:7], [0.0] * 3
        fields = [*place, *[0.0] * 5, *forces, *level, *rates, *level, 0.1, 0.1, *[4.0] * 5]
        put(drive / "oxts" / "data" / f"{number:010d}.txt", numbers(fields) + "\n")
    put(drive / "velodyne_points" / "timestamps.txt", stamps)
    put(drive / "oxts" / "timestamps.txt", felt_at)
    return drive


def _turns(turns: Turns) -> Any:
    return zip(turns.stamps_s, turns.points, turns.times_s, turns.poses, strict=True)


def nclt(folder: Path, turns: Turns) -> Path:
    """NCLT, z down."""
    day, down, truth = folder / "2012-01-08", np.diag([1.0, -1.0, -1.0, 1.0]), ""
    for stamp_s, points, _, pose in _turns(turns):
        ticks = round(1e6 * (stamp_s + 1326030975))
        steps = np.rint((points * (1, -1, -1) + 100.0) / 0.005)
        row = _structured("x u2, y u2, z u2, intensity u1, laser u1", **_xyz(steps))
        put(day / "velodyne_sync" / f"{ticks}.bin", row)
        turned = down @ pose @ down
        truth += f"{ticks}," + numbers([*turned[:3, 3], *_rpy(turned)], ",") + "\n"
    put(day / "odometry_mu_100hz.csv", truth)
    put(day / "groundtruth_2012-01-08.csv", truth)

    def line(stamp_s: float, rates: Any, forces: Any) -> str:
        return f"{round(1e6 * (stamp_s + 1326030975))},{numbers([0.1, 0.2, 0.3, *forces, *rates], ',')}"

    _imu(day / "ms25.csv", turns, line)
    return day


def mulran(folder: Path, turns: Turns) -> Path:
    """MulRan; poses are the car's."""
    mount = np.eye(4)
    mount[:3, :3] = gtsam.Rot3.Ypr(*np.radians([179.6654, 0.0003, 0.0001])).matrix()
    mount[:3, 3] = (1.7042, -0.021, 1.8047)
    truth = ""
    for stamp_s, points, _, pose in _turns(turns):
        ticks = round(1e9 * (stamp_s + 1561000444))
        put(
            folder / "Ouster" / f"{ticks}.bin",
            np.column_stack([points, np.ones(len(points))]).astype("<f4").tobytes(),
        )
        truth += f"{ticks}," + numbers((pose @ np.linalg.inv(mount))[:3], ",") + "\n"
    put(folder / "global_pose.csv", truth)
    _imu(folder / "sensor_data" / "xsens_imu.csv", turns, _xsens(1561000444))
    return folder


def helipr(folder: Path, turns: Turns) -> Path:
    """HeLiPR's Ouster."""
    truth = ""
    for stamp_s, points, times_s, pose in _turns(turns):
        ticks = round(1e9 * (stamp_s + 1689519044))
        fields = "x f4, y f4, z f4, intensity f4, t u4, reflectivity u2, ring u2, ambient u2"
        put(
            folder / "LiDAR" / "Ouster" / f"{ticks}.bin", _structured(fields, **_xyz(points), t=times_s * 1e9)
        )
        truth += tum_line(ticks, pose)
    put(folder / "LiDAR_GT" / "Ouster_gt.txt", truth)
    _imu(folder / "Inertial_data" / "xsens_imu.csv", turns, _xsens(1689519044))
    return folder


def boreas(folder: Path, turns: Turns) -> Path:
    """Boreas; angles turn the world into the sensor."""
    heading = "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading,w_z,w_y,w_x\n"
    truth = heading
    for stamp_s, points, times_s, pose in _turns(turns):
        ticks = round(1e6 * (stamp_s + 1606417097))
        fields = "x f4, y f4, z f4, intensity f4, laser f4, time f4"
        put(folder / "lidar" / f"{ticks}.bin", _structured(fields, **_xyz(points), time=times_s))
        angles = _rpy(np.linalg.inv(pose))
        truth += f"{ticks}," + numbers([*pose[:3, 3], 0, 0, 0, *angles, 0, 0, 0], ",") + "\n"
    put(folder / "applanix" / "lidar_poses.csv", truth)
    put(folder / "calib" / "T_applanix_lidar.txt", "0 -1 0 0\n1 0 0 0\n0 0 1 0.13\n0 0 0 1\n")

    def line(stamp_s: float, rates: Any, forces: Any) -> str:
        backward = numbers([*rates[::-1], *forces[::-1]], ",")
        return f"{stamp_s + 1606417097:.6f},{backward}"

    head = "GPSTime,angvel_z,angvel_y,angvel_x,accelz,accely,accelx\n"
    _imu(folder / "applanix" / "imu_raw.csv", turns, line, head)
    return folder


def newer_college(folder: Path, turns: Turns) -> Path:
    """Newer College 2020 as folders."""
    mount = np.eye(4)
    mount[:3, :3] = gtsam.Rot3.Yaw(np.radians(135.0)).matrix()
    mount[:3, 3] = (-0.084, -0.025, 0.050)
    truth = "#sec,nsec,x,y,z,qx,qy,qz,qw\n"
    for stamp_s, points, _, pose in _turns(turns):
        second, rest = divmod(round(1e9 * (stamp_s + 1583836591)), 10**9)
        content = _pcd(points)
        put(folder / "raw_format" / "ouster_scan" / f"cloud_{second}_{rest:09d}.pcd", content)
        of_base = pose @ np.linalg.inv(mount)
        truth += f"{second},{rest}," + numbers([*of_base[:3, 3], *quaternion(of_base)], ",") + "\n"
    put(folder / "ground_truth" / "registered_poses.csv", truth)

    def line(stamp_s: float, rates: Any, forces: Any) -> str:
        second, rest = divmod(round(1e9 * (stamp_s + 1583836591)), 10**9)
        return f"7,{second},{rest},{numbers([*rates, *forces], ',')}"

    _imu(folder / "raw_format" / "ouster_imu" / "ouster_imu.csv", turns, line)
    return folder


def _pcd(points: Any) -> bytes:
    head = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
    head += f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
    return head.encode() + points.astype("<f4").tobytes()


def oxford_spires(folder: Path, turns: Turns) -> Path:
    """Oxford Spires: clouds named by the clock, poses of the base."""
    mount = np.eye(4)
    mount[:3, :3] = np.diag([-1.0, -1.0, 1.0])
    mount[2, 3] = 0.124
    truth = ""
    for stamp_s, points, _, pose in _turns(turns):
        second, rest = divmod(round(1e9 * (stamp_s + 1710338123)), 10**9)
        put(folder / "raw" / "lidar-clouds" / f"{second}.{rest:09d}.pcd", _pcd(points))
        truth += tum_line(f"{second}.{rest:09d}", pose @ np.linalg.inv(mount))
    put(folder / "processed" / "trajectory" / "gt-tum.txt", truth)
    return folder


def complex_urban(folder: Path, turns: Turns) -> Path:
    """Complex Urban: two lidars on their sides, poses of the car; turns are of the left one."""
    truth, first_s = "", 1559194000
    for side in ("left", "right"):
        mounting = f"R: {numbers(TILTED[:3, :3])}\nT: {numbers(TILTED[:3, 3])}\n"
        put(folder / "calibration" / f"Vehicle2{side.title()}VLP.txt", mounting)
    for stamp_s, points, _, pose in _turns(turns):
        ticks = round(1e9 * (stamp_s + first_s))
        for side in ("left", "right"):
            row = np.column_stack([points, np.ones(len(points))]).astype("<f4")
            put(folder / "sensor_data" / f"VLP_{side}" / f"{ticks}.bin", row.tobytes())
        truth += f"{ticks}," + numbers((pose @ np.linalg.inv(TILTED))[:3], ",") + "\n"
    put(folder / "global_pose.csv", truth)
    _imu(folder / "sensor_data" / "xsens_imu.csv", turns, _xsens(first_s))
    return folder


def numbered(folder: Path, turns: Turns) -> Path:
    """Paris-Luco: numbered clouds, points on a clock of the whole drive, no list of stamps."""
    for number, (stamp_s, points, times_s, _) in enumerate(_turns(turns)):
        content = _structured("x f4, y f4, z f4, timestamp f8", **_xyz(points), timestamp=stamp_s + times_s)
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz")
        head += "property double timestamp\nend_header\n"
        put(folder / "frames" / f"frame_{number:04d}.ply", head.encode() + content)
    return folder / "frames"


LIDARS: dict[str, Callable[[Path, Turns], Path]] = {
    "kitti_raw": kitti_raw,
    "nclt": nclt,
    "mulran": mulran,
    "helipr": helipr,
    "boreas": boreas,
    "newer_college": newer_college,
    "oxford_spires": oxford_spires,
    "complex_urban": complex_urban,
    "numbered": numbered,
}
