"""Reads poses and trajectories in the forms of data sets: matrices, tables with any columns, blocks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import pose_from, pose_from_matrix
from slam.datasets.dataset import STAMP_LIMIT_S, RecordFault
from slam.datasets.log_file import MAX_LINE_BYTES, numbered_lines
from slam.datasets.stamped_files import BAD_POSE, BAD_STAMP, PARTED, UNITS_S, fields_of
from slam.estimates import Trajectory
from slam.measurements import FloatArray, row_from_pose

# ARKit's camera has x right, y up and looks along -z; an optical frame has y down and z forward.
T_ARKIT_OPTICAL = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
COMPARED = "the phone's own tracking is used only for comparison"
BAD_MATRIX = "pose without a 4 x 4 rigid transform"


@dataclass(frozen=True, slots=True)
class PoseTable:
    """The columns of a table, separated by commas, semicolons or blanks.

    Attributes
    ----------
    stamp_units_s
        Units of the first columns, whose sum is the stamp: (1.0, 1e-9) for seconds and nanoseconds. A single
        zero if the size of the number shows its unit, none without stamps.
    position, rotation
        Columns of x and of the first number of the rotation.
    order
        Format of the rotation: ``xyzw`` and ``wxyz`` for quaternions, ``rpy`` for roll, pitch and yaw in
        radians, ``xyz`` for a rotation vector.
    """

    stamp_units_s: tuple[float, ...] = (1.0,)
    position: int = 1
    rotation: int = 4
    order: str = "xyzw"

    def rows(self, path: Path, account: Account) -> Iterator[tuple[int, float, gtsam.Pose3]]:
        """Line number, stamp and pose of each line; invalid lines except a header are counted."""
        least = max(self.position + 3, self.rotation + len(self.order))
        for number, fields in fields_of(path, account, least):
            try:
                numbers = np.array([float(field) for field in fields[:least]])
                yield number, self._stamp(numbers), self._pose(numbers)
            except (ValueError, OverflowError) as error:
                if number > 1:
                    account.refuse(RecordFault(BAD_POSE, str(error)), path.name, number)

    def _stamp(self, numbers: FloatArray) -> float:
        """Stamp in seconds."""
        units_s = self.stamp_units_s
        if not np.isfinite(numbers[: len(units_s)]).all():
            raise ValueError("stamp not finite")
        if units_s == (0.0,):
            return by_its_size(float(numbers[0]))
        return float(numbers[: len(units_s)] @ np.array(units_s))

    def _pose(self, numbers: FloatArray) -> gtsam.Pose3:
        """The pose of a line."""
        position = numbers[self.position : self.position + 3]
        turn = numbers[self.rotation : self.rotation + len(self.order)]
        if len(self.order) == 4:
            return pose_from(position, turn if self.order == "xyzw" else turn[[1, 2, 3, 0]])
        if not np.isfinite(numbers).all():
            raise ValueError("not finite")
        by_angles = self.order == "rpy"
        return gtsam.Pose3(gtsam.Rot3.Ypr(*turn[::-1]) if by_angles else gtsam.Rot3.Expmap(turn), position)

    def read(self, path: Path, account: Account) -> Trajectory | None:
        """The trajectory in a file, None if it contains no pose."""
        return trajectory_of((stamp_s, pose) for _, stamp_s, pose in self.rows(path, account))


def by_its_size(number: float) -> float:
    """Return seconds of a stamp since 1970 in s, ms, us or ns; ValueError if no clock shows it."""
    for unit_s in UNITS_S.values():
        if abs(number) * unit_s < STAMP_LIMIT_S:
            return number * unit_s
    raise ValueError(f"{BAD_STAMP}: {number}")


def trajectory_of(stamped: Iterable[tuple[float, gtsam.Pose3]]) -> Trajectory | None:
    """Poses as a trajectory; None if there are none."""
    stamps, rows = [], []
    for stamp_s, pose in stamped:
        stamps.append(stamp_s)
        rows.append(row_from_pose(pose))
    if not rows:
        return None
    table = np.array(rows)
    return Trajectory(np.array(stamps), table[:, :3].copy(), table[:, 3:].copy())


def numbers_of(path: Path) -> FloatArray | None:
    """The finite numbers of a small text file without comments, None if it contains anything else."""
    try:
        if path.stat().st_size > MAX_LINE_BYTES:
            return None
        text = b" ".join(line for line in path.read_bytes().splitlines() if not line.startswith(b"#"))
        numbers = np.array([float(field) for field in PARTED.split(text) if field])
    except (OSError, ValueError):
        return None
    return numbers if np.isfinite(numbers).all() else None


def square_matrix(path: Path, size: int) -> FloatArray | None:
    """Square matrix of finite numbers in a text file, None if it contains anything else."""
    numbers = numbers_of(path)
    return None if numbers is None or numbers.size != size * size else numbers.reshape(size, size)


def pose_file(path: Path) -> gtsam.Pose3:
    """Return the 4 x 4 transform in a text file with the nearest rotation; RecordFault if there is none."""
    matrix = square_matrix(path, 4)
    if matrix is None:
        raise RecordFault(BAD_MATRIX, path.name)
    try:
        return pose_from_matrix(matrix)
    except ValueError as error:
        raise RecordFault(BAD_MATRIX, f"{path.name}: {error}") from error


def pose_lines(path: Path, account: Account) -> list[gtsam.Pose3 | None]:
    """One pose per line from the rows of its matrix, 12 or 16 numbers; None if the line has none."""
    poses: list[gtsam.Pose3 | None] = []
    for number, fields in fields_of(path, account, 1):
        try:
            poses.append(pose_of_row(fields))
        except ValueError as error:
            account.refuse(RecordFault(BAD_MATRIX, str(error)), path.name, number)
            poses.append(None)
    return poses


def pose_of_row(fields: list[bytes]) -> gtsam.Pose3:
    """A pose from the rows of its matrix; ValueError if it is none."""
    numbers: FloatArray = np.array([float(field) for field in fields])
    if numbers.size not in (12, 16):
        raise ValueError(f"{numbers.size} numbers")
    return pose_from_matrix(np.vstack([numbers[:12].reshape(3, 4), [0.0, 0.0, 0.0, 1.0]]))


def rotation_and_shift(file: Path, account: Account) -> gtsam.Pose3 | None:
    """The transform in a line ``R:`` of nine numbers and a line ``T:`` of three; invalid ones are counted."""
    rows: dict[bytes, list[bytes]] = {}
    for _, line in numbered_lines(file, account):
        name, _, numbers = line.partition(b":")
        rows[name.strip()] = numbers.split()
    turn, shift = rows.get(b"R", []), rows.get(b"T", [])
    with account.refusing(file.name, 1, BAD_MATRIX, ValueError):
        if len(turn) != 9 or len(shift) != 3:
            raise ValueError(f"{len(turn)} and {len(shift)} numbers")
        return pose_of_row([*turn[:3], shift[0], *turn[3:6], shift[1], *turn[6:], shift[2]])
    return None


def pose_blocks(path: Path, account: Account) -> dict[int, gtsam.Pose3]:
    """Poses by number from a ``.log`` of Redwood and Open3D: a line of three numbers, four of a matrix."""
    lines = list(fields_of(path, account, 3))
    poses = {}
    for start in range(0, len(lines) - 4, 5):
        number, head = lines[start]
        with account.refusing(path.name, number, BAD_MATRIX, ValueError, OverflowError):
            index = int(float(head[0]))
            poses[index] = pose_of_row([field for _, row in lines[start + 1 : start + 5] for field in row])
    return poses
