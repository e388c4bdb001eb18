"""Writes the ground truth of a drive: trajectory, faults, grids, obstacles, extrinsics, clocks."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from pathlib import Path
from typing import Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.config.tags import FILE_NAME as TAGS_FILE
from slam.measurements import FloatArray, row_from_pose2
from slam.simulation.drive import Drive
from slam.simulation.drive_faults import LIDAR, LIDAR_3D
from slam.simulation.events import CloudEvent, DriveEvent, ImageEvent, ScanEvent, TruthEvent
from slam.simulation.home_model import Home, Thing
from slam.simulation.ordered_pool import OrderedPool
from slam.simulation.true_grid import true_grid
from slam.simulation.tum_writer import transform_fields, write_yaml
from slam.simulation.wall_tags import known_places

_SensorEvent: TypeAlias = ScanEvent | CloudEvent | ImageEvent
_Row: TypeAlias = tuple[float, float, FloatArray, dict[str, NDArray[Any]]]  # stamp, true stamp, pose, masks

GRID_RESOLUTION_M = 0.05

_CHUNK_BYTES = 4 << 20  # uncompressed; a minute of scans, a few seconds of images
_PACKING = 1  # zlib level: masks are nearly empty, so higher levels gain little


class TruthWriter:
    """Writes the ground truth of one drive; use it as a context manager.

    Parameters
    ----------
    folder
        Receives ``groundtruth.txt`` (TUM, the base in the map frame) and ``truth/``.
    bands_m
        Names and (low, high) of the height bands of ground truth grids.
    pool
        Compresses the masks.
    """

    def __init__(
        self, folder: Path, drive: Drive, bands_m: dict[str, tuple[float, float]], pool: OrderedPool
    ) -> None:
        self._folder = folder / "truth"
        self._folder.mkdir()
        self._groundtruth = (folder / "groundtruth.txt").open("w", encoding="ascii", newline="\n")
        self._groundtruth.write("# timestamp tx ty tz qx qy qz qw, base in map\n")
        self._drive, self._bands_m = drive, bands_m
        self._sensors = {
            name: _Chunks(self._folder / name, pool, ragged=name == LIDAR_3D) for name in drive.schedules
        }

    def __enter__(self) -> TruthWriter:
        _write_obstacles(self._folder, self._drive.home, self._bands_m)
        _write_faults(self._folder, self._drive)
        write_yaml(self._folder / "extrinsics.yaml", _extrinsics(self._drive))
        if self._drive.home.tags:
            write_yaml(self._folder.parent / TAGS_FILE, known_places(self._drive.home.tags).plain())
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._groundtruth.close()
        if kind is None:
            for chunks in self._sensors.values():
                chunks.flush()

    def write(self, event: DriveEvent) -> None:
        """Write the ground truth of one event: pose of the robot, fault of each beam or depth pixel."""
        if isinstance(event, TruthEvent):
            self._groundtruth.write(f"{event.true_stamp_s:.9f} {_tum_pose(event.T_map_base)}\n")
        elif isinstance(event, ScanEvent):
            arrays: dict[str, NDArray[Any]] = {"fault": event.fault, "true_ranges_m": event.true_ranges_m}
            self._sensors[event.scan.sensor].append(event.scan.stamp_s, event, arrays)
        elif isinstance(event, CloudEvent):
            arrays = {"fault": event.fault, "true_ranges_m": event.true_ranges_m}
            self._sensors[event.sensor].append(event.stamp_s, event, arrays)
        elif isinstance(event, ImageEvent):
            # The true depth would be as large as the images themselves; the mask is sufficient.
            self._sensors[event.frame.sensor].append(event.frame.stamp_s, event, {"fault": event.fault})


class _Chunks:
    """Collects readings of one sensor until there are enough for a file."""

    def __init__(self, folder: Path, pool: OrderedPool, *, ragged: bool) -> None:
        folder.mkdir()
        self._folder, self._pool, self._ragged = folder, pool, ragged
        self._rows: list[_Row] = []
        self._bytes = 0
        self._count = 0

    def append(self, stamp_s: float, event: _SensorEvent, arrays: dict[str, NDArray[Any]]) -> None:
        """Add a reading; ``arrays`` have a value for each beam, return or pixel."""
        self._rows.append((stamp_s, event.true_stamp_s, row_from_pose2(event.T_map_base), arrays))
        self._bytes += sum(array.nbytes for array in arrays.values())
        if self._bytes >= _CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Submit the collected readings to the pool; files are named after their first reading."""
        if self._rows:
            self._pool.submit(_write_rows, self._folder / f"{self._count:06d}.npz", self._rows, self._ragged)
            self._count += len(self._rows)
            self._rows, self._bytes = [], 0


