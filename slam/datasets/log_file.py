"""Reads lines of a text log, plain or gzip, as a stream that tolerates damage."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from slam.datasets.account import Account
from slam.datasets.budget import Budget
from slam.datasets.dataset import RecordFault
from slam.errors import DatasetError

if TYPE_CHECKING:
    from typing_extensions import Buffer

MAX_LINE_BYTES = 1 << 20  # ten times the longest known scan line; limits the memory for damaged data
_BUFFER_BYTES = 1 << 18
_GZIP_MAGIC = b"\x1f\x8b"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"

LINE_TOO_LONG = "line too long"
STREAM_DAMAGED = "compressed data damaged or cut short; read up to there"

OnShare = Callable[[float], None]
_LINES_A_SHARE = 64


def open_log(path: Path) -> io.BufferedReader:
    """Open a log, gzip or not by its content; DatasetError if it cannot be opened."""
    try:
        raw = path.open("rb")
        compressed = raw.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC
        raw.seek(0)
        if not compressed:
            return raw
        raw.close()
        return io.BufferedReader(_Gunzipped(path), _BUFFER_BYTES)
    except OSError as error:
        raise DatasetError(f"cannot open {path}: {error.strerror}; check the path and its rights") from error


class _Gunzipped(io.RawIOBase):
    """Returns decompressed bytes as soon as they are available.

    If a buffer contains damage, a GzipFile that reads a whole buffer returns nothing of it.
    """

    def __init__(self, path: Path) -> None:
        self.packed = path.open("rb")
        self._file = gzip.GzipFile(fileobj=self.packed)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Buffer) -> int:
        view = memoryview(buffer)
        data = self._file.read1(len(view))
        view[: len(data)] = data
        return len(data)

    def close(self) -> None:
        self._file.close()
        self.packed.close()
        super().close()


def read_head(path: Path, size: int) -> bytes:
    """Up to ``size`` decompressed bytes from the start, without damaged parts."""
    chunks: list[bytes] = []
    with open_log(path) as stream:
        try:
            while size > 0 and (chunk := stream.read1(min(size, _BUFFER_BYTES))):
                chunks.append(chunk)
                size -= len(chunk)
        except (EOFError, OSError, zlib.error):
            pass
    return b"".join(chunks).removeprefix(_BYTE_ORDER_MARK)


def first_file(places: Iterable[Path]) -> Path | None:
    """The first of several paths that is a file."""
    return next((place for place in places if place.is_file()), None)


def files_inside(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Return visible files of a folder by lower-case endings, unsorted; DatasetError if unreadable."""
    try:
        shown = (file for file in folder.iterdir() if not file.name.startswith("."))  # macOS adds ._NAME
        return [file for file in shown if file.suffix.lower() in suffixes and file.is_file()]
    except OSError as error:
        raise DatasetError(f"cannot list {folder}: {error.strerror}; check its rights") from error


def numbered_lines(
    path: Path, account: Account, on_share: OnShare | None = None
) -> Iterator[tuple[int, bytes]]:
    """1-based line numbers and lines with their line ends, in constant memory.

    Parameters
    ----------
    account
        Counts lines that are too long, which are skipped, and damaged compression, which ends the stream
        after the last readable part, as `Budget` does.
    on_share
        Called from time to time with the fraction of the file that has been read, 0..1.

    Raises
    ------
    DatasetError
        The file cannot be opened or the device fails.
    """
    number = 0
    with open_log(path) as stream:
        size = max(path.stat().st_size, 1)
        budget, unpaid = Budget(size, text=True), 0
        try:
            while line := stream.readline(MAX_LINE_BYTES):
                number += 1
                unpaid += len(line)
                if number % _LINES_A_SHARE == 0:
                    budget.take(unpaid, _LINES_A_SHARE)
                    unpaid = 0
                    if on_share is not None:
                        raw = stream.raw
                        read = raw.packed.tell() if isinstance(raw, _Gunzipped) else stream.tell()
                        on_share(read / size)
                if len(line) == MAX_LINE_BYTES and not line.endswith(b"\n"):
                    while (rest := stream.readline(MAX_LINE_BYTES)) and not rest.endswith(b"\n"):
                        budget.take(len(rest))
                    fault = RecordFault(LINE_TOO_LONG, f"more than {MAX_LINE_BYTES} bytes")
                    account.refuse(fault, path.name, number)
                    continue
                yield number, line.removeprefix(_BYTE_ORDER_MARK) if number == 1 else line
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            account.refuse(RecordFault(STREAM_DAMAGED, str(error)), path.name, number + 1)
        except RecordFault as fault:
            account.refuse(fault, path.name, number)
        except OSError as error:
            raise DatasetError(f"cannot read {path} after line {number}: {error.strerror}") from error
