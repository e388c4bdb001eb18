"""Finds the files of a bag, and reads their messages in order."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.bags import mcap, rosbag1, sqlite
from slam.datasets.bags.compression import PACKED, unpacked_file, unpacked_message
from slam.datasets.bags.records import BagRecord, Channel, Container
from slam.datasets.bags.topics import IMU, OUSTER
from slam.datasets.budget import Budget
from slam.datasets.log_file import files_inside
from slam.datasets.sqlite_reading import SQLITE_MAGIC
from slam.errors import DatasetError
from slam.foreign import from_yaml
from slam.temporary import TemporaryFolder

_INDEX = "metadata.yaml"
_INDEX_TITLE = "rosbag2_bagfile_information"
_SUFFIXES = {".mcap", ".db3", ".bag"}
_PART = re.compile(r"(.*?)_?(\d+)")  # drive_0.mcap, drive_1.mcap: parts of one recording
_NS = 1e-9


@dataclass(frozen=True, slots=True)
class Bag:
    """The files of one recording, in the order in which they were written."""

    path: Path
    parts: tuple[Path, ...]
    containers: tuple[Container, ...]
    unpacked: TemporaryFolder | None = None  # contains the parts if they were compressed as whole files

    def announced(self) -> list[Channel] | None:
        """All channels in the files' indexes; None if a file has no index, for example a truncated one."""
        channels_announced: dict[Channel, None] = {}
        for path, container in zip(self.parts, self.containers, strict=True):
            channels = container.announced(path)
            if channels is None:
                return None
            channels_announced.update(dict.fromkeys(map(_read_as, channels)))
        return list(channels_announced)

    def budget(self) -> Budget:
        """The budget of one pass over the bag."""
        return Budget(sum(part.stat().st_size for part in self.parts))

    def records(self, account: Account, budget: Budget) -> Iterator[BagRecord]:
        """All messages in file order; damaged ones are counted in the account.

        Raises
        ------
        BadRecordError
            Something is damaged, under ``strict``.
        DatasetError
            A file cannot be read at all.
        """
        number = 0
        for part, (path, container) in enumerate(zip(self.parts, self.containers, strict=True)):

            def note_share(share: float, part: int = part) -> None:
                account.report.note_share((part + share) / len(self.parts))

            for channel, recorded_ns, content in container.records(path, account, budget, note_share):
                number += 1
                account.report.line_count = number
                with account.refusing(path.name, number):
                    message = unpacked_message(content, channel, budget)
                    yield BagRecord(number, _read_as(channel), recorded_ns * _NS, message)


@lru_cache
def _read_as(channel: Channel) -> Channel:
    """A channel by its contents: lidar and IMU packets of an Ouster have the same type."""
    of_imu = channel.kind in OUSTER and channel.topic.endswith("imu_packets")
    return replace(channel, kind=IMU, own_kind=channel.kind) if of_imu else channel


def looks_like_bag(path: Path, head: bytes) -> bool:
    """Whether a path is a ROS bag: a file by its first bytes (or its name), a folder by its files."""
    if path.is_dir():
        return bool(_parts_inside(path) or _listed(path / _INDEX))
    packed = path.suffix.lower() in PACKED and Path(path.stem).suffix in _SUFFIXES
    return _container_of(path) is not None or path.suffix.lower() in _SUFFIXES or packed


def find_bag(path: Path) -> Bag:
    """The bag at a path: one file, or a folder of the parts of one recording.

    Raises
    ------
    DatasetError
        Files are missing, of no known kind, or of several recordings.
    """
    files = [path] if path.is_file() else _parts_of_one(path)
    folder = TemporaryFolder() if any(file.suffix.lower() in PACKED for file in files) else None
    parts = [unpacked_file(file, folder.path) if folder else file for file in files]
    containers = []
    for file, part in zip(files, parts, strict=True):
        container = _container_of(part)
        if container is None:
            raise DatasetError(
                f"{file} does not begin as a bag (ROS 1 .bag 2.0, .db3 or .mcap); copy it again, "
                "or unpack it if it is compressed as a whole"
            )
        containers.append(container)
    return Bag(path, tuple(parts), tuple(containers), folder)


def _container_of(path: Path) -> Container | None:
    """The reader for a file, by its first bytes; None if it is no bag."""
    try:
        with path.open("rb") as file:
            head = file.read(16)
    except OSError as error:
        raise DatasetError(f"cannot open {path}: {error.strerror}; check the path and its rights") from error
    if head.startswith(mcap.MAGIC):
        return mcap.McapContainer()
    if head.startswith(rosbag1.MAGIC):
        return rosbag1.Rosbag1Container()
    if head.startswith(SQLITE_MAGIC) and sqlite.is_rosbag2(path):
        return sqlite.SqliteContainer()
    return None


def _parts_inside(folder: Path) -> list[Path]:
    """The bag files directly in a folder, sorted by the numbers in their names."""
    files = files_inside(folder, _SUFFIXES)
    return sorted(files, key=lambda file: (_title(file), _part_number(file), file.name))


def _parts_of_one(folder: Path) -> list[Path]:
    """The files in ``metadata.yaml``, else the files in the folder that are named as parts of one bag."""
    inside = _parts_inside(folder)
    listed = _listed(folder / _INDEX)
    if listed:
        if missing := [part.name for part in listed if not part.is_file()]:
            raise DatasetError(
                f"{folder / _INDEX} lists {', '.join(missing[:4])}, which {folder} does not hold; "
                f"copy what is missing, or remove {_INDEX} to read what is there"
            )
        return listed
    if len({(_title(file), file.suffix) for file in inside}) > 1:
        names = ", ".join(file.name for file in inside[:6])
        raise DatasetError(f"{folder} holds {len(inside)} bags ({names}); give one of them")
    return inside


def _listed(index: Path) -> list[Path]:
    """The files in the order of ``metadata.yaml``; none if it is missing or damaged."""
    try:
        content = from_yaml(index.read_text(encoding="utf-8"))
        names = content[_INDEX_TITLE]["relative_file_paths"]
        # Older recorders write the folder name before the file name.
        parts = [index.parent / Path(str(name)).name for name in names]
        return [
            own if (own := part.with_suffix("")).suffix in _SUFFIXES and own.is_file() else part
            for part in parts
        ]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _title(file: Path) -> str:
    """A file name without the part number."""
    match = _PART.fullmatch(file.stem)
    return match[1] if match else file.stem


def _part_number(file: Path) -> int:
    """The part number, 0 if there is none."""
    match = _PART.fullmatch(file.stem)
    return int(match[2]) if match else 0
