"""Detects the row format of ``.bin`` clouds: floats or doubles, three to six per point."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fusion.estimation import FEWEST
from slam.datasets.cloud_files import KITTI_ROWS, Rows, are_no_readings, row_of
from slam.errors import DatasetError
from slam.measurements import FloatArray

_FIELDS = ("x", "y", "z", "intensity", "fifth", "sixth")
_FEWEST_FIELDS = 3
_FILES, _VALUES = 5, 60_000  # number of files examined, and values per file


def rows_of(files: Sequence[Path]) -> Rows:
    """Return the row type of clouds by several files, KITTI's if unclear; DatasetError if none fits."""
    files = [path for path in files if is_bin(path) and path.is_file()]
    looked_at = files[:: max(1, len(files) // _FILES)][:_FILES]
    for kind in ("f4", "f8"):
        read = [_values(path, kind) for path in looked_at]
        values = [row for row in read if len(row) >= FEWEST * len(_FIELDS)]
        if not values:
            return KITTI_ROWS
        if 2 * sum(map(are_no_readings, values)) < len(values):
            fields = ", ".join(f"{name} {kind}" for name in _FIELDS[: _period(values)])
            return Rows(row_of(fields))
    raise DatasetError(
        f"{looked_at[0].name} and others hold no rows of {_FEWEST_FIELDS} to {len(_FIELDS)} floats or "
        "doubles, x, y and z first; convert them to .pcd or .ply, which name their fields"
    )


def is_bin(path: Path) -> bool:
    """Whether a file name stands for rows without header."""
    return path.suffix.lower() == ".bin"


def _values(path: Path, kind: str) -> FloatArray:
    """The first numbers of a file; none if it cannot be read, which is counted later."""
    try:
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            return np.fromfile(path, f"<{kind}", _VALUES).astype(np.float64)
    except OSError:
        return np.zeros(0)


def _period(values: Sequence[FloatArray]) -> int:
    """The number of values per row: values of one field differ least from each other.

    This is true for points in any order: the expected distance between samples of two distributions is never
    less than the mean of the expected distances within each (energy distance, Szekely 2013).
    """
    scaled = [np.arcsinh(np.nan_to_num(row, posinf=0.0, neginf=0.0)) for row in values]
    counts = range(_FEWEST_FIELDS, len(_FIELDS) + 1)
    diffs = [np.mean([np.abs(row[count:] - row[:-count]).mean() for row in scaled]) for count in counts]
    good = [count for count, row in zip(counts, diffs, strict=True) if row <= min(diffs) * (1 + 1 / FEWEST)]
    return good[0]
