"""Reads points of PLY files, text or binary; faces and later elements are ignored."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from slam.datasets.point_rows import binary_rows, header_line, text_rows

_TYPES = {"char": "i1", "short": "i2", "int": "i4", "float": "f4"}
_TYPES |= {"uchar": "u1", "ushort": "u2", "uint": "u4", "double": "f8"}
_TYPES |= {np.dtype(code).name: code for code in _TYPES.values()}  # int8 to float64
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_LIST = "list"


def read_ply_points(path: Path) -> dict[str, NDArray[Any]]:
    """The properties of the element ``vertex`` by name, (N,) each.

    ValueError if the file is damaged, truncated, or no PLY file; OSError if it cannot be read.
    """
    with path.open("rb") as stream:
        form, elements = _header(stream)
        read = text_rows if form == "ascii" else binary_rows
        for element, count, properties in elements:
            if any(kind == _LIST for _, kind in properties):
                raise ValueError(f"lists ({element}) before the points")
            fields = [(name, _ORDERS[form] + _TYPES[kind], 1) for name, kind in properties]
            rows = read(stream, fields, count)
            if element == "vertex":
                return {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name, _ in properties}
    raise ValueError("no points")


def _header(stream: BinaryIO) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]]]:
    """The format, and the name, count and properties (name and type) of each element."""
    if header_line(stream) != "ply":
        raise ValueError("no PLY file")
    form, elements = "", list[tuple[str, int, list[tuple[str, str]]]]()
    while (line := header_line(stream)) != "end_header":
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, "1.0"] if name in _ORDERS:
                form = name
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", "list", _, _, name] if elements:
                elements[-1][2].append((name, _LIST))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1][2].append((name, kind))
            case _:
                raise ValueError(f"'{line[:80]}' in the header")
    if not form:
        raise ValueError("no format in the header")
    return form, elements
