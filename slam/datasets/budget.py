"""How much one log may ask for: a few bytes can be packed, or point at themselves, so that they never end.

What is allowed grows with the file. Nothing that a recorder wrote comes near it: deflate packs at most 1032
to 1 (zlib's own figure), and no message, row or line that has its own time takes less than eight bytes.
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.dataset import RecordFault

TOO_MUCH = "the file unpacks to more than any log; read up to there"

LARGEST_BYTES = 1 << 27  # of one record, one unpacked chunk, one cloud; of 2.6 million points with all fields
MOST_PIXELS, MOST_BEAMS = 1 << 24, 1 << 16  # of one image (a Kinect has 12.6 million), of one scan

_FREE_RECORDS, _BYTES_A_RECORD, _ELEMENTS_A_RECORD = 1 << 14, 8, 8
_FREE_BYTES, _GROWTH, _TEXT_GROWTH = LARGEST_BYTES, 1032, 64
_DEFINITION, _DEFINITIONS = 1 << 16, 1 << 17  # letters of one and of all; those of CameraInfo are 7,000


class Budget:
    """What is left for a log.

    Parameters
    ----------
    size
        Bytes of its files on the disk.
    text
        Whether they are lines of text: numbers as text pack to a fifth, and a line has 16 letters and more.
    """

    def __init__(self, size: int, *, text: bool = False) -> None:
        self._records = _FREE_RECORDS + size // (2 * _BYTES_A_RECORD if text else _BYTES_A_RECORD)
        self._bytes = _FREE_BYTES + (_TEXT_GROWTH if text else _GROWTH) * size
        self._definitions: set[str] = set()
        self._files: set[Path] = set()

    def add_file(self, path: Path, size: int) -> None:
        """Count another file of the log; once, however often a list names it."""
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
        """Pay for the elements of a message's lists, as `take` does."""
        self.take(0, count // _ELEMENTS_A_RECORD)

    def takes_definition(self, text: str) -> bool:
        """Whether the definition of a message is read, and with it all that were read before."""
        known = sum(map(len, self._definitions - {text}))
        if len(text) > _DEFINITION or known + len(text) > _DEFINITIONS:
            return False
        self._definitions.add(text)
        return True
