"""Clouds of an Ouster OS1-64 that keep its order but not its times: 1024 columns of 64 rows a turn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from slam.datasets.cloud_files import Parsed

_ROWS, _COLUMNS, _TURN_S = 64, 1024, 0.1
_TIMES = ("t", "time", "timestamp")


def with_column_times(parse: Callable[[Path], Parsed]) -> Callable[[Path], Parsed]:
    """A parser that gives the points of a whole turn the times of their columns; others are left without."""

    def parsed(path: Path) -> Parsed:
        points, fields = parse(path)
        if len(points) == _ROWS * _COLUMNS and not any(name in fields for name in _TIMES):
            fields["t"] = np.arange(_ROWS * _COLUMNS) // _ROWS * (_TURN_S / _COLUMNS)
        return points, fields

    return parsed
