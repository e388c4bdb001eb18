"""Cloud of a 3D lidar's map for other programs, whole or in tiles; removed points in a file beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam.errors import MapFileError
from slam.mapping.dense_map import ColoredCloud
from slam.measurements import BoolArray, Float32Array
from slam.storage.files import filling, make_folder
from slam.storage.las import sixteen_bits, write_las
from slam.storage.pcd import write_pcd
from slam.storage.ply import write_cloud_ply

_TILE_M = 50.0
_WRITERS: dict[str, Callable[[Path, ColoredCloud, BoolArray], None]] = {
    "las": write_las,
    "pcd": write_pcd,
    "ply": lambda path, cloud, _: write_cloud_ply(path, [cloud]),
}
TILES = "-tiles"
CLOUD_FORMATS = ("las", "pcd", *(name + TILES for name in _WRITERS))


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
    write = _WRITERS[name]
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
