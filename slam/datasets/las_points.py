"""Reads points of LAS and LAZ files with laspy and lazrs (the extra 'las').

ASPRS 2019, "LAS Specification 1.4 - R15".
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import LARGEST_BYTES

NO_LASPY = "clouds in LAS or LAZ; to read them: pip install 'scanweave[las]'"


def read_las_points(path: Path) -> dict[str, NDArray[Any]]:
    """Columns x, y and z in metres, scaled and shifted, and times and intensities if there are any.

    Raises
    ------
    OSError, ValueError
        The file or its contents cannot be read.
    """
    try:
        import laspy
    except ImportError as error:
        raise ValueError(NO_LASPY) from error
    try:
        # lazrs' own threads do not survive a fork; the child would wait for them forever.
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as file:
            size = file.header.point_count * file.header.point_format.size
            if not 0 < size <= LARGEST_BYTES:
                raise ValueError(f"{file.header.point_count} points")
            if file.header.are_points_compressed:
                _ask_for_chunks(path, file.header.offset_to_point_data, file.header.point_count)
            rows = file.read()
            if len(rows.points) != file.header.point_count:
                raise ValueError(f"{len(rows.points)} of {file.header.point_count} points")
        with np.errstate(invalid="ignore", over="ignore"):
            columns = {axis: np.asarray(getattr(rows, axis), dtype=np.float64) for axis in "xyz"}
        if "gps_time" in rows.point_format.dimension_names:
            columns["timestamp"] = np.asarray(rows.gps_time)
        columns["intensity"] = np.asarray(rows.intensity)
    except laspy.errors.LaspyException as error:
        raise ValueError(str(error)) from error
    except (struct.error, TypeError, OverflowError, EOFError, RuntimeError, MemoryError) as error:
        raise ValueError(f"damaged: {error}") from error
    return columns


def _ask_for_chunks(path: Path, begins: int, points: int) -> None:
    """Reject a table of more chunks than points: lazrs allocates as many as it says (Isenburg 2013)."""
    with path.open("rb") as file:
        file.seek(begins)
        (table,) = struct.unpack("<q", file.read(8))
        if table == -1:  # written as a stream: the offset of the table is at the end
            file.seek(-8, os.SEEK_END)
            (table,) = struct.unpack("<q", file.read(8))
        file.seek(table)
        _, chunks = struct.unpack("<2I", file.read(8))
    if chunks > points:
        raise ValueError(f"{chunks} chunks of {points} points")
