"""Point clouds from files: KITTI's ``.bin``, ``.pcd`` and ``.ply``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import LARGEST_BYTES
from slam.datasets.dataset import RecordFault
from slam.datasets.pcd_points import read_pcd_points
from slam.datasets.ply_points import read_ply_points
from slam.measurements import Float32Array

CLOUD_SUFFIXES = frozenset({".bin", ".pcd", ".ply"})

MISSING = "cloud file missing"
UNREADABLE = "cloud file cannot be read"
DAMAGED = "cloud file truncated or damaged"
NO_POINTS = "cloud without a valid point"

_FLOATS_A_POINT = 4  # x, y, z and the intensity


@dataclass(frozen=True, slots=True)
class CloudFile:
    """What a file holds.

    Attributes
    ----------
    points_lidar
        (N, 3) finite points.
    fields
        Further values of the points by their names, (N,) each.
    """

    points_lidar: Float32Array
    fields: dict[str, NDArray[Any]]


def read_cloud(path: Path) -> CloudFile:
    """The valid points of a file.

    Points at the origin are what lidars write for no return, and left out.

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
    points, fields = _from_bin(path) if path.suffix.lower() == ".bin" else _from_fields(path)
    with np.errstate(invalid="ignore", over="ignore"):
        points = points.astype(np.float32)
        x, y, z = points.T
        # Axis by axis: a reduction over rows of three takes ten times as long.
        valid = np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & ((x != 0.0) | (y != 0.0) | (z != 0.0))
    if not valid.any():
        raise RecordFault(NO_POINTS, f"{path.name}: {len(points)} points")
    if valid.all():
        return CloudFile(np.ascontiguousarray(points), fields)
    kept = {name: values[valid] for name, values in fields.items()}
    return CloudFile(np.ascontiguousarray(points[valid]), kept)


def _from_bin(path: Path) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
    """Four little-endian floats a point."""
    try:
        floats = np.fromfile(path, dtype="<f4")
    except OSError as error:
        raise RecordFault(UNREADABLE, f"{path.name}: {error}") from error
    if floats.nbytes != path.stat().st_size or floats.size % _FLOATS_A_POINT:
        raise RecordFault(DAMAGED, f"{path.name}: {path.stat().st_size} bytes are no rows of four floats")
    return floats.reshape(-1, _FLOATS_A_POINT)[:, :3], {}


def _from_fields(path: Path) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
    """Points, and what else the file says of each."""
    read = read_pcd_points if path.suffix.lower() == ".pcd" else read_ply_points
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
