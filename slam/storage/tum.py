"""Trajectories as TUM text: ``stamp tx ty tz qx qy qz qw``, full epoch seconds, without loss.

Beside it the covariances of the poses: per line a stamp and an upper triangle, without loss. And
trajectories in the format of the KITTI odometry benchmark: a 3 x 4 matrix per line, times in a file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import MapFileError
from slam.estimates import NORM_TOLERANCE, Trajectory
from slam.measurements import FloatArray
from slam.storage.files import numbered_fields, parse_floats, write_lines

_STAMP_DECIMALS = 9

_AXES = {3: ("x", "y", "yaw"), 6: ("x", "y", "z", "rx", "ry", "rz")}


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory in the order it has; reading it back gives the same bits.

    Stamps have at least nine decimals and no exponent; all else is the shortest text (at most 17 digits)
    that reads back as the same number.

    Raises
    ------
    MapFileError
        If the trajectory holds no pose, or the file cannot be written.

    Examples
    --------
    >>> import numpy as np, slam
    >>> from pathlib import Path
    >>> from slam.storage.tum import write_tum
    >>> write_tum(Path("way.tum"), slam.Trajectory.from_planar(np.array([10.5]), np.array([[1.0, 2.0, 0.0]])))
    >>> print(Path("way.tum").read_text().strip())
    10.500000000 1.0 2.0 0.0 0.0 0.0 0.0 1.0
    """
    if not len(trajectory):
        raise MapFileError(f"cannot write {path}: the trajectory holds no pose")
    stamps = trajectory.stamps_s.tolist()
    poses = np.hstack([trajectory.positions_m, trajectory.quaternions_xyzw]).tolist()
    write_lines(
        path,
        (
            f"{stamp_text(stamp)} {' '.join(map(repr, pose))}"
            for stamp, pose in zip(stamps, poses, strict=True)
        ),
    )


def read_tum(path: Path) -> Trajectory:
    """Read a TUM file (plain or ``.gz``) in file order; quaternions are brought to unit length.

    Raises
    ------
    MapFileError
        Naming the line, where it has not eight finite numbers or its quaternion is not of unit length
        within 0.01; or if the file holds no pose at all.

    Examples
    --------
    >>> from pathlib import Path
    >>> from slam.storage.tum import read_tum
    >>> Path("way.tum").write_text("10.5 1 2 0 0 0 0 1") > 0
    True
    >>> read_tum(Path("way.tum")).positions_m.tolist()
    [[1.0, 2.0, 0.0]]
    """
    rows: list[list[float]] = []
    for number, fields in numbered_fields(path):
        where = f"{path}:{number}"
        if len(fields) != 8:
            raise MapFileError(f"{where}: {len(fields)} fields, a TUM line has 8 (t x y z qx qy qz qw)")
        row = parse_floats(fields, where)
        norm = float(np.linalg.norm(row[4:]))
        if abs(norm - 1.0) > NORM_TOLERANCE:
            raise MapFileError(f"{where}: quaternion of length {norm:.6g}, it must be 1 (order qx qy qz qw)")
        rows.append(row)
    if not rows:
        raise MapFileError(f"{path}: holds no pose")
    table = np.array(rows)
    norms = np.linalg.norm(table[:, 4:8], axis=1, keepdims=True)
    units = np.where(np.abs(norms - 1.0) > 1e-14, table[:, 4:8] / norms, table[:, 4:8])
    return Trajectory(table[:, 0].copy(), table[:, 1:4].copy(), units)


def stamp_text(stamp_s: float) -> str:
    """A stamp without exponent, exact, with nine decimals at the least.

    Examples
    --------
    >>> from slam.storage.tum import stamp_text
    >>> stamp_text(1305031102.175304)
    '1305031102.175304000'
    """
    text = repr(float(stamp_s))  # a tenth of what numpy takes
    if "e" in text:
        text = np.format_float_positional(stamp_s, unique=True)
    seconds, _, decimals = text.partition(".")
    return f"{seconds}.{decimals.ljust(_STAMP_DECIMALS, '0')}"


def write_kitti(path: Path, trajectory: Trajectory) -> list[Path]:
    """Write poses in the frame of the first one, row by row, and ``times.txt`` in seconds from the first.

    Beside ``NAME.txt`` these are ``NAME_times.txt``.

    Raises
    ------
    MapFileError
        If a file cannot be written.
    """
    poses = trajectory.poses()
    first = poses[0].inverse()
    rows = (first.compose(pose).matrix()[:3].ravel().tolist() for pose in poses)
    write_lines(path, (" ".join(f"{value:.9e}" for value in row) for row in rows))
    # Beside another name, there may be the times of a data set.
    times = path.with_name("times.txt" if path.name == "poses.txt" else f"{path.stem}_times.txt")
    begun_s = trajectory.stamps_s[0]
    write_lines(times, (f"{stamp_s - begun_s:.6e}" for stamp_s in trajectory.stamps_s.tolist()))
    return [path, times]


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
