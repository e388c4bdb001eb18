"""Rawseeds: a robot with four 2D lidars in offices and on a campus.

Ceriani et al. 2009, "Rawseeds ground truth collection systems for indoor self-localization and mapping".
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.carmen import read_messages
from slam.datasets.carmen_records import BAD_POSE, WRONG_COUNT, finite_row
from slam.datasets.dataset import WARNING, RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.log_file import numbered_lines
from slam.datasets.pose_files import trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import fields_of, stamp_of
from slam.estimates import Trajectory
from slam.measurements import pose2_from_row

_SCANS, _WHEELS, _TRUTH = "*SICK_FRONT.csv", "*ODOMETRY_XYT.csv", "*GROUNDTRUTH.csv"
_OTHERS = ("*SICK_REAR.csv", "*HOKUYO_*.csv")
_NOT_PLACED = "its pose relative to SICK_FRONT is in none of the files"
_CENTRE = f"{WARNING}SICK_FRONT: its mounting is in none of the files; assumed at the robot's centre"
# The scanner has steps of a degree; its first beam is this many quarter degrees after -90 degrees.
_STEP_DEG, _QUARTERS, _GREATEST_M = 1.0, 4.0, b"81.91"


def _load(path: Path, account: Account) -> Contents:
    """The front scanner and the wheel odometry, merged by stamp."""
    for other in (file for pattern in _OTHERS for file in sorted(path.glob(pattern))):
        account.report.ignore(other.name, _NOT_PLACED)
    account.report.note(_CENTRE, 1)
    file = sorted(path.glob(_SCANS))[0]
    tables = [_rows(source, account) for source in (*sorted(path.glob(_WHEELS))[:1], file)]
    merged = heapq.merge(*tables, key=lambda row: row[0])
    rows = ((number, line) for _, number, line in merged)
    return Contents(log=read_messages(rows, _words, file.name, account))


def _rows(file: Path, account: Account) -> Iterator[tuple[float, int, bytes]]:
    """Stamps and lines of a table; a stamp that runs backward is replaced by the previous one."""
    newest_s = -math.inf
    for number, line in numbered_lines(file, account, account.report.note_share):
        with account.refusing(file.name, number):
            if line.strip():
                newest_s = max(newest_s, stamp_of(line.partition(b",")[0]))
                yield newest_s, number, line


def _words(line: bytes) -> Iterator[list[bytes]]:
    """A row (stamp, 3 counts, x, y, yaw; or stamp, count, first bearing, ranges) as CARMEN message."""
    stamp, *fields = [field.strip() for field in line.split(b",")]
    if len(fields) == 6:
        yield [b"ODOM", *fields[3:6], b"0", b"0", b"0", stamp, b"rawseeds", stamp]
        return
    try:
        count, ranges = int(fields[0]), fields[2:]
        first_rad = math.radians(float(fields[1]) / _QUARTERS) - 0.5 * math.pi
    except (ValueError, IndexError) as error:
        raise RecordFault(WRONG_COUNT, str(error)) from error
    if count != len(ranges):
        raise RecordFault(WRONG_COUNT, f"{count} announced, {len(ranges)} follow")
    step_rad = math.radians(_STEP_DEG)
    start, span, step = (repr(angle).encode() for angle in (first_rad, step_rad * (count - 1), step_rad))
    head = [b"RAWLASER1", b"0", start, span, step, _GREATEST_M, b"0", b"0", fields[0]]
    yield [*head, *ranges, b"0", stamp, b"rawseeds", stamp]


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Stamp, x, y and yaw of the robot."""

    def poses(file: Path) -> Iterator[tuple[float, gtsam.Pose3]]:
        for number, fields in fields_of(file, account, 4):
            with account.refusing(file.name, number, BAD_POSE, ValueError):
                pose = pose2_from_row(finite_row(np.array(fields[1:4], dtype=np.float64)))
                yield stamp_of(fields[0]), gtsam.Pose3(pose)

    return next((trajectory_of(poses(file)) for file in sorted(path.glob(_TRUTH))), None)


FORMAT = recorded(
    "Rawseeds folder", lambda path, head: path.is_dir() and any(path.glob(_SCANS)), _load, _groundtruth
)
