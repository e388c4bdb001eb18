"""Small PCD and PLY files of points, written apart from the readers that they test."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray[np.generic]]
PLY_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint"} | {
    "f4": "float",
    "f8": "double",
}


def rows_of(columns: Columns, order: str = "<") -> NDArray[np.void]:
    """Rows of a file from (N,) or (N, C) columns."""
    first = next(iter(columns.values()))
    kinds = [(name, order + values.dtype.str[1:], values.shape[1:]) for name, values in columns.items()]
    rows = np.empty(len(first), kinds)
    for name, values in columns.items():
        rows[name] = values
    return rows


def text_of(columns: Columns) -> bytes:
    """A line a point."""
    table = np.column_stack([values.astype(str) for values in columns.values()])
    return "".join(" ".join(row) + "\n" for row in table).encode()


def write_pcd(path: Path, columns: Columns, form: str = "binary") -> Path:
    """As the Point Cloud Library writes them."""
    values = list(columns.values())
    count = len(values[0])
    kinds = {"f": "F", "i": "I", "u": "U"}
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(columns),
        "SIZE " + " ".join(str(v.dtype.itemsize) for v in values),
        "TYPE " + " ".join(kinds[v.dtype.kind] for v in values),
        "COUNT " + " ".join(str(v[0].size) for v in values),
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {form}\n",
    ]
    if form == "ascii":
        body = text_of(columns)
    elif form == "binary":
        body = rows_of(columns).tobytes()
    else:
        plain = b"".join(v.astype(v.dtype.newbyteorder("<")).tobytes() for v in values)
        packed = lzf(plain)
        body = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    path.write_bytes("\n".join(lines).encode() + body)
    return path


def write_ply(path: Path, columns: Columns, form: str = "binary_little_endian") -> Path:
    """With an element before the points and faces behind them."""
    properties = "".join(f"property {PLY_NAMES[v.dtype.str[1:]]} {name}\n" for name, v in columns.items())
    header = (
        f"ply\nformat {form} 1.0\ncomment \xb5m are not metres\nelement camera 2\nproperty short gain\n"
        f"element vertex {len(next(iter(columns.values())))}\n{properties}"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if form == "ascii":
        body = b"7\n8\n" + text_of(columns) + b"3 0 1 2\n"
    else:
        order = "<" if "little" in form else ">"
        face = b"\3" + np.array([0, 1, 2], order + "i4").tobytes()
        body = np.array([7, 8], order + "i2").tobytes() + rows_of(columns, order).tobytes() + face
    path.write_bytes(header.encode("latin-1") + body)
    return path


def lzf(plain: bytes) -> bytes:
    """Compressed by LZF, greedily."""
    packed, fresh, seen, at = bytearray(), bytearray(), dict[bytes, int](), 0

    def flush() -> None:
        for start in range(0, len(fresh), 32):
            part = fresh[start : start + 32]
            packed.extend(bytes([len(part) - 1]) + part)
        fresh.clear()

    while at < len(plain):
        before = seen.get(plain[at : at + 3])
        seen[plain[at : at + 3]] = at
        length = 0
        if before is not None and at - before <= 8192 and at + 3 <= len(plain):
            while length < 264 and at + length < len(plain) and plain[before + length] == plain[at + length]:
                length += 1
        if length < 3:
            fresh.append(plain[at])
            at += 1
            continue
        flush()
        back = at - before - 1
        packed.append(min(length - 2, 7) << 5 | back >> 8)
        if length - 2 >= 7:
            packed.append(length - 2 - 7)
        packed.append(back & 255)
        at += length
    flush()
    return bytes(packed)
