"""Cloud of a 3D lidar's map for other programs, whole or in tiles; removed points in a file beside it.

LAS 1.4 holds points in millimetres, colours, intensities and the ground; binary PCD of the Point Cloud
Library position, normal, colour, ground and intensity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam.errors import MapFileError, needs
from slam.mapping.dense_map import ColoredCloud
from slam.measurements import BoolArray, Float32Array
from slam.storage.files import filling, make_folder, replacing
from slam.storage.ply import write_cloud_ply

_TILE_M = 50.0
TILES = "-tiles"
CLOUD_FORMATS = ("las", "pcd", *(name + TILES for name in ("las", "pcd", "ply")))

_WITH_COLOURS = 7  # point format
_OTHER, _GROUND = 1, 2  # classes of ASPRS: unclassified, ground
_STEP_M = 0.001
_COLOUR_STEP = 257  # colours of 16 bits
_MOST = 65535.0

_NAMES = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
_FIELDS = (*_NAMES, "rgb", "label")
_ROW = np.dtype([*((name, "<f4") for name in _NAMES), ("rgb", "<u4"), ("label", "<u4")])
_INTENSITY = "intensity"
_INTENSITY_ROW = np.dtype([*_ROW.descr, (_INTENSITY, "<f4")])


@dataclass(frozen=True, slots=True)
class LidarCloud:
    """Points of the clouds to write.

    Attributes
    ----------
    stays
        Static points of the map, in parts.
    is_ground
        Function of points (N, 3): which (N,) are the ground.
    gone
        Removed moving points, in parts; None if there are none.
    """

    stays: Iterable[ColoredCloud]
    is_ground: Callable[[Float32Array], BoolArray]
    gone: Iterable[ColoredCloud] | None


def write_lidar_cloud(path: Path, cloud: LidarCloud) -> list[Path]:
    """Write ``path``, a PLY file, and removed points beside it, as ``cloud_passed_by.ply`` for ``cloud.ply``.

    Raises
    ------
    MapFileError
        If the map shows nothing, or a file cannot be written.
    """
    write_cloud_ply(path, cloud.stays)
    passed_by = path.with_name(f"{path.stem}_passed_by.ply")
    if cloud.gone is None:
        passed_by.unlink(missing_ok=True)  # of an earlier map
        return [path]
    write_cloud_ply(passed_by, cloud.gone)
    return [path, passed_by]


def export_cloud(format_: str, out: Path, cloud: LidarCloud) -> list[Path]:
    """Write static points in one of `CLOUD_FORMATS`: a file, or a folder of tiles of 50 m.

    A tile is named after its lower left corner in metres.

    Raises
    ------
    LibraryError
        If LAS is requested without laspy.
    MapFileError
        If the map shows nothing, or a file cannot be written.
    """
    name = format_.removesuffix(TILES)
    write: Callable[[Path, ColoredCloud, BoolArray], None] = {
        "las": write_las,
        "pcd": write_pcd,
        "ply": lambda path, part, _: write_cloud_ply(path, [part]),
    }[name]
    points = _joined(cloud.stays)
    if not len(points.points_map):
        raise MapFileError(f"there are no points to write to {out}; the map shows none")
    if name == "las" and points.intensities is not None:
        points = replace(points, intensities=sixteen_bits(points.intensities))
    is_ground = cloud.is_ground(points.points_map)
    if name == format_:
        if out.is_dir() or not out.suffix:
            make_folder(out)
            out /= f"cloud.{name}"
        write(out, points, is_ground)
        return [out]
    corners = np.floor(points.points_map[:, :2] / _TILE_M).astype(np.int64)
    written = []
    with filling(out):
        for corner in np.unique(corners, axis=0):
            inside = (corners == corner).all(axis=1)
            x, y = (corner * round(_TILE_M)).tolist()
            written.append(out / f"{x}_{y}.{name}")
            write(written[-1], _part(points, inside), is_ground[inside])
    return written


def _joined(parts: Iterable[ColoredCloud]) -> ColoredCloud:
    """Return all parts as one."""
    nothing = ColoredCloud(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros((0, 3), np.float32)
    )
    clouds = [nothing, *parts]
    intensities = [part.intensities for part in clouds if part.intensities is not None]
    return ColoredCloud(
        np.concatenate([part.points_map for part in clouds]),
        np.concatenate([part.colors for part in clouds]),
        np.concatenate([part.normals_map for part in clouds]),
        np.concatenate(intensities) if intensities else None,
    )


def _part(cloud: ColoredCloud, chosen: BoolArray) -> ColoredCloud:
    """Return some of the points."""
    return replace(
        cloud,
        points_map=cloud.points_map[chosen],
        colors=cloud.colors[chosen],
        normals_map=cloud.normals_map[chosen],
        intensities=None if cloud.intensities is None else cloud.intensities[chosen],
    )


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
    with needs("LAS needs laspy", "las"):
        import laspy
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
    rows["label"] = np.where(is_ground, _GROUND, _OTHER)
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