def _write_rows(path: Path, rows: list[_Row], ragged: bool) -> None:
    """Write readings of one sensor with stacked fields; clouds, which differ in length, are concatenated."""
    stamps_s, true_stamps_s, poses, arrays = zip(*rows, strict=True)
    fields = {
        "stamp_s": np.array(stamps_s),
        "true_stamp_s": np.array(true_stamps_s),
        "T_map_base_xyt": np.array(poses),
    }
    if ragged:
        fields["lengths"] = np.array([len(next(iter(reading.values()))) for reading in arrays])
    for name in arrays[0]:
        join = np.concatenate if ragged else np.stack
        fields[name] = join([reading[name] for reading in arrays])
    write_npz(path, **fields)


def write_npz(path: Path, **arrays: NDArray[Any]) -> None:
    """Write arrays as a compressed npz for `numpy.load`, with fast compression and without any time in it."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_PACKING) as archive:
        for name, array in arrays.items():
            # With a plain name, the archive's compression and the fixed date 1980-01-01 are used.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(array, order="C"), allow_pickle=False)


def _write_obstacles(folder: Path, home: Home, bands_m: dict[str, tuple[float, float]]) -> None:
    """Write the ground truth grids, and the meaning of each obstacle id in them."""
    for name, (low_m, high_m) in bands_m.items():
        grid = true_grid(home, low_m, high_m, GRID_RESOLUTION_M)
        write_npz(
            folder / f"grid_{name}.npz",
            occupied=grid.occupied,
            obstacle_id=grid.obstacle_id,
            resolution_m=np.array(grid.resolution_m),
            origin_xy=np.array(grid.origin_xy, dtype=np.float64),
            band_m=np.array([low_m, high_m]),
        )
    obstacles = [
        {"id": int(thing.id), "kind": thing.kind, "box_m": np.asarray(thing.box, dtype=float).tolist()}
        for thing in home.obstacles
    ]
    rooms = [
        {"name": room.name, "rectangle_m": [float(edge) for edge in room.rectangle]} for room in home.rooms
    ]
    _write_json(folder / "obstacles.json", {"obstacles": obstacles, "rooms": rooms})
    if home.changes:
        changes = [{"before": _plain(one.before), "after": _plain(one.after)} for one in home.changes]
        _write_json(folder / "changes.json", {"changes": changes})


def _plain(thing: Thing | None) -> dict[str, Any] | None:
    """An object as its parts: the corners of each on the floor, and its lowest and highest z."""
    if thing is None:
        return None
    parts = [
        {"corners_m": part.corners_xy().tolist(), "z_m": [float(part.z_low_m), float(part.z_high_m)]}
        for part in thing.parts
    ]
    return {"kind": thing.kind, "parts": parts}


def _write_faults(folder: Path, drive: Drive) -> None:
    """Write the configured faults, all scheduled readings, and wheel slip."""
    offsets = {name: readings.clock_offset_s for name, readings in drive.schedules.items()}
    lost = {name: int(np.count_nonzero(~readings.kept)) for name, readings in drive.schedules.items()}
    _write_json(
        folder / "faults.json",
        {
            "seed": drive.seed,
            "rig": drive.rig.name,
            "faults": dataclasses.asdict(drive.faults),
            "clock_offset_s": offsets,
            "lost_readings": lost,
        },
    )
    for name, readings in drive.schedules.items():
        write_npz(
            folder / f"readings_{name}.npz",
            true_s=readings.true_s,
            stamps_s=readings.stamps_s,
            kept=readings.kept,
        )
    write_npz(folder / "odometry.npz", true_s=drive.odometry_s, slipping=drive.wheels.slipping)


def _extrinsics(drive: Drive) -> dict[str, Any]:
    """True poses of all sensors on the robot."""
    poses: dict[str, Any] = {}
    if drive.rig.lidar is not None:
        poses[LIDAR] = {"T_base_laser": transform_fields(drive.rig.lidar.T_base_laser)}
    if drive.rig.lidar_3d is not None:
        poses[LIDAR_3D] = {"T_base_laser": transform_fields(drive.rig.lidar_3d.T_base_laser)}
    for camera in drive.rig.cameras:
        poses[camera.name] = {"T_base_camera": transform_fields(camera.T_base_camera)}
    return poses


def _write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file in the given order."""
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8", newline="\n")


def _tum_pose(pose: gtsam.Pose2) -> str:
    """Position and quaternion of a planar pose."""
    half: float = 0.5 * pose.theta()
    values: FloatArray = np.array([pose.x(), pose.y(), 0.0, 0.0, 0.0, np.sin(half), np.cos(half)])
    return " ".join(f"{value:.17g}" for value in values)
