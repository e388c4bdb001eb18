"""Bytes and arrays that are seldom needed, stored in temporary files."""

from __future__ import annotations

import mmap
import os
import tempfile
import weakref
from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import ScanweaveError


class Spool:
    """Pieces of a temporary file that goes with it; memory holds where they end."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="scanweave-", buffering=0)  # noqa: SIM115 - lives as long
        weakref.finalize(self, self._file.close)
        self._ends = array("q", [0])

    def __len__(self) -> int:
        return len(self._ends) - 1

    def append(self, content: bytes) -> None:
        """Keep the next piece.

        Raises
        ------
        ScanweaveError
            If there is no room for it.
        """
        end, left = self._ends[-1], memoryview(content)
        try:
            while left:
                left = left[os.pwrite(self._file.fileno(), left, end + len(content) - len(left)) :]
        except OSError as error:
            raise no_room("what was read", error) from error
        self._ends.append(end + len(content))

    def __getitem__(self, index: int) -> bytes:
        first, last = self._ends[index], self._ends[index + 1]
        return os.pread(self._file.fileno(), last - first, first)


class ArraySpool:
    """Arrays in temporary files that memory is mapped to: what is looked at stays until more has come."""

    def __init__(self) -> None:
        self._rooms, self._used = list[mmap.mmap](), 0

    def keep(self, content: NDArray[Any]) -> NDArray[Any]:
        """The same array there; it may be written to.

        Raises
        ------
        ScanweaveError
            If there is no room for it.
        """
        if not self._rooms or self._used + content.nbytes > len(self._rooms[-1]):
            for room in self._rooms:
                room.madvise(mmap.MADV_DONTNEED)
            size, self._used = max(content.nbytes, 256 * mmap.PAGESIZE), 0
            try:
                with tempfile.TemporaryFile(prefix="scanweave-") as file:
                    file.write(bytes(size))
                    file.flush()
                    self._rooms.append(mmap.mmap(file.fileno(), size))
            except OSError as error:
                raise no_room("what was read", error) from error
        kept = np.frombuffer(self._rooms[-1], content.dtype, content.size, self._used)
        self._used += -(-content.nbytes // 8) * 8
        kept = kept.reshape(content.shape)
        kept[...] = content
        return kept


def no_room(what: str, error: OSError) -> ScanweaveError:
    """The error for a full disk."""
    return ScanweaveError(
        f"cannot keep {what} in {tempfile.gettempdir()}: {error.strerror or error}; "
        "set TMPDIR to a folder with free space"
    )
