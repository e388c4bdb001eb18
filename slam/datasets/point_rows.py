"""Reads rows of points after the header of PCD and PLY files, binary or text."""

from __future__ import annotations

import os
from itertools import chain, islice
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import LARGEST_BYTES

_MOST_HEADER_BYTES = 1 << 16


def header_line(stream: BinaryIO) -> str:
    """Return the next line of a header, stripped; ValueError if the file or the limit ends first."""
    line = stream.readline(_MOST_HEADER_BYTES)
    if not line.endswith(b"\n") or stream.tell() > _MOST_HEADER_BYTES:
        raise ValueError(f"no end of the header in {min(stream.tell(), _MOST_HEADER_BYTES)} bytes")
    return line.decode("ascii", errors="replace").strip()


def bytes_left(stream: BinaryIO) -> int:
    """Number of bytes to the end of the file."""
    return os.fstat(stream.fileno()).st_size - stream.tell()


def check_bytes(stream: BinaryIO, needed: int) -> None:
    """Raise a ValueError for a file that is shorter than its header says, before memory is allocated."""
    if needed > bytes_left(stream):
        start = stream.tell()
        raise ValueError(f"cut off, {start + bytes_left(stream)} of {start + needed} bytes")


def row_bytes(fields: list[tuple[str, str, int]]) -> int:
    """Length of a row in bytes, see `row_type`."""
    return sum(np.dtype(code).itemsize * width for _, code, width in fields)


def row_type(fields: list[tuple[str, str, int]]) -> np.dtype[np.void]:
    """The type of rows.

    Parameters
    ----------
    fields
        Name, NumPy type code and count of each field.

    Raises
    ------
    ValueError
        There is no field, two have the same name, or the row length is impossible.
    """
    if not 0 < row_bytes(fields) <= LARGEST_BYTES:
        raise ValueError(f"{len(fields)} fields of {row_bytes(fields)} bytes")
    return np.dtype([(name, code) if count == 1 else (name, code, (count,)) for name, code, count in fields])


def binary_rows(stream: BinaryIO, fields: list[tuple[str, str, int]], count: int) -> NDArray[np.void]:
    """The next ``count`` rows; ValueError as `check_bytes` and `row_type`."""
    check_bytes(stream, count * row_bytes(fields))
    return np.frombuffer(stream.read(count * row_bytes(fields)), row_type(fields))


def text_rows(stream: BinaryIO, fields: list[tuple[str, str, int]], count: int) -> NDArray[np.void]:
    """The next ``count`` lines of numbers.

    Raises
    ------
    ValueError
        There are too few rows, a row has too many or too few numbers, or a number is invalid for its type.
    """
    # A number takes at least a digit and a separator.
    check_bytes(stream, 2 * count * sum(width for _, _, width in fields) - 1)
    if count == 0:
        return np.empty(0, row_type(fields))
    lines = (line.decode("ascii") for line in islice(stream, count))
    # Zeros first: if all lines are empty, loadtxt warns and returns nothing.
    zeros = " ".join("0" for _, _, width in fields for _ in range(width))
    rows = np.loadtxt(chain([zeros], lines), row_type(fields), comments=None, ndmin=1)[1:]
    if len(rows) != count:
        raise ValueError(f"cut off, {len(rows)} of {count} lines")
    return rows
