"""Clouds as LAS 1.4 for survey programs: points in millimetres, colours, intensities, the ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import LibraryError
from slam.mapping.dense_map import ColoredCloud
from slam.measurements import BoolArray, Float32Array
from slam.storage.files import replacing

_WITH_COLOURS = 7  # point format
_OTHER, _GROUND = 1, 2  # classes of ASPRS: unclassified, ground
_STEP_M = 0.001
_COLOUR_STEP = 257  # colours of 16 bits
_MOST = 65535.0


def write_las(path: Path, cloud: ColoredCloud, is_ground: BoolArray) -> None:
    """Write a cloud of some points in the map frame, whole or not at all.

    Parameters
    ----------
    is_ground
        (N,) of the points, whose intensities are of 16 bits, see `sixteen_bits`.

    Raises
    ------
    LibraryError
        If laspy is not installed.
    MapFileError
        If the file cannot be written.
    """
    try:
        import laspy
    except ImportError as error:
        raise LibraryError("LAS needs laspy: pip install '.[las]'") from error
    header = laspy.LasHeader(point_format=_WITH_COLOURS, version="1.4")
    header.scales = np.full(3, _STEP_M)
    header.offsets = np.floor(cloud.points_map.min(axis=0).astype(np.float64))
    # The date of writing would change the file of the same map.
    header.creation_date = None
    rows = laspy.LasData(header)
    rows.x, rows.y, rows.z = cloud.points_map.T.astype(np.float64)
    rows.red, rows.green, rows.blue = cloud.colors.T.astype(np.uint16) * _COLOUR_STEP
    if cloud.intensities is not None:
        rows.intensity = np.rint(np.nan_to_num(cloud.intensities)).astype(np.uint16)
    rows.classification = np.where(is_ground, _GROUND, _OTHER).astype(np.uint8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        rows.write(file, do_compress=False)


def sixteen_bits(intensities: Float32Array) -> Float32Array:
    """Scale to the sensor's full range over 16 bits, as the format requires (ASPRS 2019, Sec. 2.6).

    The range is assumed to be 0 to 1, eight bits or sixteen: the narrowest that contains all values.
    """
    greatest = float(np.nanmax(intensities, initial=0.0))
    full = next((top for top in (1.0, _MOST / _COLOUR_STEP, _MOST) if greatest <= top), greatest)
    return (intensities.clip(0.0) * (_MOST / full)).astype(np.float32)
