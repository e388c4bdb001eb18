"""Folders of 3D lidars: those of `tools/pack_lidars.py`, and others."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.measurements import FloatArray
from tools.layouts.samples import CloudTruth, Sample, layout
from tools.layouts.world import placed, turn, way
from tools.pack_layouts import numbers, put, rows, tum_line
from tools.pack_lidars import LIDARS, TILTED, Turns

COUNT = 10
RINGS = np.linspace(-15.0, 15.0, 16)
TURN_S = 0.1
STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])


def ride(
    mount: FloatArray, count: int = COUNT, rings: Any = RINGS, columns: int = 360
) -> tuple[list[Any], ...]:
    """Points, parts of a turn and poses of a lidar that sits on a robot."""
    poses = [base @ mount for base in way(count)]
    turns = [turn(pose, rings, columns) for pose in poses]
    return [one[0] for one in turns], [one[1] for one in turns], poses


def still(first_s: float = 0.0, seconds: float = TURN_S * COUNT, rate_hz: float = 100.0) -> FloatArray:
    """(M, 7) readings of an IMU that stands still."""
    stamps = first_s + np.arange(0.0, seconds, 1.0 / rate_hz)
    return np.column_stack([stamps, np.tile(STILL, (len(stamps), 1))])


_PACKED = {
    "kitti_raw": ("KITTI raw, synced", "cvlibs.net/datasets/kitti/raw_data.php, devkit readme.txt", False),
    "nclt": ("NCLT", "robots.engin.umich.edu/nclt, nclt.pdf", False),
    "mulran": ("MulRan", "sites.google.com/view/mulran-pr/data-format", False),
    "helipr": ("HeLiPR, Ouster", "sites.google.com/view/heliprdataset/data-format", True),
    "boreas": ("Boreas", "boreas.utias.utoronto.ca, pyboreas DATA_REFERENCE.md", True),
    "newer_college": (
        "Newer College 2020, folders",
        "ori-drs.github.io/newer-college-dataset/stereo-cam/data-formats",
        False,
    ),
    "oxford_spires": ("Oxford Spires", "dynamic.robots.ox.ac.uk/datasets/oxford-spires/data-format", False),
    "complex_urban": ("KAIST Complex Urban", "sites.google.com/view/complex-urban-dataset/format", False),
    "numbered": (
        "Paris-Luco, PLY numbered",
        "github.com/jedeschaud/ct_icp: frames/*.ply, field timestamp",
        True,
    ),
}
_SITS = {
    "mulran": gtsam.Pose3(
        gtsam.Rot3.Ypr(*np.radians([179.6654, 0.0003, 0.0001])), np.array([1.7042, -0.021, 1.8047])
    ).matrix(),
    "complex_urban": TILTED,
}


def _packed(name: str, timed: bool) -> Any:
    """The writer of a layout that is packed elsewhere."""

    def write(folder: Path) -> Sample:
        sits = _SITS.get(name)
        mount = placed(0.0, 0.0, 1.2) if sits is None else placed(0.0, 0.0, -0.6) @ sits
        points, parts, poses = ride(mount)
        stamps = [TURN_S * k for k in range(COUNT)]
        times = [TURN_S * part for part in parts]
        path = LIDARS[name](folder, Turns(stamps, points, times, poses, still()))
        moved = None if name == "numbered" else poses
        if sits is not None:
            moved = [pose @ np.linalg.inv(sits) for pose in poses]
        if name == "kitti_raw":  # as old as their bearing, at the middle of the turn ahead
            times = [TURN_S * (part - (part > 0.5)) for part in parts]
            moved = [poses[k // 10] for k in range(10 * COUNT)]  # the ground truth has the rate of the IMU
        true_times = times if timed or name == "kitti_raw" else None
        cloud = CloudTruth(
            stamps,
            points,
            true_times,
            poses,
            sits,
            0.01 if name == "nclt" else 1e-3,
        )
        imu = 0 if name in ("oxford_spires", "numbered") else len(still())
        return Sample(path, cloud=cloud, moved=moved, imu=imu, wheels=COUNT if name == "nclt" else 0)

    return write


for _name, (_title, _source, _timed) in _PACKED.items():
    layout(_title, "3D lidar folders", _source)(_packed(_name, _timed))


def four(points: Any) -> bytes:
    """x, y, z and a reflectance, as KITTI has them."""
    return np.column_stack([points, np.full(len(points), 0.3)]).astype("<f4").tobytes()


@layout(
    "KITTI odometry", "3D lidar folders", "cvlibs.net/datasets/kitti/eval_odometry.php, devkit readme.txt"
)
def _kitti_odometry(folder: Path) -> Sample:
    points, _, poses = ride(placed(0.0, 0.0, 1.2))
    place = folder / "dataset" / "sequences" / "00"
    camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])  # T_camera_lidar
    stamps = [0.1037 * k for k in range(COUNT)]
    for k in range(COUNT):
        put(place / "velodyne" / f"{k:06d}.bin", four(points[k]))
    put(place / "times.txt", "".join(f"{stamp:.6e}\n" for stamp in stamps))
    p0 = "7.188560000000e+02 0 6.071928000000e+02 0 0 7.188560000000e+02 1.852157000000e+02 0 0 0 1 0"
    put(place / "calib.txt", f"P0: {p0}\nP1: {p0}\nP2: {p0}\nP3: {p0}\nTr: {numbers(camera[:3])}\n")
    first = np.linalg.inv(poses[0] @ np.linalg.inv(camera))
    truth = [first @ pose @ np.linalg.inv(camera) for pose in poses]
    put(folder / "dataset" / "poses" / "00.txt", "".join(numbers(one[:3]) + "\n" for one in truth))
    return Sample(place, cloud=CloudTruth(stamps, points, None, poses), moved=poses)


@layout("KITTI odometry, velodyne/ alone", "3D lidar folders", "cvlibs.net/datasets/kitti/eval_odometry.php")
def _kitti_velodyne(folder: Path) -> Sample:
    """The folder of the clouds is given, not the sequence: its stamps lie above it."""
    sample = _kitti_odometry(folder)
    return Sample(sample.path / "velodyne", cloud=sample.cloud)


@layout("KITTI-360", "3D lidar folders", "cvlibs.net/datasets/kitti-360/documentation.php")
def _kitti_360(folder: Path) -> Sample:
    points, parts, poses = ride(placed(0.0, 0.0, 1.2))
    place = folder / "KITTI-360" / "data_3d_raw" / "2013_05_28_drive_0000_sync"
    stamps = [TURN_S * k for k in range(COUNT)]
    lines = ""
    for k in range(COUNT):
        put(place / "velodyne_points" / "data" / f"{k:010d}.bin", four(points[k]))
        lines += f"2013-05-28 08:46:{3 + stamps[k]:012.9f}\n"
    put(place / "velodyne_points" / "timestamps.txt", lines)
    times = [TURN_S * (part - (part > 0.5)) for part in parts]
    return Sample(place, cloud=CloudTruth(stamps, points, times, poses))


@layout(
    "nuScenes, sweeps of one scene",
    "3D lidar folders",
    "nuscenes.org/nuscenes#data-format; nuscenes-devkit data_classes.py",
)
def _nuscenes(folder: Path) -> Sample:
    """Five floats a point; the stamp, in microseconds, ends the name."""
    points, _, poses = ride(placed(0.0, 0.0, 1.2))
    place = folder / "sweeps" / "LIDAR_TOP"
    stamps = [0.05 * k for k in range(COUNT)]
    for k in range(COUNT):
        name = (
            f"n015-2018-07-24-11-22-45+0800__LIDAR_TOP__{1532402927647951 + round(1e6 * stamps[k])}.pcd.bin"
        )
        ring = np.tile(np.arange(16), len(points[k]) // 16)
        put(place / name, np.column_stack([points[k], np.full(len(ring), 7.0), ring]).astype("<f4").tobytes())
    return Sample(place, cloud=CloudTruth(stamps, points, None, poses))


def pcd(points: Any, fields: dict[str, Any] | None = None) -> bytes:
    """A binary PCD, as PCL writes it."""
    columns = {axis: points[:, k].astype("<f4") for k, axis in enumerate("xyz")} | (fields or {})
    table = np.zeros(len(points), [(name, one.dtype) for name, one in columns.items()])
    for name, one in columns.items():
        table[name] = one
    kinds = [table.dtype[name] for name in columns]
    letters = " ".join({"f": "F", "u": "U", "i": "I"}[kind.kind] for kind in kinds)
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {' '.join(columns)}\nSIZE {' '.join(str(kind.itemsize) for kind in kinds)}\nTYPE {letters}\n"
        f"COUNT {' '.join('1' for _ in columns)}\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    return head.encode() + table.tobytes()


@layout("Snail-Radar folders, Hesai XT32", "3D lidar folders", "snail-radar.github.io/docs/format.html")
def _snail_radar(folder: Path) -> Sample:
    points, parts, poses = ride(placed(0.0, 0.0, 1.2))
    place = folder / "20231007" / "data1"
    stamps = [TURN_S * k for k in range(COUNT)]
    for k in range(COUNT):
        at = 1696656000.25 + stamps[k]
        put(place / "xt32" / f"{at:.9f}.pcd", pcd(points[k], {"timestamp": at + TURN_S * parts[k]}))
    put(
        place / "utm50r_T_x36dbody.txt",
        "".join(
            tum_line(f"{1696656000.25 + stamp:.9f}", pose) for stamp, pose in zip(stamps, poses, strict=True)
        ),
    )
    return Sample(place / "xt32", cloud=CloudTruth(stamps, points, [TURN_S * part for part in parts], poses))


@layout(
    "PCD named by stamps", "3D lidar folders", "pcl pcd_file_format; names as pcl_ros bag_to_pcd writes them"
)
def _bag_to_pcd(folder: Path) -> Sample:
    points, _, poses = ride(placed(0.0, 0.0, 1.2))
    stamps = [TURN_S * k for k in range(COUNT)]
    for k in range(COUNT):
        put(
            folder / "frames" / f"{1700000000 + stamps[k]:.9f}.pcd",
            pcd(points[k], {"intensity": np.ones(len(points[k]), "<f4")}),
        )
    return Sample(folder / "frames", cloud=CloudTruth(stamps, points, None, poses))


@layout("SemanticKITTI sequence", "3D lidar folders", "semantic-kitti.org/dataset.html#format")
def _semantic_kitti(folder: Path) -> Sample:
    """KITTI's clouds, labels beside them, and poses of its own in the same folder."""
    sample = _kitti_odometry(folder)
    for k in range(COUNT):
        put(sample.path / "labels" / f"{k:06d}.label", bytes(4 * len(sample.cloud.points[k])))
    shutil.copyfile(folder / "dataset" / "poses" / "00.txt", sample.path / "poses.txt")
    shutil.rmtree(folder / "dataset" / "poses")
    return sample


@layout("LAS clouds", "3D lidar folders", "asprs.org LAS 1.4; names by a clock")
def _las_folder(folder: Path) -> Sample:
    import laspy

    points, _, poses = ride(placed(0.0, 0.0, 1.2))
    stamps = [TURN_S * k for k in range(COUNT)]
    for k in range(COUNT):
        cloud = laspy.create(point_format=3, file_version="1.2")
        cloud.header.scales = np.full(3, 1e-4)
        cloud.x, cloud.y, cloud.z = points[k].T.astype(np.float64)
        (folder / "las").mkdir(exist_ok=True)
        cloud.write(folder / "las" / f"{1700000000 + stamps[k]:.6f}.las")
    return Sample(folder / "las", cloud=CloudTruth(stamps, points, None, poses))


@layout("a single cloud, .ply", "3D lidar folders", "paulbourke.net/dataformats/ply")
def _lone_cloud(folder: Path) -> Sample:
    points = ride(placed(0.0, 0.0, 1.2), 1)[0][0]
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
        + "".join(f"property float {axis}\n" for axis in "xyz")
        + "end_header\n"
    )
    return Sample(put(folder / "scan.ply", head + rows(points)), refused=r"(?i)cloud")
