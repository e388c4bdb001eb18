"""Points as rows of numbers: text (.xyz, .txt, .csv), and arrays of NumPy (.npy)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST

_PLAIN = ("x", "y", "z", "intensity")
_MOST_COLUMNS = 16  # beyond, an array is an image
_FIRST_BYTES = 1 << 14


def read_text_points(path: Path) -> dict[str, NDArray[Any]]:
    """Return columns by name; without a line of names x, y, z, and of four columns intensity.

    Blanks, commas or semicolons separate numbers; a first line of names or of a count is no point.

    Raises
    ------
    OSError, ValueError
        If the file cannot be read, or a line has other numbers than the first.
    """
    return _columns(path.read_bytes())


def _columns(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the columns of a text."""
    lines = content.translate(bytes.maketrans(b",;", b"  ")).splitlines()
    first = lines[0].decode("ascii", "replace").strip(" /#").lower().split() if lines else []
    head = len(first) < len("xyz") or {*"xyz"} <= {*first}
    rest = [line for line in lines[head:] if line.strip() and not line.lstrip().startswith((b"#", b"//"))]
    rows = np.loadtxt(rest, np.float64, comments=None, ndmin=2) if rest else np.empty((0, 3))
    return _named(rows, first if {*"xyz"} <= {*first} else ())


def read_npy_points(path: Path) -> dict[str, NDArray[Any]]:
    """Return columns of an (N, C) or (H, W, C) array, or of records by name; raises as `read_text_points`."""
    array = load_array(path)
    if array.dtype.names:
        return {name: np.array(array[name]).ravel() for name in array.dtype.names}
    if array.ndim not in (2, 3) or array.dtype.kind not in "iuf":
        raise ValueError(f"an array of {array.dtype}{list(array.shape)}, not (N, 3) numbers")
    return _named(np.array(array).reshape(-1, array.shape[-1]), ())


def load_array(source: Path | io.BytesIO) -> NDArray[Any]:
    """Return an array that NumPy wrote, not of objects; ValueError if damaged, OSError if unreadable."""
    mapped = isinstance(source, Path)  # so that no more than the file has is allocated
    try:
        return np.asarray(np.load(source, mmap_mode="r" if mapped else None, allow_pickle=False))
    except (EOFError, SyntaxError, MemoryError, TokenError) as error:
        raise ValueError(f"damaged: {error}") from error


def _named(rows: NDArray[Any], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return (N, C) rows as columns, named as a header or by their number."""
    if not len("xyz") <= rows.shape[1] <= _MOST_COLUMNS or len(names) not in (0, rows.shape[1]):
        raise ValueError(f"{rows.shape[1]} columns, not x, y, z and at most {_MOST_COLUMNS - 3} more")
    if not names:
        names = _PLAIN if rows.shape[1] == len(_PLAIN) else (*"xyz", *map(str, range(3, rows.shape[1])))
    return dict(zip(names, rows.T, strict=False))


def holds_points(path: Path) -> bool:
    """Return whether a file has more rows of points than a pose or a label file; of a text its beginning."""
    try:
        if path.suffix.lower() == ".npy":
            return len(read_npy_points(path)["x"]) > FEWEST
        with path.open("rb") as stream:
            head = b"".join(islice(stream, 2 * FEWEST))[:_FIRST_BYTES]
        return len(_columns(head[: head.rfind(b"\n")])["x"]) > FEWEST
    except (OSError, ValueError, KeyError):
        return False
