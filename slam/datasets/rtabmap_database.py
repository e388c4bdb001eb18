"""Databases of RTAB-Map (``rtabmap.db``, SQLite): images, depth, scans, lenses, odometry.

The tables are those of RTAB-Map's driver (DBDriverSqlite3) since version 0.10 of 2015.
"""

from __future__ import annotations

import math
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.bags.run_length_depth import unpacked
from slam.datasets.budget import LARGEST_BYTES, MOST_BEAMS, Budget
from slam.datasets.calibration import Calibration, read_calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import STAMP_LIMIT_S, RecordFault
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.frame_pairs import FramePair
from slam.datasets.image_files import DAMAGED, MISSING, color_of, depth_of, metres_of
from slam.datasets.lens_files import median_lens
from slam.datasets.pose_files import trajectory_of
from slam.datasets.recording import Contents, Numbered, Recording
from slam.datasets.rtabmap_models import ScanInfo, camera_models, floats_of, pose_of, scan_info, scan_points
from slam.datasets.sqlite_reading import SQLITE_MAGIC, foreign_database, tables_of
from slam.datasets.stamped_files import StampedFile
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.measurements import ColorImage, Float32Array, LaserScan, PointCloud, WheelOdometry, planar

_RUNS = b"DEPTHRVL"
_LEVEL_RAD, _LEVEL_M = 1e-3, 1e-3  # planar poses are exact to the last digit of their floats
OWN_ODOMETRY = "RTAB-Map's own odometry in 3D is not used: the cameras are tracked anew"
BAD_NODE = "node without a stamp or a pose"


@dataclass(frozen=True, slots=True)
class _Node:
    """A node of the map: the data that the robot stored at one time."""

    number: int
    stamp_s: float
    T_odom_base: gtsam.Pose3 | None
    T_world_base: gtsam.Pose3 | None


