"""Points of LAS and LAZ files, by laspy and lazrs (the extra 'las').

ASPRS 2019, "LAS Specification 1.4 - R15".
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import LARGEST_BYTES

NO_LASPY = "clouds in LAS or LAZ, which the extra reads: pip install 'scanweave[las]'"


def read_las_points(path: Path) -> dict[str, NDArray[Any]]:
    """Columns x, y and z in metres, scaled and shifted, and the times of points where there are any.

    Raises
    ------
    OSError, ValueError
        The file, or what is in it, cannot be read.
    """
    try:
        import laspy
    except ImportError as error:
        raise ValueError(NO_LASPY) from error
    try:
        with laspy.open(path) as file:
            size = file.header.point_count * file.header.point_format.size
            if not 0 < size <= LARGEST_BYTES:
                raise ValueError(f"{file.header.point_count} points")
            rows = file.read()
            if len(rows.points) != file.header.point_count:
                raise ValueError(f"{len(rows.points)} of {file.header.point_count} points")
        with np.errstate(invalid="ignore", over="ignore"):
            columns = {axis: np.asarray(getattr(rows, axis), dtype=np.float64) for axis in "xyz"}
        if "gps_time" in rows.point_format.dimension_names:
            columns["timestamp"] = np.asarray(rows.gps_time)
    except laspy.errors.LaspyException as error:
        raise ValueError(str(error)) from error
    except (struct.error, TypeError, OverflowError, EOFError, RuntimeError, MemoryError) as error:
        raise ValueError(f"damaged: {error}") from error
    return columns
