"""Trajectories as TUM text: ``stamp tx ty tz qx qy qz qw``, full epoch seconds, without loss."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import MapFileError
from slam.estimates import NORM_TOLERANCE, Trajectory
from slam.storage.files import numbered_fields, parse_floats, write_lines

_STAMP_DECIMALS = 9


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
