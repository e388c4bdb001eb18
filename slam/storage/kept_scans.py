"""Scans of keyframes that are read when they are needed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from slam.measurements import LaserScan
from slam.spool import Spool
from slam.storage.packing import pack_small, unpack_small


class KeptScans(Sequence[LaserScan | None]):
    """Scans with one in memory at a time, shared by parallel iterations.

    Parameters
    ----------
    count
        Number of scans.
    read
        Reads the scan of an index.
    """

    def __init__(self, count: int, read: Callable[[int], Any]) -> None:
        self._count, self._read = count, read
        self._newest: tuple[int, Any] = -1, None

    @classmethod
    def on_disk(cls, scans: Iterable[Any]) -> KeptScans:
        """Store scans, or tuples of them, in a temporary file as they are created."""
        spool = Spool()
        for scan in scans:
            spool.append(pack_small(scan))
        return cls(len(spool), lambda key: unpack_small(spool[key]))

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, key: Any) -> Any:
        numbers = range(self._count)[key]
        if isinstance(numbers, range):
            return [self[number] for number in numbers]
        newest = self._newest
        if newest[0] != numbers:
            self._newest = newest = numbers, self._read(numbers)
        return newest[1]
