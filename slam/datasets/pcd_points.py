"""Reads points of PCD files of the Point Cloud Library: text, binary, or compressed binary."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.datasets.budget import LARGEST_BYTES
from slam.datasets.point_rows import binary_rows, check_bytes, header_line, row_bytes, text_rows

_KINDS = {"F": "f", "I": "i", "U": "u"}
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_PADDING = "_"
# A back reference takes at least three bytes and stands for at most 264 bytes.
_MOST_GROWTH = 264 / 3


def read_pcd_points(path: Path) -> dict[str, NDArray[Any]]:
    """The fields of the points by name, (N,) each, or (N, C) if a field has a count C.

    ValueError if the file is damaged, truncated, or no PCD file; OSError if it cannot be read.
    """
    with path.open("rb") as stream:
        header = _header(stream)
        fields, count = _fields(header), _count(header)
        match header["DATA"]:
            case ["ascii"]:
                rows = text_rows(stream, fields, count)
            case ["binary"]:
                rows = binary_rows(stream, fields, count)
            case ["binary_compressed"]:
                return _without_padding(_compressed(stream, fields, count))
            case form:
                raise ValueError(f"DATA {' '.join(form)[:80]}; known are ascii, binary, binary_compressed")
    return _without_padding({name: rows[name].copy() for name, _, _ in fields})


def _header(stream: BinaryIO) -> dict[str, list[str]]:
    """The lines of the header by their first word."""
    header: dict[str, list[str]] = {}
    while "DATA" not in header:
        name, *values = header_line(stream).split() or ["#"]
        if not name.startswith("#"):
            header["FIELDS" if name == "COLUMNS" else name] = values
    return header


def _fields(header: dict[str, list[str]]) -> list[tuple[str, str, int]]:
    """Name, NumPy type code and count of each field."""
    names, kinds, sizes = (header.get(key, []) for key in ("FIELDS", "TYPE", "SIZE"))
    counts = header.get("COUNT", ["1"] * len(names))
    fields = []
    for number, (name, kind, size, count) in enumerate(zip(names, kinds, sizes, counts, strict=True)):
        if not (size.isdecimal() and int(size) in _SIZES.get(kind, ()) and count.isdecimal() and int(count)):
            raise ValueError(f"field {name[:80]} of type {kind[:8]}, size {size[:8]}, count {count[:8]}")
        # Several fields may be padding; rows need distinct names.
        own_name = f"{_PADDING}{number}" if name == _PADDING else name
        fields.append((own_name, f"<{_KINDS[kind]}{size}", int(count)))
    return fields


def _count(header: dict[str, list[str]]) -> int:
    """Number of points; given as columns times rows, as a number, or both."""
    reported = {key: header[key] for key in ("WIDTH", "HEIGHT", "POINTS") if key in header}
    if not all(len(words) == 1 and words[0].isdecimal() for words in reported.values()):
        raise ValueError(f"{reported} points"[:200])
    numbers = {key: int(words[0]) for key, words in reported.items()}
    count = numbers.get("POINTS", numbers.get("WIDTH", 0) * numbers.get("HEIGHT", 1))
    if count != numbers.get("WIDTH", count) * numbers.get("HEIGHT", 1):
        raise ValueError(f"{numbers} do not agree")
    return count


def _without_padding(columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The fields without padding."""
    return {name: values for name, values in columns.items() if not name.startswith(_PADDING)}


def _compressed(stream: BinaryIO, fields: list[tuple[str, str, int]], count: int) -> dict[str, NDArray[Any]]:
    """Read LZF-compressed data, stored field by field."""
    packed_bytes, whole_bytes = (
        int(size) for size in binary_rows(stream, [("size", "<u4", 2)], 1)["size"][0]
    )
    check_bytes(stream, packed_bytes)
    expected = count * row_bytes(fields)
    if whole_bytes != expected or whole_bytes > min(LARGEST_BYTES, _MOST_GROWTH * packed_bytes):
        raise ValueError(f"{whole_bytes} bytes in {packed_bytes} for {expected} bytes of points")
    data = np.empty(whole_bytes, np.uint8)
    if not _unpack(np.frombuffer(stream.read(packed_bytes), np.uint8), data):
        raise ValueError("damaged compression")
    columns, start = {}, 0
    for name, code, width in fields:
        bytes_ = np.dtype(code).itemsize * width * count
        values = data[start : start + bytes_].view(code)
        columns[name] = values if width == 1 else values.reshape(count, width)
        start += bytes_
    return columns


@kernel
def _unpack(packed: NDArray[np.uint8], data: NDArray[np.uint8]) -> bool:
    """Decompress LZF (M. Lehmann's liblzf) to an array of the right length; returns whether it fits."""
    read = written = np.int64(0)
    while read < packed.size:
        control = np.int64(packed[read])
        read += 1
        if control < 32:  # control + 1 literal bytes
            length = control + 1
            if read + length > packed.size or written + length > data.size:
                return False
            for k in range(length):
                data[written + k] = packed[read + k]
            read += length
        else:  # earlier bytes, which may overlap with the output
            length = control >> 5
            if length == 7 and read < packed.size:
                length += np.int64(packed[read])
                read += 1
            if read >= packed.size:
                return False
            length += 2
            start = written - ((control & 31) << 8) - np.int64(packed[read]) - 1
            read += 1
            if start < 0 or written + length > data.size:
                return False
            for k in range(length):
                data[written + k] = data[start + k]
        written += length
    return bool(written == data.size)
