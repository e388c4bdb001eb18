"""Readers: one a file format, all behind open_dataset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slam.datasets.carmen import HEAD_BYTES, CarmenDataset, looks_like_carmen
from slam.datasets.dataset import Dataset, ReadReport
from slam.datasets.log_file import read_head
from slam.datasets.recorded_folder import looks_like_recorded_folder, open_recorded_folder
from slam.datasets.seven_scenes import looks_like_seven_scenes, open_seven_scenes
from slam.datasets.tum import looks_like_tum, open_tum
from slam.errors import DatasetError

__all__ = ["FORMATS", "Dataset", "DatasetFormat", "ReadReport", "open_dataset"]


@dataclass(frozen=True, slots=True)
class DatasetFormat:
    """One file format.

    Attributes
    ----------
    description
        For the message that lists what is supported.
    recognises
        Told a path and the first decompressed bytes (empty for a directory), whether this is the format.
    open
        Told a path and ``strict``, the dataset.
    """

    description: str
    recognises: Callable[[Path, bytes], bool]
    open: Callable[[Path, bool], Dataset]


def _open_carmen(path: Path, strict: bool) -> Dataset:
    return CarmenDataset(path, strict=strict)


# The one place where a new reader is registered; the first that recognises a path reads it.
FORMATS: tuple[DatasetFormat, ...] = (
    DatasetFormat("CARMEN log (.log, .clf, plain or .gz)", looks_like_carmen, _open_carmen),
    DatasetFormat("7-Scenes folder", looks_like_seven_scenes, open_seven_scenes),
    DatasetFormat("folder of a CARMEN log and TUM images", looks_like_recorded_folder, open_recorded_folder),
    DatasetFormat("TUM RGB-D folder", looks_like_tum, open_tum),
)


def open_dataset(path: Path | str, *, strict: bool = False) -> Dataset:
    """Open a log by its content, whatever its name.

    Parameters
    ----------
    path
        A log file, or a folder of one recording.
    strict
        Stop at the first damaged record instead of counting and skipping it.

    Returns
    -------
    Dataset
        Iterable of measurements; nothing but its beginning has been read yet.

    Raises
    ------
    DatasetError
        No such file, an empty one, or a format that no reader recognises.
    """
    path = Path(path)
    supported = ", ".join(known.description for known in FORMATS)
    if not path.exists():
        raise DatasetError(f"{path} does not exist; give the path of a log: {supported}")
    if not (path.is_file() or path.is_dir()):
        raise DatasetError(f"{path} is neither a file nor a directory; supported: {supported}")
    head = read_head(path, HEAD_BYTES) if path.is_file() else b""
    if path.is_file() and not head:
        raise DatasetError(
            f"{path} is empty or its compression is damaged from the start; supported: {supported}"
        )
    for known in FORMATS:
        if known.recognises(path, head):
            return known.open(path, strict)
    kind = "directory" if path.is_dir() else "file"
    raise DatasetError(f"{path} is a {kind} of no known format; supported: {supported}")
