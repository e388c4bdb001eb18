"""Reads text files whose lines start with a stamp: image lists, poses, associations of images."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fusion.estimation import FEWEST
from fusion.time_alignment import GAP_S
from slam.datasets.account import Account
from slam.datasets.dataset import STAMP_LIMIT_S, WARNING, RecordFault
from slam.datasets.log_file import numbered_lines
from slam.estimates import NORM_TOLERANCE, Trajectory
from slam.measurements import FloatArray

PARTED = re.compile(rb"[\s,;]+")
WRONG_FIELDS = "line with too few fields"
BAD_STAMP = "index line without a stamp of this age, in seconds"
BAD_NAME = "index line without a usable file name"
BAD_POSE = "pose line without finite numbers or a unit quaternion"
UNITS_S = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


@dataclass(frozen=True, slots=True)
class StampedFile:
    """An image in an index; ``number`` is the line."""

    stamp_s: float
    path: Path
    number: int


def fields_of(path: Path, account: Account, least: int, most: int = 0) -> Iterator[tuple[int, list[bytes]]]:
    """Line numbers and fields of a text file without comments and empty lines; short lines are counted.

    Commas, semicolons or blanks separate fields; the last one keeps them if there are more than ``most``.
    """
    for number, line in numbered_lines(path, account):
        text = line.strip(b",; \t\r\n")
        if not text or text.startswith(b"#"):
            continue
        fields = PARTED.split(text, max(most - 1, 0))
        if len(fields) < least:
            account.refuse(RecordFault(WRONG_FIELDS, f"{len(fields)} of {least}"), path.name, number)
            continue
        yield number, fields


def read_image_list(path: Path, account: Account) -> list[StampedFile]:
    """Read lines ``stamp name`` in file order; names are relative to the folder of the list.

    Parameters
    ----------
    account
        Counts damaged lines, or stops at the first.
    """
    images = []
    for number, (stamp, name) in fields_of(path, account, 2, 2):
        with account.refusing(path.name, number):
            images.append(StampedFile(stamp_of(stamp, True), image_path(path.parent, name), number))
    return in_seconds(images, account, path.name)


def read_associations(path: Path, account: Account) -> tuple[list[StampedFile], list[StampedFile]]:
    """Lines ``stamp name stamp name``, colour first or depth first, as colour and depth lists.

    The name that contains "depth" is the depth image; if there is none, it is the second name.
    """
    colors, depths = [], []
    for number, fields in fields_of(path, account, 4, 4):
        with account.refusing(path.name, number):
            first, second = (
                StampedFile(stamp_of(fields[k], True), image_path(path.parent, fields[k + 1]), number)
                for k in (0, 2)
            )
            swapped = b"depth" in fields[1].lower() and b"depth" not in fields[3].lower()
            colors.append(second if swapped else first)
            depths.append(first if swapped else second)
    return in_seconds(colors, account, path.name), in_seconds(depths, account, path.name)


def read_poses(path: Path, account: Account) -> Trajectory | None:
    """Read lines ``stamp x y z qx qy qz qw`` in file order, None if no line is valid.

    Fields beyond the eighth are ignored. Quaternions are normalised.
    """
    rows = [row for _, row in numbered_poses(path, account)]
    if not rows:
        return None
    table = np.array(rows)
    return Trajectory(table[:, 0].copy(), table[:, 1:4].copy(), table[:, 4:8].copy())


def numbered_poses(path: Path, account: Account) -> Iterator[tuple[int, FloatArray]]:
    """Line numbers and (8,) stamp, position and unit quaternion, one line at a time."""
    for number, fields in fields_of(path, account, 8):
        try:
            row = np.array([float(field) for field in fields[:8]])
        except ValueError:
            row = np.full(8, np.nan)
        sound = bool(np.isfinite(row).all()) and abs(row[0]) < STAMP_LIMIT_S
        norm = math.hypot(*row[4:].tolist()) if sound else math.inf
        if not abs(norm - 1.0) <= NORM_TOLERANCE:
            account.refuse(RecordFault(BAD_POSE, f"quaternion of length {norm:.4g}"), path.name, number)
            continue
        row[4:] /= norm
        yield number, row


def in_seconds(files: list[StampedFile], account: Account, where: str) -> list[StampedFile]:
    """Files of one list, whose size and interval show the unit of its stamps; those beyond it are counted.

    Seconds are the unit unless no clock shows them, or readings would be too far apart to be mapped.
    """
    stamps = np.unique([file.stamp_s for file in files])
    step, middle = (float(np.median(one)) if one.size else 0.0 for one in (np.diff(stamps), np.abs(stamps)))
    by_size = [unit for unit, unit_s in UNITS_S.items() if middle * unit_s < STAMP_LIMIT_S] or [*UNITS_S][-1:]
    unit = next((unit for unit in by_size if step * UNITS_S[unit] <= FEWEST * GAP_S), by_size[0])
    if unit != by_size[0]:
        account.report.note(f"{WARNING}{where}: its stamps are no {by_size[0]}; they are read as {unit}", 1)
    files = [replace(file, stamp_s=file.stamp_s * UNITS_S[unit]) for file in files]
    for file in files:
        if not abs(file.stamp_s) < STAMP_LIMIT_S:
            account.refuse(RecordFault(BAD_STAMP, file.path.name), where, file.number)
    return [file for file in files if abs(file.stamp_s) < STAMP_LIMIT_S]


def stamp_of(field: bytes, any_unit: bool = False) -> float:
    """Return a stamp in seconds, or any unit; RecordFault if it is no number or beyond any clock."""
    try:
        stamp_s = float(field)
    except ValueError:
        stamp_s = _date_s(field.decode("ascii", "replace"))
    if not abs(stamp_s) * (UNITS_S["nanoseconds"] if any_unit else 1.0) < STAMP_LIMIT_S:
        raise RecordFault(BAD_STAMP, repr(field[:24]))
    return stamp_s


def _date_s(text: str) -> float:
    """Seconds since 1970 of a date like ``2011-09-26T13:02:25.951199337``; NaN if it is none."""
    moment, _, fraction = text.partition(".")
    try:
        return datetime.fromisoformat(moment).replace(tzinfo=UTC).timestamp() + float(f"0.{fraction or 0}")
    except (ValueError, OverflowError):
        return math.nan


def image_path(folder: Path, name: bytes) -> Path:
    """Return the file of a name in an index; RecordFault if no file can have that name."""
    if b"\0" in name:
        raise RecordFault(BAD_NAME, repr(name[:24]))
    return folder / os.fsdecode(name)
