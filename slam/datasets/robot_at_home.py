"""Robot@Home, first edition: text indexes, each with a folder of scans or images."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from slam.datasets.account import Account
from slam.datasets.dataset import RecordFault
from slam.datasets.frame_pairs import FramePair
from slam.datasets.log_file import read_head
from slam.datasets.recording import Contents, Numbered, Recording
from slam.datasets.robot_at_home_rig import BAD_SCAN, BAD_TIME, LASER, camera, laser_scan, unix_stamp_s
from slam.datasets.stamped_files import StampedFile, fields_of
from slam.errors import DatasetError
from slam.measurements import FloatArray

NO_SCAN_FILE = "scan file missing or unreadable"

_HEAD_BYTES = 1 << 14
# id label x y z yaw pitch roll time
_INDEX_LINE = re.compile(rb"^\s*\d+\s+(?:HOKUYO|RGBD_)\d+(?:\s+\S+){6}\s+\d{15,20}\s*$", re.MULTILINE)
_FIELDS = 9
_SESSION = re.compile(r"[a-z0-9]+-s\d+")  # alma-s1
_DEPTH_OF_TREE, _FOLDERS_SEEN = 4, 500  # a whole download is four folders deep
_TREES = ("laser_scans", "rgbd_data")  # folder trees of the same structure


@dataclass(frozen=True, slots=True)
class _Observation:
    """A line of an index; ``folder`` contains its files, named after ``key``."""

    stamp_s: float
    number: int
    key: str
    folder: Path


def looks_like_robot_at_home(path: Path, head: bytes) -> bool:
    """Whether a path is a folder that contains an index of observations at some level."""
    return path.is_dir() and next(_indexes(path), None) is not None


def open_robot_at_home(path: Path, strict: bool) -> Recording:
    """Open a session or one of its rooms: scans and images, even if the path leads to only one of them.

    Raises
    ------
    DatasetError
        There are several sessions under the path.
    """
    indexes = sorted({index for tree in _both_trees(path) for index in _indexes(tree)})
    sessions = sorted({_session(index) for index in indexes})
    if len(sessions) > 1:
        raise DatasetError(
            f"{path} holds {len(sessions)} sessions ({', '.join(sessions[:8])}); give the folder of one"
        )
    return Recording(path, lambda account: _load(indexes, account), lambda _: None, strict=strict)


def _load(indexes: list[Path], account: Account) -> Contents:
    """The observations of all indexes by sensor, the earliest index first."""
    listed_by: dict[str, list[list[_Observation]]] = defaultdict(list)
    for index in indexes:
        observations: dict[str, list[_Observation]] = defaultdict(list)
        for label, observation in _observations(index, account):
            observations[label].append(observation)
        for label, listed in observations.items():
            listed_by[label].append(listed)
    in_order = {
        label: [shot for part in sorted(parts, key=lambda part: part[0].stamp_s) for shot in part]
        for label, parts in listed_by.items()
    }
    scans = in_order.pop(LASER, [])
    cameras = [camera(label, [_pair(shot) for shot in in_order[label]]) for label in sorted(in_order)]
    return Contents(cameras, _scans(scans, account))


def _observations(index: Path, account: Account) -> Iterator[tuple[str, _Observation]]:
    """Labels and observations of an index, in its order."""
    for number, fields in fields_of(index, account, _FIELDS):
        with account.refusing(index.name, number):
            if not fields[0].isdigit():
                raise RecordFault(BAD_TIME, repr(fields[0][:24]))
            key, label = str(int(fields[0])), fields[1].decode("ascii", "replace")
            yield label, _Observation(unix_stamp_s(fields[8]), number, key, index.with_suffix(""))


def _pair(shot: _Observation) -> FramePair:
    """The two images of an observation."""
    color, depth = (
        StampedFile(shot.stamp_s, shot.folder / f"{shot.key}_{kind}.png", shot.number)
        for kind in ("intensity", "depth")
    )
    return FramePair(shot.stamp_s, color, depth)


def _scans(observations: list[_Observation], account: Account) -> Iterator[Numbered]:
    """Scans, one file at a time."""
    for shot in observations:
        account.report.line_count += 1
        with account.refusing(shot.folder.name, shot.number):
            aperture, maximum, count, ranges, valid = _scan_lines(shot.folder / f"{shot.key}_scan.txt")
            if not aperture.size == maximum.size == count.size == 1 or count[0] != ranges.size:
                raise RecordFault(BAD_SCAN, f"{shot.key}: {ranges.size} ranges")
            scan = laser_scan(shot.stamp_s, ranges, valid, float(aperture[0]), float(maximum[0]), account)
            account.report.accept(LASER)
            yield shot.number, scan


def _scan_lines(path: Path) -> list[FloatArray]:
    """The five lines of numbers of a scan file."""
    try:
        text = path.read_bytes().splitlines()
    except OSError as error:
        raise RecordFault(NO_SCAN_FILE, f"{path.name}: {error.strerror}") from error
    lines = [line for line in text if line.strip() and not line.lstrip().startswith(b"#")]
    try:
        numbers = [np.array([float(field) for field in line.split()]) for line in lines]
    except ValueError as error:
        raise RecordFault(BAD_SCAN, f"{path.name}: {error}") from error
    if len(numbers) != 5:
        raise RecordFault(BAD_SCAN, f"{path.name}: {len(numbers)} lines of numbers instead of 5")
    return numbers


def _both_trees(path: Path) -> list[Path]:
    """The path, and its counterpart in the tree of the other sensors if there is one."""
    other = str(path.resolve())
    scans, images = _TREES
    other = other.replace(scans, images) if scans in other else other.replace(images, scans)
    room = Path(other)
    # A room is a folder in the tree of scans, and a file in the tree of images.
    rgbd = room.parent / f"{room.name}_rgbd.txt"
    return [path, *(tree for tree in (room, rgbd) if tree != path.resolve() and tree.exists())]


def _indexes(path: Path) -> Iterator[Path]:
    """Index files at or below a path; folders of scans and images are not entered."""
    if path.is_file():
        yield path.resolve()
        return
    level = [path.resolve()]
    for _ in range(_DEPTH_OF_TREE + 1):
        below: list[Path] = []
        for folder in level:
            names = _entries(folder)
            for name in sorted(names):
                if names[name] and f"{name}.txt" not in names:
                    below.append(folder / name)
                elif name.endswith(".txt") and names.get(name.removesuffix(".txt")):
                    index = folder / name
                    if _INDEX_LINE.search(read_head(index, _HEAD_BYTES)):
                        yield index
        level = below[:_FOLDERS_SEEN]


def _entries(folder: Path) -> dict[str, bool]:
    """Names in a folder, and whether each is a folder; none if access is denied."""
    try:
        with os.scandir(folder) as entries:
            return {entry.name: entry.is_dir() for entry in islice(entries, _FOLDERS_SEEN)}
    except OSError:
        return {}


def _session(index: Path) -> str:
    """The session that an index belongs to, by the folders above it."""
    named = (part for part in reversed(index.parts[:-1]) if _SESSION.fullmatch(part))
    return next(named, "")
