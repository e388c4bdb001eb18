"""Clouds as LAS 1.4, which survey programs open: points in whole millimetres, colours, ground told apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import LibraryError
from slam.mapping.dense_map import ColoredCloud
from slam.measurements import BoolArray
from slam.storage.files import replacing

_WITH_COLOURS = 7  # point format
_OTHER, _GROUND = 1, 2  # classes of ASPRS: unclassified, ground
_STEP_M = 0.001
_COLOUR_STEP = 257  # colours of 16 bits


def write_las(path: Path, cloud: ColoredCloud, is_ground: BoolArray) -> None:
    """Write a cloud of some points in the map frame, whole or not at all.

    Parameters
    ----------
    is_ground
        (N,) of the points.

    Raises
    ------
    LibraryError
        Where laspy is not installed.
    MapFileError
        Where the file cannot be written.
    """
    try:
        import laspy
    except ImportError as error:
        raise LibraryError("LAS needs laspy: pip install '.[las]'") from error
    header = laspy.LasHeader(point_format=_WITH_COLOURS, version="1.4")
    header.scales = np.full(3, _STEP_M)
    header.offsets = np.floor(cloud.points_map.min(axis=0).astype(np.float64))
    # The day of writing would make the same map differ.
    header.creation_date = None
    rows = laspy.LasData(header)
    rows.x, rows.y, rows.z = cloud.points_map.T.astype(np.float64)
    rows.red, rows.green, rows.blue = cloud.colors.T.astype(np.uint16) * _COLOUR_STEP
    rows.classification = np.where(is_ground, _GROUND, _OTHER).astype(np.uint8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        rows.write(file, do_compress=False)