class _Database:
    """The file, used alternately by two threads; see `slam.datasets.image_files.ImageSource`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._open = foreign_database(path, views=False, any_thread=True)

    def rows(self, query: str, *values: Any) -> list[tuple[Any, ...]]:
        """Return all rows of a query; DatasetError if the file is damaged or has no such table."""
        try:
            with self._lock:
                return self._open.execute(query, values).fetchall()
        except (sqlite3.Error, UnicodeDecodeError, MemoryError) as error:
            raise DatasetError(
                f"{self.path} cannot be read as RTAB-Map's ({error}); open it once with a new rtabmap, "
                "or repair it with rtabmap-recovery"
            ) from error

    def blob(self, column: str, number: int, budget: Budget | None = None) -> bytes:
        """The data of a node in a column; RecordFault if there are none."""
        try:
            rows = self.rows(f"SELECT {column} FROM Data WHERE id = ?", number)  # fixed column names
        except DatasetError as error:
            raise RecordFault(DAMAGED, str(error)) from error
        content = rows[0][0] if rows else None
        if not isinstance(content, bytes) or not 4 < len(content) <= LARGEST_BYTES:
            raise RecordFault(MISSING, f"{column} of node {number}")
        if budget is not None:
            budget.add_file(self.path, self.path.stat().st_size)
        return content

    def nodes(self, account: Account) -> list[_Node]:
        """All nodes in time order."""
        truth = "ground_truth_pose" if self.has("Node", "ground_truth_pose") else "NULL"
        nodes: list[_Node] = []
        for number, stamp, pose, true in self.rows(f"SELECT id, stamp, pose, {truth} FROM Node ORDER BY id"):
            timed = isinstance(stamp, (int, float)) and 0.0 < stamp < STAMP_LIMIT_S
            if not isinstance(number, int) or not timed:
                account.refuse(RecordFault(BAD_NODE, f"stamp {str(stamp)[:24]}"), "Node", len(nodes) + 1)
                continue
            nodes.append(_Node(number, float(stamp), _pose(pose), _pose(true)))
        return sorted(nodes, key=lambda node: node.stamp_s)

    def has(self, table: str, column: str) -> bool:
        """Whether a table has a column."""
        return any(row[1] == column for row in self.rows(f"PRAGMA table_xinfo({table})"))

    def color(self, file: StampedFile, budget: Budget) -> ColorImage:
        """See `slam.datasets.image_files.ImageSource`; file names are columns of images side by side."""
        image = color_of(self.blob("image", file.number, budget), f"node {file.number}", budget)
        return np.ascontiguousarray(_part(image, file.path))

    def depth(self, file: StampedFile, calibration: Calibration, budget: Budget) -> Float32Array:
        """See `slam.datasets.image_files.ImageSource`."""
        content = self.blob("depth", file.number, budget)
        if content.startswith(_RUNS):
            depth_m = metres_of(unpacked(content[len(_RUNS) :], budget), calibration)
        else:
            depth_m = depth_of(content, f"node {file.number}", calibration, budget, float_png=True)
        return np.ascontiguousarray(_part(depth_m, file.path))


def looks_like_rtabmap_database(path: Path, head: bytes) -> bool:
    """Whether a path is a database with its tables."""
    if not head.startswith(SQLITE_MAGIC):
        return False
    try:
        with closing(foreign_database(path, immutable=True, views=False)) as database:
            return {"Node", "Link", "Word"} <= tables_of(database) or {"Node", "Data"} <= tables_of(database)
    except (sqlite3.Error, UnicodeDecodeError):
        return False


def open_rtabmap_database(path: Path, strict: bool) -> Recording:
    """Open all data of the robot; DatasetError if there are none, or of RTAB-Map before 0.10."""
    database = _Database(path)
    if not database.has("Data", "calibration"):
        raise DatasetError(
            f"{path} was written by an RTAB-Map before 0.10 of 2015; open and save it with a newer one"
        )
    if not database.rows("SELECT count(*) FROM Node")[0][0]:
        raise DatasetError(f"{path} is a database of RTAB-Map without a node; record with it first")

    def load(account: Account) -> Contents:
        opened = _Database(path)
        nodes = opened.nodes(account)
        return Contents(_cameras(opened, nodes, account), _log(opened, nodes, account))

    def truth(account: Account) -> Trajectory | None:
        nodes = _Database(path).nodes(account)
        return trajectory_of((node.stamp_s, node.T_world_base) for node in nodes if node.T_world_base)

    return Recording(path, load, truth, strict=strict, remedy="give a database with depth or scans")


def _pose(blob: Any) -> gtsam.Pose3 | None:
    """The pose of a node; None if there is none, as for lost odometry."""
    if not isinstance(blob, bytes) or len(blob) != 48:
        return None
    try:
        return pose_of(floats_of(blob))
    except ValueError:
        return None


def _part(image: Any, place: Path) -> Any:
    """The image of one of several cameras, stored side by side; ``place`` is NUMBER/COUNT."""
    number, count = int(place.parent.name), int(place.name)
    width = image.shape[1] // count
    return image[:, number * width : (number + 1) * width]


def _cameras(database: _Database, nodes: list[_Node], account: Account) -> list[Camera]:
    """The cameras of the nodes with images and depth; lenses are the median over all."""
    kept: list[tuple[_Node, Any]] = []
    with_images = "length(image) > 4 AND length(depth) > 4"
    numbers = {row[0] for row in database.rows(f"SELECT id FROM Data WHERE {with_images}")}
    for node in nodes:
        if node.number not in numbers:
            continue
        with account.refusing("Data", node.number):
            models = camera_models(database.blob("calibration", node.number))
            if kept and len(models) != len(kept[0][1]):
                raise RecordFault("another number of cameras", f"{len(models)}")
            kept.append((node, models))
    count = len(kept[0][1]) if kept else 0
    return [_camera(database, kept, index, count, account) for index in range(count)]


def _camera(
    database: _Database, kept: list[tuple[_Node, Any]], index: int, count: int, account: Account
) -> Camera:
    """One of the cameras of the nodes."""
    sensor = "camera" if count == 1 else f"camera_{index + 1}"
    lens = median_lens([models[index][0] for _, models in kept], account)
    calibration = Calibration(lens, 1000.0, T_base_camera=kept[0][1][index][1])
    calibration = read_calibration(database.path.parent, calibration)
    place = Path(str(index)) / str(count)
    images = [StampedFile(node.stamp_s, place, node.number) for node, _ in kept]
    pairs = [FramePair(image.stamp_s, image, image) for image in images]
    return Camera(sensor, pairs, calibration, source=database)


def _log(database: _Database, nodes: list[_Node], account: Account) -> Iterator[Numbered]:
    """Odometry if it is that of a robot on a floor, and scans."""
    posed = [node.T_odom_base for node in nodes if node.T_odom_base]
    sessions = database.rows("SELECT count(DISTINCT map_id) FROM Node")[0][0]
    upright = all(pose.rotation().matrix()[2, 2] > math.cos(_LEVEL_RAD) for pose in posed)
    level = upright and all(abs(pose.z()) < _LEVEL_M for pose in posed) and sessions == 1
    if posed and not level:
        account.report.ignore("odometry", OWN_ODOMETRY, len(posed))
    beside = "scan_info" if database.has("Data", "scan_info") else ""
    budget = Budget(database.path.stat().st_size)
    scanned = (
        {row[0] for row in database.rows("SELECT id FROM Data WHERE length(scan) > 12")} if beside else ()
    )
    for node in nodes:
        if level and node.T_odom_base:
            account.report.line_count += 1
            account.report.accept("odometry")
            yield node.number, WheelOdometry(node.stamp_s, planar(node.T_odom_base))
        if node.number in scanned:
            with account.refusing("Data", node.number):
                info = scan_info(database.blob("scan_info", node.number))
                reading = _scan(node.stamp_s, info, scan_points(database.blob("scan", node.number), budget))
                account.report.line_count += 1
                account.report.accept("scan")
                yield node.number, reading


def _scan(stamp_s: float, info: ScanInfo, points: Any) -> LaserScan | PointCloud:
    """Return a 2D scan by its angles, or a cloud; RecordFault if it has no angles, or no point."""
    plane = points.shape[1] == 2 if info.in_the_plane is None else info.in_the_plane
    coordinates = points[:, : 2 if plane else 3].astype(np.float32)
    sound = np.isfinite(coordinates).all(axis=1) & coordinates.any(axis=1)
    coordinates = coordinates[sound]
    if not plane:
        if coordinates.shape[1] != 3 or not len(coordinates):
            raise RecordFault("cloud without a valid point", f"{points.shape}")
        return PointCloud(stamp_s, coordinates, None, info.T_base_laser)
    beams = (
        round((info.angle_max_rad - info.angle_min_rad) / info.angle_step_rad) + 1
        if info.angle_step_rad
        else 0
    )
    if not 2 <= beams <= MOST_BEAMS:
        raise RecordFault("scan without angles", f"{beams} beams")
    turn = info.T_base_laser.rotation().matrix()
    # The angles of an upside-down lidar are reversed.
    side = 1.0 if turn[2, 2] > 0.0 else -1.0
    step_rad, first_rad = side * info.angle_step_rad, side * info.angle_min_rad
    angles = np.arctan2(side * coordinates[:, 1], coordinates[:, 0])
    from_first = np.remainder((angles - first_rad) * np.sign(step_rad) + 0.5 * abs(step_rad), 2.0 * math.pi)
    index = (from_first / abs(step_rad)).astype(np.intp)
    ranges = np.full(beams, np.nan, dtype=np.float32)  # no return, or unknown
    inside = index < beams
    ranges[index[inside]] = np.hypot(coordinates[inside, 0], coordinates[inside, 1])
    place = gtsam.Pose2(info.T_base_laser.x(), info.T_base_laser.y(), math.atan2(turn[1, 0], turn[0, 0]))
    longest = float(ranges[np.isfinite(ranges)].max(initial=0.0))
    return LaserScan(stamp_s, ranges, first_rad, step_rad, info.range_max_m or longest, place)


FORMAT = DatasetFormat("RTAB-Map database (rtabmap.db)", looks_like_rtabmap_database, open_rtabmap_database)
