"""Records a simulated drive as folders of plain files, as a rosbag2, or both, in one pass."""

from __future__ import annotations

import glob
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.errors import ConfigError, DatasetError
from slam.simulation.bag_writer import BAG_FILES, BagWriter
from slam.simulation.carmen_writer import CarmenWriter
from slam.simulation.cloud_writer import CloudWriter
from slam.simulation.drive import FIRST_STAMP_S, Drive, prepare_drive
from slam.simulation.drive_faults import DriveFaults
from slam.simulation.events import CloudEvent, DriveEvent, ImageEvent, OdometryEvent, ScanEvent
from slam.simulation.home_model import Home
from slam.simulation.imu import write_euroc
from slam.simulation.ordered_pool import OrderedPool
from slam.simulation.rigs import Rig
from slam.simulation.truth_writer import TruthWriter
from slam.simulation.tum_writer import TumWriter
from slam.temporary import held, remove_left

FORMATS = ("folder", "mcap")

Progress = Callable[[float, float], None]
Sink = Callable[[DriveEvent], None]

BAG = "log"  # rosbags names the file in a bag after the bag
_FLOOR_M = 0.012  # lower thresholds are driven over, and are no obstacle in the ground truth grids
_LIDAR_BAND_M = 0.02  # about the lidar's height
_WORKERS = 2
_PENDING_IMAGES = 24  # limits the memory: about 5 MB of 320 x 240 frames
_PENDING_MESSAGES = 16


@dataclass(frozen=True, slots=True)
class DriveSummary:
    """Summary of a recording.

    Attributes
    ----------
    folder
        Folder of the recording.
    duration_s, path_m
        Length of the drive in time and space.
    counts
        Readings written, by the sensor's name; the wheels are ``odometry``.
    lost
        Readings that never arrived: dropped, or the sensor had failed.
    rooms
        Rooms visited, in order.
    lap_s
        Time when the robot was back at its start, ``inf`` if never.
    """

    folder: Path
    duration_s: float
    path_m: float
    counts: dict[str, int]
    lost: dict[str, int]
    rooms: tuple[str, ...]
    lap_s: float


def record_drive(
    home: Home,
    rig: Rig,
    seed: int,
    out_dir: Path,
    faults: DriveFaults | None = None,
    duration_s: float | None = None,
    progress: Progress | None = None,
    *,
    formats: tuple[str, ...] = FORMATS,
    compress_bag: bool = False,
) -> DriveSummary:
    """Simulate a drive and write it, with its ground truth.

    Parameters
    ----------
    out_dir
        Created atomically at the end; must not exist yet, or be empty. With ``folder``, it contains
        ``scans.log``
        (CARMEN) and the images as in the TUM benchmark (in ``rgbd_<name>/`` each when there are several
        cameras), ``points/`` of a 3D lidar and ``imu0/`` of an IMU (EuRoC); with ``mcap`` it is a rosbag2
        (``log.mcap``, ``metadata.yaml``). Always ``groundtruth.txt`` and ``truth/``.
    faults, duration_s
        As for `slam.simulation.drive.prepare_drive`.
    progress
        Called fifty times per simulated second with the seconds done and their total.
    formats
        Any of `FORMATS`.
    compress_bag
        Compress the bag with zstd: slower, and only slightly smaller, since noise is incompressible.

    Raises
    ------
    ConfigError
        An unknown format, or a drive that cannot be planned.
    DatasetError
        ``out_dir`` is not empty, or cannot be written.
    """
    unknown = sorted(set(formats) - set(FORMATS))
    if unknown or not formats:
        raise ConfigError(f"formats are {', '.join(formats) or 'none'}; give any of {', '.join(FORMATS)}")
    with appearing_whole(Path(out_dir)) as folder:
        drive = prepare_drive(home, rig, seed, faults, duration_s)
        counts: Counter[str] = Counter(odometry=0, **dict.fromkeys(drive.schedules, 0))
        if drive.imu is not None and rig.imu is not None:
            counts["imu"] = len(drive.imu.true_s)
            if "folder" in formats:
                write_euroc(folder / "imu0", drive.imu, rig.imu.T_body_imu)
        with ExitStack() as stack:
            sinks = _open_sinks(stack, folder, drive, formats, compress_bag)
            for event in drive.events():
                for sink in sinks:
                    sink(event)
                if name := _name(event):
                    counts[name] += 1
                elif progress is not None:
                    progress(event.true_stamp_s - FIRST_STAMP_S, drive.tour.duration_s)
        if "mcap" in formats:
            unfold_bag(folder)
    return _summary(Path(out_dir), drive, counts)


