"""Limits the resources for a log: a few bytes may decompress, or refer to themselves, without end.

The limit grows with the file size. No recorded log comes near it: deflate compresses at most 1032 to 1
(zlib's own figure), and no message, row or line with a time of its own takes less than eight bytes.
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.dataset import RecordFault

TOO_MUCH = "the file unpacks to more than any log; read up to there"

LARGEST_BYTES = 1 << 27  # per record, decompressed chunk, or cloud (2.6 million points with all fields)
MOST_PIXELS, MOST_BEAMS = 1 << 24, 1 << 16  # per image (a Kinect has 12.6 million), per scan

_FREE_RECORDS, _BYTES_A_RECORD, _ELEMENTS_A_RECORD = 1 << 14, 8, 8
_FREE_BYTES, _GROWTH, _TEXT_GROWTH = LARGEST_BYTES, 1032, 64
_DEFINITION, _DEFINITIONS = 1 << 16, 1 << 17  # characters of one and of all; CameraInfo has 7,000


class Budget:
    """The remaining budget of a log.

    Parameters
    ----------
    size
        Size of its files on disk, in bytes.
    text
        Whether they are lines of text: numbers compress to a fifth, and a line has at least 16 letters.
    """

    def __init__(self, size: int, *, text: bool = False) -> None:
        self._records = _FREE_RECORDS + size // (2 * _BYTES_A_RECORD if text else _BYTES_A_RECORD)
        self._bytes = _FREE_BYTES + (_TEXT_GROWTH if text else _GROWTH) * size
        self._definitions: set[str] = set()
        self._files: set[Path] = set()

    def add_file(self, path: Path, size: int) -> None:
        """Add another file of the log; once, even if a list names it several times."""
        if path not in self._files:
            self._files.add(path)
            self._bytes += _GROWTH * size

    def take(self, size: int, records: int = 1) -> None:
        """Pay for records of so many bytes in all; RecordFault if the budget is used up."""
        self._records -= records
        self._bytes -= size
        if self._records < 0 or self._bytes < 0:
            raise RecordFault(TOO_MUCH, f"{-min(self._records, 0)} records, {-min(self._bytes, 0)} bytes")

    def take_elements(self, count: int) -> None:
        """Charge for the list elements of a message, as `take` does."""
        self.take(0, count // _ELEMENTS_A_RECORD)

    def takes_definition(self, text: str) -> bool:
        """Whether a message definition is within the limits, alone and together with earlier ones."""
        known = sum(map(len, self._definitions - {text}))
        if len(text) > _DEFINITION or known + len(text) > _DEFINITIONS:
            return False
        self._definitions.add(text)
        return True
