"""Meshes and point clouds as binary PLY, for MeshLab, CloudCompare, Blender and Open3D."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.ply_points import read_ply_points
from slam.errors import MapFileError
from slam.mapping.dense_map import ColoredCloud, ColoredMesh, Colors
from slam.measurements import Float32Array
from slam.storage.files import replacing

_POSITION, _NORMAL, _COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
_VERTEX = np.dtype([(name, "<f4") for name in _POSITION + _NORMAL] + [(name, "u1") for name in _COLOR])
_VERTEX_LINES = [f"property float {name}" for name in _POSITION + _NORMAL] + [
    f"property uchar {name}" for name in _COLOR
]
_INTENSITY = "intensity"
_FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])
_FACE_LINE = "property list uchar int vertex_indices"


def write_mesh_ply(path: Path, mesh: ColoredMesh) -> None:
    """Write a mesh with normals and colours of its vertices, whole or not at all.

    Raises
    ------
    MapFileError
        If the mesh is empty or the file cannot be written.
    """
    _refuse_nothing(path, len(mesh.faces), "triangles")
    faces = np.empty(len(mesh.faces), _FACE)
    faces["count"], faces["vertex_indices"] = 3, mesh.faces
    vertices = _vertices(mesh.vertices_map, mesh.normals_map, mesh.colors)
    _write(path, {"vertex": (_VERTEX_LINES, vertices), "face": ([_FACE_LINE], faces)})


def write_cloud_ply(path: Path, parts: Iterable[ColoredCloud]) -> None:
    """Write the parts of a point cloud with normals and colours, whole or not at all; one is held at a time.

    Where they have intensities, so has the file.

    Raises
    ------
    MapFileError
        If the cloud is empty or the file cannot be written.
    """
    count, lines = 0, _VERTEX_LINES
    with replacing(path) as temporary, tempfile.TemporaryFile(prefix="scanweave-cloud-") as body:
        for part in parts:
            rows = _vertices(part.points_map, part.normals_map, part.colors, part.intensities)
            if part.intensities is not None:
                lines = [*_VERTEX_LINES, f"property float {_INTENSITY}"]
            body.write(rows.data)
            count += len(part.points_map)
        _refuse_nothing(path, count, "points")
        body.seek(0)
        with temporary.open("wb") as stream:
            stream.write(_header({"vertex": (lines, count)}))
            shutil.copyfileobj(body, stream)


def read_cloud_ply(path: Path) -> ColoredCloud:
    """Read the points of a file that has their colours and normals; of a mesh they are its vertices.

    Raises
    ------
    MapFileError
        If the file cannot be read, is cut off, or lacks one of them.
    """
    try:
        columns = read_ply_points(path)
        points, normals, colors = (
            np.column_stack([columns[name] for name in names]) for names in (_POSITION, _NORMAL, _COLOR)
        )
        intensities = columns.get(_INTENSITY)
        if colors.dtype != np.uint8:
            raise ValueError(f"colours of type {colors.dtype}, not uchar")
    except OSError as error:
        raise MapFileError(f"cannot read {path}: {error.strerror or error}") from error
    except KeyError as error:
        raise MapFileError(f"{path}: points without {error}; wanted are normals and colours") from error
    except ValueError as error:
        raise MapFileError(f"{path}: {error}; save the map again") from error
    values = None if intensities is None else intensities.astype(np.float32)
    return ColoredCloud(points.astype(np.float32), colors, normals.astype(np.float32), values)


def _vertices(
    points: Float32Array, normals: Float32Array, colors: Colors, intensities: Float32Array | None = None
) -> NDArray[np.void]:
    """Points as rows of a file."""
    last = [] if intensities is None else [(_INTENSITY, "<f4")]
    rows = np.empty(len(points), [*_VERTEX.descr, *last])
    if intensities is not None:
        rows[_INTENSITY] = intensities
    for names, values in ((_POSITION, points), (_NORMAL, normals), (_COLOR, colors)):
        for axis, name in enumerate(names):
            rows[name] = values[:, axis]
    return rows


def _write(path: Path, elements: dict[str, tuple[list[str], NDArray[Any]]]) -> None:
    """Write rows of elements, each under the lines that name its properties."""
    with replacing(path) as temporary, temporary.open("wb") as stream:
        stream.write(_header({name: (lines, len(rows)) for name, (lines, rows) in elements.items()}))
        for _, rows in elements.values():
            stream.write(rows.data)


def _header(elements: dict[str, tuple[list[str], int]]) -> bytes:
    """The header: the properties of the elements, and how many there are."""
    lines = ["ply", "format binary_little_endian 1.0", "comment Scanweave: metres, map frame"]
    for name, (properties, count) in elements.items():
        lines += [f"element {name} {count}", *properties]
    return "\n".join([*lines, "end_header\n"]).encode("ascii")


def _refuse_nothing(path: Path, count: int, what: str) -> None:
    """A file without content would be of no use to anybody."""
    if count == 0:
        raise MapFileError(
            f"no {what} for {path}: no surface was seen often enough; lower minimum_views or give more frames"
        )
