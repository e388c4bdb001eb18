"""Text files of IMUs next to clouds: EuRoC's ``imu0/data.csv``, others by their header or a publisher's."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.time_alignment import GAP_S
from slam.datasets.account import Account
from slam.datasets.calibration import read_mounting
from slam.datasets.dataset import RecordFault
from slam.datasets.log_file import first_file, numbered_lines
from slam.datasets.pose_files import by_its_size
from slam.datasets.recording import Numbered
from slam.measurements import GRAVITY_M_S2, FloatArray, ImuReading

BAD_ROW = "IMU line without stamp, angular rate and acceleration"

NO_RATES = "its lines hold no angular rates and accelerations"

# EuRoC and similar layouts (TUM-VI), then others; in the folder of the clouds or above.
_NAMES = ("imu0/data.csv", "imu/data.csv", "imu.csv", "imu.txt", "imu_data.csv", "ouster_imu.csv")
# EuRoC's sensor.yaml gives the IMU's pose in a frame that is not the robot's frame here.
_SIDECAR = "calibration.yaml"
# Prefixes of the columns of both sensors; each name ends with its axis.
_GYRO = re.compile(
    r"^(w|g|gyro?|gyroscope|omega|ang|angular|angular_?velocity|rotation_?rate)([_. ].*)?[_. ]?([xyz])$"
)
_FORCE = re.compile(r"^(a|acc|accel|accelerometer|lin|linear|linear_?acceleration)([_. ].*)?[_. ]?([xyz])$")
_TIMES = ("timestamp", "time", "stamp", "t")
_SECONDS = frozenset({"sec", "secs", "seconds"})
_REST = frozenset({"nsec", "nsecs", "nanosec", "nanoseconds"})
# EuRoC's order, for files without header.
_PLAIN = (0, 1, 2, 3, 4, 5, 6)
_UNITS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}


class ForceUnit:
    """Detects m/s² or g from the first reading, because gravity dominates in slow motion.

    Attributes
    ----------
    choice
        The conclusion as text; empty for m/s², the expected unit.
    """

    def __init__(self) -> None:
        self.choice = ""
        self._scale: float | None = None

    def m_s2(self, force: FloatArray) -> FloatArray:
        """Convert a specific force (3,) to m/s²."""
        if self._scale is None:
            # The geometric mean of 1 and gravity.
            in_g = float(np.linalg.norm(force)) < np.sqrt(GRAVITY_M_S2)
            self._scale = GRAVITY_M_S2 if in_g else 1.0
            self.choice = "accelerations are in g, not m/s^2; read as such" if in_g else ""
        return force * self._scale


@dataclass(frozen=True, slots=True)
class _Columns:
    """Column indices of a line; none of forces if the IMU is a gyroscope alone."""

    time: tuple[int, ...]
    gyro: tuple[int, ...]
    force: tuple[int, ...]
    gyro_scale: float = 1.0
    time_scale: float | None = None

    def stamp_s(self, row: NDArray[np.float64]) -> float:
        """Stamp of a line in seconds."""
        if len(self.time) == 2:
            return float(row[self.time[0]] + 1e-9 * row[self.time[1]])
        value = float(row[self.time[0]])
        return by_its_size(value) if self.time_scale is None else value * self.time_scale


@dataclass(frozen=True, slots=True)
class ImuFile:
    """The file of an IMU, with information from its publisher.

    Attributes
    ----------
    path
        File with one reading per line.
    head
        Names of its columns, if the file has no header or one with unknown names.
    T_base_imu
        Its pose on the robot; None if unknown.
    """

    path: Path
    head: str = ""
    T_base_imu: gtsam.Pose3 | None = None


def imu_file(folder: Path) -> Path | None:
    """The file of an IMU next to clouds."""
    return first_file(folder / name for name in _NAMES)


def beside_imu(log: Iterable[Numbered], imu: ImuFile | Path | None, account: Account) -> Iterable[Numbered]:
    """A log merged with the IMU of a file; unchanged if there is no file or it contains no readings."""
    if imu is None:
        return log
    imu = ImuFile(imu) if isinstance(imu, Path) else imu
    if imu.head and not _has_columns(imu):
        account.report.ignore(imu.path.name, NO_RATES)
        return log
    return with_imu(log, _read_imu(imu, account))


def _has_columns(imu: ImuFile) -> bool:
    """Whether the first line of numbers is as long as the publisher's header."""
    lines = (line.strip() for _, line in numbered_lines(imu.path, Account.quiet(imu.path)))
    first = next((line for line in lines if line and not _is_head(line)), b"")
    return len(_parted(first)) >= len(_names(imu.head))


