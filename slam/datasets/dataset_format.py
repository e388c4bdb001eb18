"""What a reader tells of itself where it is registered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slam.datasets.dataset import Dataset


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
