"""Bytes that are asked for seldom, in a temporary file."""

from __future__ import annotations

import os
import tempfile
import weakref
from array import array

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
            Where there is no room for it.
        """
        end, left = self._ends[-1], memoryview(content)
        try:
            while left:
                left = left[os.pwrite(self._file.fileno(), left, end + len(content) - len(left)) :]
        except OSError as error:
            raise ScanweaveError(
                f"cannot keep what was read in {tempfile.gettempdir()}: {error.strerror or error}; "
                "set TMPDIR to a folder with free space"
            ) from error
        self._ends.append(end + len(content))

    def __getitem__(self, index: int) -> bytes:
        first, last = self._ends[index], self._ends[index + 1]
        return os.pread(self._file.fileno(), last - first, first)
