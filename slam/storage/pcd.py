"""Clouds as binary PCD of the Point Cloud Library: position, normal, colour, ground, intensity."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.mapping.dense_map import ColoredCloud
from slam.measurements import BoolArray
from slam.storage.files import replacing

_NAMES = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
_FIELDS = (*_NAMES, "rgb", "label")
_ROW = np.dtype([*((name, "<f4") for name in _NAMES), ("rgb", "<u4"), ("label", "<u4")])
_INTENSITY = "intensity"
_INTENSITY_ROW = np.dtype([*_ROW.descr, (_INTENSITY, "<f4")])
_GROUND = 2  # as in LAS; else 1


def write_pcd(path: Path, cloud: ColoredCloud, is_ground: BoolArray) -> None:
    """Write a cloud of some points in the map frame, whole or not at all.

    Parameters
    ----------
    is_ground
        (N,) of the points.

    Raises
    ------
    MapFileError
        If the file cannot be written.
    """
    count, intensities = len(cloud.points_map), cloud.intensities
    fields, row = (_FIELDS, _ROW) if intensities is None else ((*_FIELDS, _INTENSITY), _INTENSITY_ROW)
    rows = np.empty(count, row)
    for name, values in zip(_NAMES, np.hstack([cloud.points_map, cloud.normals_map]).T, strict=True):
        rows[name] = values
    red, green, blue = cloud.colors.T.astype(np.uint32)
    rows["rgb"] = red << 16 | green << 8 | blue
    rows["label"] = np.where(is_ground, _GROUND, 1)
    if intensities is not None:
        rows[_INTENSITY] = intensities
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(fields)}",
        f"SIZE {' '.join(['4'] * len(fields))}",
        f"TYPE {' '.join(row[name].kind.upper() for name in fields)}",
        f"COUNT {' '.join(['1'] * len(fields))}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    ]
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write("".join(f"{line}\n" for line in header).encode("ascii"))
        file.write(rows.tobytes())
