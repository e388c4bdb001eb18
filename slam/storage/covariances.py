"""Pose covariances as text beside a TUM file: per line a stamp and an upper triangle, without loss."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import MapFileError
from slam.estimates import Trajectory
from slam.measurements import FloatArray
from slam.storage.files import numbered_fields, parse_floats, write_lines
from slam.storage.tum import stamp_text, write_tum

_AXES = {3: ("x", "y", "yaw"), 6: ("x", "y", "z", "rx", "ry", "rz")}


def covariance_path(trajectory: Path) -> Path:
    """Return the path of covariances: ``trajectory_covariance.csv`` beside ``trajectory.tum``."""
    return trajectory.with_name(f"{trajectory.name.removesuffix('.gz').removesuffix('.tum')}_covariance.csv")


def write_trajectory(path: Path, trajectory: Trajectory, covariances: FloatArray | None) -> list[Path]:
    """Write N poses as TUM text and, if known, (N, d, d) covariances beside it; return the files.

    Raises
    ------
    MapFileError
        As `write_tum`.
    """
    write_tum(path, trajectory)
    if covariances is None:
        return [path]
    covariance_file = covariance_path(path)
    _write_covariances(covariance_file, trajectory.stamps_s, covariances)
    return [path, covariance_file]


def _write_covariances(path: Path, stamps_s: FloatArray, covariances: FloatArray) -> None:
    """Write them under a header that names the columns."""
    axes = _AXES[covariances.shape[1]]
    pairs = [f"{axes[i]}_{axes[j]}" for i, j in zip(*np.triu_indices(len(axes)), strict=True)]
    rows = zip(stamps_s.tolist(), upper_triangles(covariances).tolist(), strict=True)
    lines = (f"{stamp_text(stamp)},{','.join(map(repr, row))}" for stamp, row in rows)
    write_lines(path, (line for part in ([",".join(["stamp", *pairs])], lines) for line in part))


def read_covariances(path: Path) -> tuple[FloatArray, FloatArray]:
    """Read (N,) stamps and (N, d, d) covariances from a file written by `write_trajectory`.

    Raises
    ------
    MapFileError
        Naming the line, if it has not as many finite numbers as the header says, or the header differs.
    """
    # No spaces: a line is one field.
    lines = [(number, fields[0].split(",")) for number, fields in numbered_fields(path)]
    sizes = {len(axes) * (len(axes) + 1) // 2 + 1 for axes in _AXES.values()}
    if len(lines) < 2 or len(lines[0][1]) not in sizes:
        raise MapFileError(f"{path}: holds no covariances; its head names stamp and 6 or 21 columns")
    width, rows = len(lines[0][1]), []
    for number, fields in lines[1:]:
        where = f"{path}:{number}"
        if len(fields) != width:
            raise MapFileError(f"{where}: {len(fields)} fields, the head has {width}")
        rows.append(parse_floats(fields, where))
    table = np.array(rows)
    return table[:, 0].copy(), of_upper_triangles(table[:, 1:])


def upper_triangles(covariances: FloatArray) -> FloatArray:
    """Return (N, d (d + 1) / 2) of (N, d, d), row by row."""
    row, column = np.triu_indices(covariances.shape[1])
    return np.ascontiguousarray(covariances[:, row, column])


def of_upper_triangles(triangles: FloatArray) -> FloatArray:
    """Return (N, d, d) from the result of `upper_triangles`."""
    size = next(size for size in _AXES if size * (size + 1) // 2 == triangles.shape[1])
    row, column = np.triu_indices(size)
    covariances = np.zeros((len(triangles), size, size))
    covariances[:, row, column] = covariances[:, column, row] = triangles
    return covariances