def _open_sinks(
    stack: ExitStack, folder: Path, drive: Drive, formats: tuple[str, ...], compress_bag: bool
) -> list[Sink]:
    """Return the sinks of each event; the stack closes them in reverse order."""
    # The pool of images is outermost: closing the ground truth still submits the last masks to it.
    images = stack.enter_context(OrderedPool(_WORKERS, _PENDING_IMAGES))
    truth = stack.enter_context(TruthWriter(folder, drive, truth_bands_m(drive.rig), images))
    sinks: list[Sink] = [truth.write]
    if "folder" in formats:
        sinks.append(_FolderSink(stack, folder, drive, images))
    if "mcap" in formats:
        # A separate thread for the bag, closed before the bag, so that messages keep their order.
        bag = stack.enter_context(BagWriter(folder / BAG, drive, FIRST_STAMP_S, compress=compress_bag))
        messages = stack.enter_context(OrderedPool(1, _PENDING_MESSAGES))
        sinks.append(lambda event: messages.submit(bag.write, event))
    return sinks


class _FolderSink:
    """Plain files: a CARMEN log of scans and odometry, a TUM folder for each camera, KITTI's clouds."""

    def __init__(self, stack: ExitStack, folder: Path, drive: Drive, images: OrderedPool) -> None:
        self._drive = drive
        self._log = stack.enter_context(CarmenWriter(folder / "scans.log", FIRST_STAMP_S))
        cameras = drive.rig.cameras
        self._cameras = {
            camera.name: stack.enter_context(
                TumWriter(
                    folder if len(cameras) == 1 else folder / camera_folder(camera.name),
                    camera.model.intrinsics,
                    camera.T_base_camera,
                    images,
                )
            )
            for camera in cameras
        }
        self._clouds = None
        if drive.rig.lidar_3d is not None:
            self._clouds = stack.enter_context(CloudWriter(folder, drive.rig.lidar_3d.T_base_laser, images))

    def __call__(self, event: DriveEvent) -> None:
        """Write one event; the trajectory belongs to the ground truth."""
        if isinstance(event, OdometryEvent):
            self._log.odometry(event.reading, event.twist, event.true_stamp_s)
        elif isinstance(event, ScanEvent):
            # At the stamp, not at the true time, because the pose in the line belongs to its stamp.
            pose = self._drive.odometry_at(event.scan.stamp_s)
            self._log.scan(event.scan, pose, event.true_stamp_s)
        elif isinstance(event, ImageEvent):
            self._cameras[event.frame.sensor].write(event.frame)
        elif isinstance(event, CloudEvent) and self._clouds is not None:
            self._clouds.write(event)


def camera_folder(camera: str) -> str:
    """Return the folder of one of several cameras: ``rgbd_1`` for "RGBD_1", ``rgbd_left`` for "left"."""
    return f"rgbd_{camera.lower().removeprefix('rgbd_')}"


def truth_bands_m(rig: Rig) -> dict[str, tuple[float, float]]:
    """Return the height bands (low, high) of the ground truth grids: of the robot and of the lidar."""
    bands = {"robot": (_FLOOR_M, rig.robot_height_m)}
    if rig.lidar is not None:
        height = float(rig.lidar.T_base_laser.z())
        bands["lidar"] = (height - _LIDAR_BAND_M, height + _LIDAR_BAND_M)
    return bands


@contextmanager
def appearing_whole(out_dir: Path) -> Iterator[Path]:
    """Yield a folder with a temporary name, renamed at the end, or removed on an error.

    What a killed run has left of it is removed.
    """
    _check_free(out_dir)
    temporary = out_dir.with_name(f".{out_dir.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        remove_left(out_dir.parent.glob(f".{glob.escape(out_dir.name)}.*.part"))
        with held(temporary, folder=True):
            yield temporary
            temporary.replace(out_dir)
    except OSError as error:
        _check_free(out_dir)  # another run may have been faster
        reason = error.strerror or str(error)
        raise DatasetError(f"cannot write {out_dir}: {reason}; check the folder and its space") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _check_free(out_dir: Path) -> None:
    """Refuse a path that exists, unless it is an empty folder."""
    with suppress(NotADirectoryError):
        if not out_dir.exists() or not any(out_dir.iterdir()):
            return
    raise DatasetError(f"{out_dir} exists and is not an empty folder; give another name or remove it")


def unfold_bag(folder: Path) -> None:
    """Move the files of the bag `BAG` in a folder up into it."""
    for name in BAG_FILES:
        (folder / BAG / name).rename(folder / name)
    (folder / BAG).rmdir()


def _name(event: DriveEvent) -> str | None:
    """Return the sensor of an event."""
    if isinstance(event, ScanEvent):
        return event.scan.sensor
    if isinstance(event, CloudEvent):
        return event.sensor
    if isinstance(event, ImageEvent):
        return event.frame.sensor
    return "odometry" if isinstance(event, OdometryEvent) else None


def _summary(out_dir: Path, drive: Drive, counts: Counter[str]) -> DriveSummary:
    """Return the summary of a finished drive."""
    steps = np.linalg.norm(np.diff(drive.tour.poses_xyt[:, :2], axis=0), axis=1)
    return DriveSummary(
        folder=out_dir,
        duration_s=drive.tour.duration_s,
        path_m=float(steps.sum()),
        counts=dict(counts),
        lost={name: int(np.count_nonzero(~due.kept)) for name, due in drive.schedules.items()},
        rooms=drive.tour.rooms,
        lap_s=drive.tour.lap_s,
    )
