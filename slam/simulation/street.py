"""Records a car's drive: a KITTI odometry folder, a bag of lidar and IMU, the ground truth."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.estimates import Trajectory
from slam.measurements import FloatArray, GnssFix
from slam.simulation import ros_messages as ros
from slam.simulation.bag_writer import BASE_FRAME, IMU_FRAME, LASER_3D_FRAME
from slam.simulation.drive import FIRST_STAMP_S
from slam.simulation.gnss import GnssFaults, record_gnss
from slam.simulation.imu import (
    ADIS_16448,
    ImuFaults,
    ImuRecord,
    MountedImu,
    record_imu,
    write_euroc,
)
from slam.simulation.record import BAG, FORMATS, Progress, appearing_whole, unfold_bag
from slam.simulation.rigs import MountedRingLidar, laser_pose
from slam.simulation.sensor_clock import generator
from slam.simulation.sensor_models import HDL_64E, VLP_16
from slam.simulation.street_drive import SIDEWARD_M_S2, drive_street
from slam.simulation.street_lidar import StreetLidar, StreetTurn
from slam.simulation.street_mesh import Label
from slam.simulation.street_plan import generate_town
from slam.simulation.street_traffic import Traffic
from slam.storage import ros_messages as messages
from slam.storage.files import write_lines
from slam.storage.tum import write_tum

if TYPE_CHECKING:
    from rosbags.interfaces import Connection


@dataclass(frozen=True, slots=True)
class StreetRig:
    """Sensors of a car: a lidar, and in its frame an IMU and the antenna of a GNSS receiver."""

    lidar: MountedRingLidar
    imu: MountedImu | None
    antenna_m: tuple[float, float, float] | None = (-0.8, 0.3, 0.1)


# Pose of KITTI's IMU relative to its lidar (calib_imu_to_velo.txt), to the centimetre; here it looks left.
_IMU = MountedImu(ADIS_16448, gtsam.Pose3(gtsam.Rot3.Yaw(0.5 * np.pi), np.array([-0.81, 0.32, -0.80])))
STREET_RIGS = {
    "car64": StreetRig(MountedRingLidar(HDL_64E, laser_pose(0.0, 0.0, 1.73)), _IMU),
    "car16": StreetRig(MountedRingLidar(VLP_16, laser_pose(0.0, 0.0, 1.73)), _IMU),
}
# KITTI's left camera: x right, y down, z forward.
_T_CAMERA_LIDAR = gtsam.Pose3(
    gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])), np.zeros(3)
)
_DURATION_S = 34.0
_TRUTH_HZ = 100.0
_ANTENNA_FRAME, _FIX = "antenna", "/gnss/fix"


@dataclass(frozen=True, slots=True)
class StreetFaults:
    """Difficulty of a street.

    Attributes
    ----------
    density
        Number of cars, cyclists and people per 100 m of street.
    lost_share
        Share of lost revolutions.
    imu, gnss
        Errors of the IMU and the GNSS receiver.
    """

    density: float = 0.0
    lost_share: float = 0.0
    imu: ImuFaults = field(default_factory=ImuFaults)
    gnss: GnssFaults = field(default_factory=GnssFaults)


# Biases of a good sensor and of a cheap one (1 degree/s and 20 mg: data sheet of the Bosch BMI085).
STREET_FAULTS = {
    "none": StreetFaults(),
    "usual": StreetFaults(3.0, 0.0, ImuFaults(0.002, 0.07, 0.002), GnssFaults(0.3, 1.0)),
    "harsh": StreetFaults(9.0, 0.05, ImuFaults(0.017, 0.2, 0.02), GnssFaults(0.5, 2.0, mirrored_share=0.2)),
}


@dataclass(frozen=True, slots=True)
class StreetSummary:
    """Summary of a recording: duration, path length, revolutions, points, and points on moving objects."""

    duration_s: float
    path_m: float
    turns: int
    points: int
    moving: int

    @property
    def text(self) -> str:
        """Return the summary as one line."""
        return (
            f"{self.duration_s:.0f} s, {self.path_m:.1f} m of streets: {self.turns} clouds, {self.points:,} "
            f"points, {self.moving:,} of them on traffic"
        )


def record_street(
    home: int,
    seed: int,
    out_dir: Path,
    rig: StreetRig,
    faults: StreetFaults,
    duration_s: float | None = None,
    progress: Progress | None = None,
    *,
    tunnel: bool = False,
    undistorted: bool = False,
    formats: tuple[str, ...] = FORMATS,
    sideward_m_s2: float = SIDEWARD_M_S2,
) -> StreetSummary:
    """Drive through the town of seed ``home`` and write the lidar data, with the ground truth.

    Parameters
    ----------
    out_dir
        Created atomically at the end; must not exist yet, or be empty. With ``folder``, it contains
        ``velodyne/`` (x, y, z, intensity), ``times.txt``, ``calib.txt`` and ``poses.txt`` of KITTI, all at
        the middle of a revolution, and ``imu0/data.csv`` of EuRoC; with ``mcap`` a rosbag2 with ``/points``,
        stamped at the start of a revolution, with ``intensity``, ``ring`` and ``t`` (ns after the stamp),
        ``/imu``, and outside of tunnels ``/gnss/fix`` (NavSatFix). Always ``groundtruth.txt`` (TUM, the
        lidar in an upright map, 100 Hz) and ``labels/`` of SemanticKITTI, one file per revolution.
    duration_s
        34 s if not given: 340 revolutions.
    progress
        Called at each revolution with the seconds done and their total.
    tunnel
        A single street through a tunnel instead of the grid.
    undistorted
        Deskewed clouds in the folder; the clouds in the bag are always raw.
    sideward_m_s2
        Lateral acceleration in corners, see `drive_street`.

    Raises
    ------
    DatasetError
        ``out_dir`` is not empty, or cannot be written.
    """
    town = generate_town(home, tunnel=tunnel)
    drive = drive_street(town, generator(seed, "street", home), sideward_m_s2)
    traffic = Traffic(town, drive, faults.density, generator(seed, "street traffic", home))
    model = rig.lidar.model
    lidar = StreetLidar(town, drive, traffic, model, rig.lidar.T_base_laser)
    end_s = min(duration_s or _DURATION_S, drive.duration_s - 1.0)
    imu = None
    if rig.imu is not None:
        imu = record_imu(rig.imu, lidar.poses_at, faults.imu, end_s, FIRST_STAMP_S, seed, home)
    fixes = list[GnssFix]()
    if rig.antenna_m is not None:
        antenna_m = np.array(rig.antenna_m)
        fixes = record_gnss(antenna_m, lidar.poses_at, faults.gnss, end_s, FIRST_STAMP_S, seed, home)
    if town.tunnel_m is not None:
        fixes = _outside(town.tunnel_m, fixes, lidar)
    rng, turn_s = generator(seed, "street lidar", home), 1.0 / model.rate_hz
    begins_s: FloatArray = np.arange(int(end_s * model.rate_hz + 1e-9), dtype=np.float64) * turn_s
    begins_s = begins_s[rng.random(len(begins_s)) >= faults.lost_share]
    points = moving = 0
    with appearing_whole(out_dir) as folder:
        with ExitStack() as stack:
            bag = _StreetBag(folder / BAG, rig, imu, fixes) if "mcap" in formats else None
            if bag is not None:
                stack.enter_context(bag)
            for name in ("labels", *(["velodyne"] if "folder" in formats else [])):
                (folder / name).mkdir()
            for number, begin_s in enumerate(begins_s.tolist()):
                turn = lidar.turn(begin_s, rng)
                turn.label.astype("<u4").tofile(folder / "labels" / f"{number:06d}.label")
                if "folder" in formats:
                    _write_bin(folder / "velodyne" / f"{number:06d}.bin", turn, undistorted=undistorted)
                if bag is not None:
                    bag.write(FIRST_STAMP_S + begin_s, turn)
                points += len(turn.label)
                moving += int(np.count_nonzero(turn.label & 0xFFFF >= Label.MOVING_CAR))
                if progress is not None:
                    progress(begin_s, end_s)
        if bag is not None:
            unfold_bag(folder)
        if "folder" in formats:
            _write_kitti(folder, lidar, begins_s + 0.5 * turn_s)
            if rig.imu is not None and imu is not None:
                write_euroc(folder / "imu0", imu, rig.imu.T_body_imu)
        times_s = np.arange(round(end_s * _TRUTH_HZ) + 1) / _TRUTH_HZ
        write_tum(folder / "groundtruth.txt", _trajectory(lidar, times_s))
    return StreetSummary(end_s, float(drive.path_m(end_s)), len(begins_s), points, moving)


def _outside(tunnel_m: tuple[float, float], fixes: list[GnssFix], lidar: StreetLidar) -> list[GnssFix]:
    """Return the fixes before and after a tunnel."""
    _, positions = lidar.poses_at(np.array([fix.stamp_s - FIRST_STAMP_S for fix in fixes]))
    entry_m, exit_m = tunnel_m
    in_sight = (positions[:, 0] < entry_m) | (positions[:, 0] > exit_m)
    return [fix for fix, visible in zip(fixes, in_sight.tolist(), strict=True) if visible]


def _write_bin(path: Path, turn: StreetTurn, *, undistorted: bool) -> None:
    """Write four floats per point."""
    points = turn.undistorted_lidar if undistorted else turn.points_lidar
    np.column_stack([points, turn.brightness]).astype("<f4").tofile(path)


def _write_kitti(folder: Path, lidar: StreetLidar, times_s: FloatArray) -> None:
    """Write stamps, calibration, and poses of the left camera in its first frame."""
    write_lines(folder / "times.txt", [f"{FIRST_STAMP_S + time_s:.6f}" for time_s in times_s])
    write_lines(folder / "calib.txt", [f"Tr: {_kitti_row(_T_CAMERA_LIDAR)}"])
    rotations, positions = lidar.poses_at(times_s)
    poses = [
        gtsam.Pose3(gtsam.Rot3(rotation), position).compose(_T_CAMERA_LIDAR.inverse())
        for rotation, position in zip(rotations, positions, strict=True)
    ]
    write_lines(folder / "poses.txt", [_kitti_row(poses[0].between(pose)) for pose in poses])


def _kitti_row(pose: gtsam.Pose3) -> str:
    """Return the first three rows of the matrix as text."""
    return " ".join(f"{value:.9e}" for value in pose.matrix()[:3].ravel())


def _trajectory(lidar: StreetLidar, times_s: FloatArray) -> Trajectory:
    """Return the trajectory of the lidar in the map."""
    from scipy.spatial.transform import Rotation

    rotations, positions = lidar.poses_at(times_s)
    stamps_s = np.round(FIRST_STAMP_S + times_s, 6)
    return Trajectory(stamps_s, positions, Rotation.from_matrix(rotations).as_quat())


class _StreetBag:
    """A rosbag2 of clouds, an IMU and GNSS; use it as a context manager."""

    def __init__(self, folder: Path, rig: StreetRig, imu: ImuRecord | None, fixes: list[GnssFix]) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        self._writer = Writer(folder, version=messages.BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        self._rig = rig
        self._felt = iter(()) if imu is None else imu.messages(FIRST_STAMP_S, IMU_FRAME)
        self._next = next(self._felt, None)
        self._fixes = fixes[::-1]
        self._connections = dict[str, "Connection"]()

    def __enter__(self) -> Self:
        self._writer.open()
        # The robot's frame is the lidar's, as in the folder and in the ground truth.
        frames = {LASER_3D_FRAME: gtsam.Pose3()}
        topics = {"/tf_static": messages.TRANSFORMS, "/points": messages.POINT_CLOUD}
        if self._rig.imu is not None:
            frames[IMU_FRAME], topics["/imu"] = self._rig.imu.T_body_imu, ros.IMU
        if self._rig.antenna_m is not None and self._fixes:
            frames[_ANTENNA_FRAME] = gtsam.Pose3(gtsam.Rot3(), np.array(self._rig.antenna_m))
            topics[_FIX] = ros.NAVSAT
        for topic, kind in topics.items():
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=messages.typestore()
            )
        self._send("/tf_static", FIRST_STAMP_S, messages.transforms(FIRST_STAMP_S, BASE_FRAME, frames))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._feel(np.inf)
        self._writer.__exit__(kind, error, trace)

    def write(self, stamp_s: float, turn: StreetTurn) -> None:
        """Write one revolution; it arrives at its end, after the IMU readings until then."""
        further: dict[str, NDArray[Any]] = {
            "intensity": turn.brightness,
            "ring": turn.ring,
            "t": np.rint(turn.after_s * 1e9).astype(np.uint32),
        }
        message = ros.point_cloud(turn.points_lidar, further, stamp_s, LASER_3D_FRAME)
        over_s = stamp_s + 1.0 / self._rig.lidar.model.rate_hz
        self._feel(over_s - FIRST_STAMP_S)
        self._send("/points", over_s, message)

    def _feel(self, until_s: float) -> None:
        """Write the readings of IMU and receiver until a time of the drive."""
        while self._fixes and self._fixes[-1].stamp_s - FIRST_STAMP_S < until_s:
            fix = self._fixes.pop()
            self._send(_FIX, fix.stamp_s, ros.navsat(fix, _ANTENNA_FRAME))
        while self._next is not None and self._next[0] < FIRST_STAMP_S + until_s:
            self._send("/imu", *self._next)
            self._next = next(self._felt, None)

    def _send(self, topic: str, at_s: float, message: object) -> None:
        """Write one message."""
        connection = self._connections[topic]
        content = messages.typestore().serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, messages.nanoseconds(at_s), content)
