"""Stamps of cloud files, and merging of clouds into a log by time.

The row format of ``.bin`` clouds that nothing names is detected: floats or doubles, three to six per
point.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from slam.datasets.account import Account
from slam.datasets.cloud_files import (
    CLOUD_SUFFIXES,
    KITTI_ROWS,
    PLAIN_SUFFIXES,
    CloudFile,
    Parsed,
    Rows,
    are_no_readings,
    read_cloud,
    row_of,
)
from slam.datasets.dataset import RecordFault
from slam.datasets.log_file import files_inside, first_file
from slam.datasets.plain_points import holds_points
from slam.datasets.point_times import PointTimes, intensities_of
from slam.datasets.recording import Numbered
from slam.datasets.stamped_files import StampedFile, fields_of, in_seconds, read_image_list, stamp_of
from slam.datasets.wheels_between import WHEELS_KEPT, wheels_at
from slam.errors import DatasetError
from slam.measurements import FloatArray, PointCloud, WheelOdometry
from slam.vision.prefetch import prefetched

UNPAIRED = "more clouds than stamps"
WITHOUT_CLOUD = "more stamps than clouds"

# In the folder of the clouds or above; each line is a stamp, or a stamp and a file name.
TIMES_NAMES = ("points.txt", "times.txt", "timestamps.txt", "stamps.txt")

_FIELDS = ("x", "y", "z", "intensity", "fifth", "sixth")
_FEWEST_FIELDS = 3
_FILES, _VALUES = 5, 60_000  # number of files examined, and values per file


@dataclass(frozen=True, slots=True)
class CloudFolder:
    """Clouds on disk.

    Attributes
    ----------
    files
        Files with stamps, in the order of the list.
    T_base_lidar
        Pose of the lidar on the robot.
    parse
        Reads a file, see `read_cloud`; None: chosen by the suffix, for ``.bin`` by the contents.
    stamped
        Whether the stamps were recorded, rather than derived from a counter.
    """

    files: tuple[StampedFile, ...]
    T_base_lidar: gtsam.Pose3 = field(default_factory=lambda: gtsam.Pose3())
    parse: Callable[[Path], Parsed] | None = None
    stamped: bool = True

    def numbered(self, account: Account) -> Iterator[tuple[int, PointCloud]]:
        """The clouds with their line numbers in the list; unreadable ones are counted."""
        times = PointTimes(self.stamped)
        rows = KITTI_ROWS if self.parse else rows_of([file.path for file in self.files])
        if rows != KITTI_ROWS:
            account.report.note(f"the .bin files hold {rows} a point", 1)

        def read(file: StampedFile) -> tuple[StampedFile, CloudFile | RecordFault]:
            """A cloud, or the reason why there is none; runs on the prefetching thread."""
            try:
                return file, read_cloud(file.path, self.parse or (rows if is_bin(file.path) else None))
            except RecordFault as fault:
                return file, fault

        for index, (file, cloud) in enumerate(prefetched(self.files, read, 1)):
            account.report.line_count += 1
            account.report.note_share(index / len(self.files))
            if isinstance(cloud, RecordFault):
                account.refuse(cloud, file.path.name, file.number)
                continue
            account.report.accept("cloud")
            times_s = times.of(cloud.fields, cloud.fields.__getitem__, file.stamp_s)
            intensities = intensities_of(cloud.fields, cloud.fields.__getitem__)
            measured = PointCloud(
                file.stamp_s, cloud.points_lidar, times_s, self.T_base_lidar, intensities=intensities
            )
            yield file.number, measured
        for note in times.notes("lidar"):
            account.report.note(note, 1)


def times_of(folder: Path) -> Path | None:
    """The list of stamps in a folder."""
    return first_file(folder / name for name in TIMES_NAMES)


def cloud_files(folder: Path) -> list[Path]:
    """Clouds directly in a folder, numbers in their names in the order of numbers."""
    files = files_inside(folder, CLOUD_SUFFIXES) or _plain_clouds(folder)
    # What follows a point is a fraction, whose digits are in order as they are.
    return sorted(files, key=lambda path: re.sub(r"(?<![.\d])\d+", lambda run: run[0].zfill(20), path.stem))


def _plain_clouds(folder: Path) -> list[Path]:
    """Return texts or arrays with a number in their names if the first of them holds points."""
    files = [file for file in files_inside(folder, PLAIN_SUFFIXES) if re.search(r"\d", file.stem)]
    return files if len(files) > 1 and holds_points(min(files)) else []


def stamped_clouds(times: Path, folder: Path, account: Account) -> list[StampedFile]:
    """The clouds of a list of stamps: by the names in it, else in the order of the folder."""
    looked_at = fields_of(times, Account.quiet(times), 1, 2)
    if any(len(fields) > 1 and fields[0].count(b"-") != 2 for _, fields in looked_at):  # no date and time
        return read_image_list(times, account)
    lines = list(fields_of(times, account, 1, 2))
    files, stamped = cloud_files(folder), list[StampedFile]()
    for (number, fields), path in zip(lines, files, strict=False):
        with account.refusing(times.name, number):
            stamped.append(StampedFile(stamp_of(b"T".join(fields), True), path, number))
    for number, _ in lines[len(files) :]:
        account.refuse(RecordFault(WITHOUT_CLOUD, f"{len(lines)} and {len(files)}"), times.name, number)
    for place in range(len(lines), len(files)):
        account.refuse(RecordFault(UNPAIRED, f"{len(files)} and {len(lines)}"), times.name, place + 1)
    return in_seconds(stamped, account, times.name)


def clouds_by_name(
    folder: Path,
    account: Account,
    pattern: str = r"(\d{9,19})\.bin",
    stamp_of_name: Callable[[re.Match[str]], float] = lambda match: float(match[1]),
) -> list[StampedFile]:
    """The clouds whose names match a pattern, sorted by the stamps in their names."""
    name, stamped = re.compile(pattern), []
    for path in cloud_files(folder):
        if match := name.fullmatch(path.name):
            stamped.append(StampedFile(stamp_of_name(match), path, 0))
    stamped = in_seconds(stamped, account, folder.name)
    stamped.sort(key=lambda file: (file.stamp_s, file.path.name))
    return [replace(file, number=number) for number, file in enumerate(stamped, 1)]


def merged(log: Iterable[Numbered], clouds: Iterator[tuple[int, PointCloud]]) -> Iterator[Numbered]:
    """A log with each cloud before the first later reading, and wheel odometry interpolated at its stamp."""
    wheels: deque[WheelOdometry] = deque(maxlen=WHEELS_KEPT)
    waiting = next(clouds, None)
    for number, reading in log:
        if isinstance(reading, WheelOdometry):
            wheels.append(reading)
        while waiting is not None and waiting[1].stamp_s < reading.stamp_s:
            if (at := wheels_at(wheels, waiting[1].stamp_s)) is not None:
                yield waiting[0], at
            yield waiting
            waiting = next(clouds, None)
        yield number, reading
    if waiting is not None:
        yield waiting
        yield from clouds


def rows_of(files: Sequence[Path]) -> Rows:
    """Return the row type of clouds by several files, KITTI's if unclear; DatasetError if none fits."""
    files = [path for path in files if is_bin(path) and path.is_file()]
    looked_at = files[:: max(1, len(files) // _FILES)][:_FILES]
    for kind in ("f4", "f8"):
        read = [_values(path, kind) for path in looked_at]
        values = [row for row in read if len(row) >= FEWEST * len(_FIELDS)]
        if not values:
            return KITTI_ROWS
        if 2 * sum(map(are_no_readings, values)) < len(values):
            fields = ", ".join(f"{name} {kind}" for name in _FIELDS[: _period(values)])
            return Rows(row_of(fields))
    raise DatasetError(
        f"{looked_at[0].name} and others hold no rows of {_FEWEST_FIELDS} to {len(_FIELDS)} floats or "
        "doubles, x, y and z first; convert them to .pcd or .ply, which name their fields"
    )


def is_bin(path: Path) -> bool:
    """Whether a file name stands for rows without header."""
    return path.suffix.lower() == ".bin"


def _values(path: Path, kind: str) -> FloatArray:
    """The first numbers of a file; none if it cannot be read, which is counted later."""
    try:
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            return np.fromfile(path, f"<{kind}", _VALUES).astype(np.float64)
    except OSError:
        return np.zeros(0)


def _period(values: Sequence[FloatArray]) -> int:
    """The number of values per row: values of one field differ least from each other.

    This is true for points in any order: the expected distance between samples of two distributions is never
    less than the mean of the expected distances within each (energy distance, Szekely 2013).
    """
    scaled = [np.arcsinh(np.nan_to_num(row, posinf=0.0, neginf=0.0)) for row in values]
    counts = range(_FEWEST_FIELDS, len(_FIELDS) + 1)
    diffs = [np.mean([np.abs(row[count:] - row[:-count]).mean() for row in scaled]) for count in counts]
    good = [count for count, row in zip(counts, diffs, strict=True) if row <= min(diffs) * (1 + 1 / FEWEST)]
    return good[0]
