"""The description that a reader registers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.dataset import Dataset
from slam.datasets.recording import Contents, Recording
from slam.estimates import Trajectory


@dataclass(frozen=True, slots=True)
class DatasetFormat:
    """One file format.

    Attributes
    ----------
    description
        For the message that lists the supported formats.
    recognises
        Returns whether a path with its first decompressed bytes (empty for a directory) has this format.
    open
        Returns the dataset for a path and ``strict``.
    """

    description: str
    recognises: Callable[[Path, bytes], bool]
    open: Callable[[Path, bool], Dataset]


def recorded(
    description: str,
    recognises: Callable[[Path, bytes], bool],
    load: Callable[[Path, Account], Contents],
    truth: Callable[[Path, Account], Trajectory | None] = lambda path, account: None,
    check: Callable[[Path], object] = Path.exists,
) -> DatasetFormat:
    """The format of a `Recording`, by functions of its path; ``check`` can reject it before reading."""

    def opened(path: Path, strict: bool) -> Recording:
        check(path)
        return Recording(path, partial(load, path), partial(truth, path), strict=strict)

    return DatasetFormat(description, recognises, opened)