def _read_imu(imu: ImuFile, account: Account) -> Iterator[tuple[int, ImuReading]]:
    """Readings with line numbers; invalid lines are counted."""
    path, unit = imu.path, ForceUnit()
    mounting = read_mounting(path.parent / _SIDECAR, "T_base_imu") or imu.T_base_imu
    columns = _columns(imu.head) or _Columns(_PLAIN[:1], _PLAIN[1:4], _PLAIN[4:7])
    for number, line in numbered_lines(path, account):
        text = line.strip()
        if not text:
            continue
        if _is_head(text):
            names = text.lstrip(b"#").decode("utf-8", "replace")
            columns = columns if imu.head else _columns(names) or columns
            continue
        with account.refusing(path.name, number, BAD_ROW, ValueError, IndexError):
            row = np.array([float(field) for field in _parted(text) if field.strip()])
            stamp_s = columns.stamp_s(row)
            gyro = row[list(columns.gyro)] * columns.gyro_scale
            force = row[list(columns.force)] if columns.force else np.zeros(3)
            if not np.isfinite([stamp_s, *gyro, *force]).all() or force.any() != bool(columns.force):
                raise RecordFault(BAD_ROW, text[:60].decode("ascii", "replace"))
            account.report.accept("IMU reading")
            yield number, ImuReading(stamp_s, gyro, unit.m_s2(force), mounting)
    if unit.choice:
        account.report.note(f"imu: {unit.choice}", 1)


def with_imu(log: Iterable[Numbered], readings: Iterator[Numbered]) -> Iterator[Numbered]:
    """A log with IMU readings, which come early so that they cover the revolution of a cloud."""
    waiting = next(readings, None)
    for number, measurement in log:
        while waiting is not None and waiting[1].stamp_s <= measurement.stamp_s + GAP_S:
            yield waiting
            waiting = next(readings, None)
        yield number, measurement
    if waiting is not None:
        yield waiting
        yield from readings


def _is_head(line: bytes) -> bool:
    """Whether a line is a header."""
    return line.startswith(b"#") or line[:1].isalpha()


def _parted(line: bytes) -> list[bytes]:
    """The fields of a line."""
    return line.split(b",") if b"," in line else re.split(rb"[;\s]+", line)


def _names(head: str) -> list[str]:
    """The names of columns."""
    parted = re.split(r"[,;]" if "," in head or ";" in head else r"\s+", head.strip())
    return [name.strip().lower() for name in parted]


def _columns(head: str) -> _Columns | None:
    """The columns by name; None if the line is no known header."""
    names = _names(head)
    plain = [re.split(r"[\[(]", name)[0].strip() for name in names]
    gyro, force = _axes(plain, _GYRO), _axes(plain, _FORCE)
    seconds = [n for n, name in enumerate(plain) if name in _SECONDS]
    rest = [n for n, name in enumerate(plain) if name in _REST]
    time = [n for n, name in enumerate(plain) if name.startswith(_TIMES[:3]) or name == _TIMES[3]]
    if not gyro or not (time or (seconds and rest)):
        return None
    # Phones call accelerations without gravity those of the user.
    others = [name for n, name in enumerate(plain) if n not in (*gyro, *time, *seconds, *rest)]
    if not force and sum(not name.startswith("user") for name in others) >= len(gyro):
        return None
    gyro_scale = math.radians(1.0) if "deg" in names[gyro[0]] else 1.0
    if seconds and rest:
        return _Columns((seconds[0], rest[0]), gyro, force, gyro_scale)
    time_scale = next((scale for unit, scale in _UNITS.items() if f"[{unit}]" in names[time[0]]), None)
    return _Columns((time[0],), gyro, force, gyro_scale, time_scale)


def _axes(names: list[str], pattern: re.Pattern[str]) -> tuple[int, ...]:
    """Column indices of a sensor's three axes; empty if one is missing."""
    columns = {match[3]: n for n, name in reversed(list(enumerate(names))) if (match := pattern.match(name))}
    return tuple(columns[axis] for axis in "xyz") if len(columns) == 3 else ()
