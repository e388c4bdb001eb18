"""Point clouds from files: KITTI's ``.bin``, PCD, PLY, LAS, text and NumPy's arrays.

LAS and LAZ are read with laspy and lazrs (the extra 'las'); ASPRS 2019, "LAS Specification 1.4 - R15".
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from slam.datasets.budget import LARGEST_BYTES
from slam.datasets.dataset import RecordFault
from slam.datasets.laser_geometry import ALIKE
from slam.datasets.pcd_points import read_pcd_points
from slam.datasets.plain_points import read_npy_points, read_text_points
from slam.datasets.ply_points import read_ply_points
from slam.measurements import Float32Array

CLOUD_SUFFIXES = frozenset({".bin", ".pcd", ".ply", ".las", ".laz", ".xyz"})
PLAIN_SUFFIXES = frozenset({".npy", ".txt", ".csv"})  # of clouds, if what is in them looks like points
CLOUD_NAMES = "(?:bin|pcd|ply|la[sz]|xyz|npy|txt|csv)"  # as a pattern
# Of so many points; ranges that differ by less than single precision leaves of them are one.
_LOOKED_AT, _ALIKE_SHARE = 2000, 1e-6
# Values of lidars are between these, also rounded heights of a plane; other data mostly are not.
_LEAST, _GREATEST = 1e-30, 1e9
# Ouster OS1-64 whose clouds keep the order of points but not their times: 1024 x 64 per revolution.
_ROWS, _COLUMNS, _TURN_S = 64, 1024, 0.1
_TIMES = ("t", "time", "timestamp")

MISSING = "cloud file missing"
UNREADABLE = "cloud file cannot be read"
DAMAGED = "cloud file truncated or damaged"
NO_POINTS = "cloud without a valid point"

NO_LASPY = "clouds in LAS or LAZ; to read them: pip install 'scanweave[las]'"


@dataclass(frozen=True, slots=True)
class CloudFile:
    """The contents of a file.

    Attributes
    ----------
    points_lidar
        (N, 3) finite points.
    fields
        Further values of the points by name, (N,) each.
    """

    points_lidar: Float32Array
    fields: dict[str, NDArray[Any]]


Parsed: TypeAlias = tuple[NDArray[Any], dict[str, NDArray[Any]]]


def read_cloud(path: Path, parse: Callable[[Path], Parsed] | None = None) -> CloudFile:
    """The valid points of a file.

    Points at the origin are omitted, because lidars write them for no return.

    Parameters
    ----------
    parse
        Reads a file as (N, 3) points and further values, (N,) each; None: chosen by the suffix.

    Raises
    ------
    RecordFault
        Missing, unreadable, damaged, or without a valid point.
    """
    try:
        size = path.stat().st_size
    except FileNotFoundError as error:
        raise RecordFault(MISSING, str(path)) from error
    except (OSError, ValueError) as error:
        raise RecordFault(UNREADABLE, f"{path.name}: {error}") from error
    if not 0 < size <= LARGEST_BYTES:
        raise RecordFault(DAMAGED, f"{path.name}: {size} bytes")
    if parse is None:
        parse = KITTI_ROWS if path.suffix.lower() == ".bin" else read_fields
    points, fields = parse(path)
    with np.errstate(invalid="ignore", over="ignore"):
        points = points.astype(np.float32)
    valid = is_return(points)
    if not valid.any():
        raise RecordFault(NO_POINTS, f"{path.name}: {len(points)} points")
    if valid.all():
        return CloudFile(np.ascontiguousarray(points), fields)
    kept = {name: values[valid] for name, values in fields.items()}
    return CloudFile(np.ascontiguousarray(points[valid]), kept)


def is_return(points: Float32Array) -> NDArray[np.bool_]:
    """Which of (N, 3) points are finite, and not where drivers put beams without return.

    That is at the lidar itself, or on a sphere around it. Data that are no cloud contain none.
    """
    if are_no_readings(points[:: len(points) // _LOOKED_AT + 1]):
        return np.zeros(len(points), np.bool_)
    x, y, z = points.T
    # Axis by axis, because a reduction over rows of three takes ten times as long.
    valid = np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & ((x != 0.0) | (y != 0.0) | (z != 0.0))
    if code_m := _repeated_m(points, valid):
        with np.errstate(over="ignore"):
            valid &= np.abs(np.sqrt(x**2 + y**2 + z**2) - code_m) > _ALIKE_SHARE * code_m
    return valid


def are_no_readings(values: NDArray[Any]) -> bool:
    """Whether many values have magnitudes that no lidar returns; zeros and NaN are not counted."""
    sizes = np.abs(values[np.isfinite(values) & (values != 0.0)])
    return bool(np.count_nonzero((sizes < _LEAST) | (sizes > _GREATEST)) * FEWEST > len(sizes))


def _repeated_m(points: Float32Array, valid: NDArray[np.bool_]) -> float:
    """The range shared by more of (N, 3) points than a surface could cause; 0 if there is none."""
    step = len(points) // _LOOKED_AT | 1  # odd, so that no ring is skipped
    ranges_m = np.sort(np.linalg.norm(points[::step][valid[::step]].astype(np.float64), axis=1))
    ends = np.flatnonzero(np.diff(ranges_m, append=np.inf) > _ALIKE_SHARE * ranges_m)
    counts = np.diff(ends, prepend=-1)
    if len(counts) < FEWEST or counts.max() < FEWEST or counts.max() <= ALIKE * np.partition(counts, -2)[-2]:
        return 0.0
    return float(ranges_m[ends[counts.argmax()]])


@dataclass(frozen=True, slots=True)
class Rows:
    """A file that contains only points, rows of the same fields; ``x``, ``y`` and ``z`` are among them."""

    row: np.dtype[np.void]

    def __call__(self, path: Path) -> Parsed:
        """Points and further fields, as `read_cloud` needs them."""
        rows = self.rows(path)
        others = {name: rows[name] for name in rows.dtype.names or () if name not in "xyz"}
        return np.column_stack([rows[axis] for axis in "xyz"]), others

    def __str__(self) -> str:
        return f"{len(self.row.names or ())} numbers of {self.row[0].itemsize} bytes"

    def rows(self, path: Path) -> NDArray[np.void]:
        """The rows; RecordFault if the file does not consist of complete rows."""
        try:
            content = path.read_bytes()
        except OSError as error:
            raise RecordFault(UNREADABLE, f"{path.name}: {error}") from error
        if len(content) % self.row.itemsize:
            detail = f"{path.name}: {len(content)} bytes are no rows of {self.row.itemsize}"
            raise RecordFault(DAMAGED, detail)
        return np.frombuffer(content, self.row)


def row_of(fields: str) -> np.dtype[np.void]:
    """The type of rows from names and types: ``"x f4, y f4"``, little-endian without padding."""
    return np.dtype([(name, f"<{kind}") for name, kind in (field.split() for field in fields.split(","))])


KITTI_ROWS = Rows(row_of("x f4, y f4, z f4, intensity f4"))


_READERS = {".pcd": read_pcd_points, ".ply": read_ply_points, ".npy": read_npy_points}
_READERS |= dict.fromkeys((".xyz", ".txt", ".csv"), read_text_points)


def read_fields(path: Path) -> Parsed:
    """Points, and their further fields in the file."""
    read = _READERS.get(path.suffix.lower(), read_las_points)
    try:
        columns = read(path)
        points = np.column_stack([columns.pop(axis) for axis in "xyz"])
    except OSError as error:
        raise RecordFault(UNREADABLE, f"{path.name}: {error}") from error
    except KeyError as error:
        raise RecordFault(DAMAGED, f"{path.name}: no {error} of the points") from error
    except ValueError as error:
        raise RecordFault(DAMAGED, f"{path.name}: {error}") from error
    if points.shape[1:] != (3,):
        raise RecordFault(DAMAGED, f"{path.name}: points of shape {points.shape}")
    return points, {name: values for name, values in columns.items() if values.ndim == 1}


def with_column_times(parse: Callable[[Path], Parsed]) -> Callable[[Path], Parsed]:
    """A parser that adds column times to the points of a full revolution; other clouds get none."""

    def parsed(path: Path) -> Parsed:
        points, fields = parse(path)
        if len(points) == _ROWS * _COLUMNS and not any(name in fields for name in _TIMES):
            fields["t"] = np.arange(_ROWS * _COLUMNS) // _ROWS * (_TURN_S / _COLUMNS)
        return points, fields

    return parsed


def read_las_points(path: Path) -> dict[str, NDArray[Any]]:
    """Columns x, y and z in metres, scaled and shifted, and times and intensities if there are any.

    Raises
    ------
    OSError, ValueError
        The file or its contents cannot be read.
    """
    try:
        import laspy
    except ImportError as error:
        raise ValueError(NO_LASPY) from error
    try:
        # lazrs' own threads do not survive a fork; the child would wait for them forever.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as file:
            size = file.header.point_count * file.header.point_format.size
            if not 0 < size <= LARGEST_BYTES:
                raise ValueError(f"{file.header.point_count} points")
            if file.header.are_points_compressed:
                _ask_for_chunks(path, file.header.offset_to_point_data, file.header.point_count)
            rows = file.read()
            if len(rows.points) != file.header.point_count:
                raise ValueError(f"{len(rows.points)} of {file.header.point_count} points")
        with np.errstate(invalid="ignore", over="ignore"):
            columns = {axis: np.asarray(getattr(rows, axis), dtype=np.float64) for axis in "xyz"}
        if "gps_time" in rows.point_format.dimension_names:
            columns["timestamp"] = np.asarray(rows.gps_time)
        columns["intensity"] = np.asarray(rows.intensity)
    except laspy.errors.LaspyException as error:
        raise ValueError(str(error)) from error
    except (struct.error, TypeError, OverflowError, EOFError, RuntimeError, MemoryError) as error:
        raise ValueError(f"damaged: {error}") from error
    return columns


def _ask_for_chunks(path: Path, begins: int, points: int) -> None:
    """Reject a table of more chunks than points: lazrs allocates as many as it says (Isenburg 2013)."""
    with path.open("rb") as file:
        file.seek(begins)
        (table,) = struct.unpack("<q", file.read(8))
        if table == -1:  # written as a stream: the offset of the table is at the end
            file.seek(-8, os.SEEK_END)
            (table,) = struct.unpack("<q", file.read(8))
        file.seek(table)
        _, chunks = struct.unpack("<2I", file.read(8))
    if chunks > points:
        raise ValueError(f"{chunks} chunks of {points} points")
