"""Meshes and point clouds as binary PLY, as MeshLab, CloudCompare, Blender and Open3D read it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import MapFileError
from slam.mapping.dense_map import ColoredCloud, ColoredMesh, Colors
from slam.open3d_library import load_open3d
from slam.storage.files import replacing

_HEADER_BYTES = 4096
_PROPERTY_BYTES = {
    "double": 8,
    "float": 4,
    "int": 4,
    "uint": 4,
    "short": 2,
    "ushort": 2,
    "char": 1,
    "uchar": 1,
}


def write_mesh_ply(path: Path, mesh: ColoredMesh) -> None:
    """Write a mesh with normals and colours of its vertices, whole or not at all.

    Raises
    ------
    MapFileError
        Where the mesh is empty or the file cannot be written.
    """
    open3d = load_open3d()

    _refuse_nothing(path, len(mesh.faces), "triangles")
    tensor = open3d.core.Tensor.from_numpy
    out = open3d.t.geometry.TriangleMesh(tensor(mesh.vertices_map), tensor(mesh.faces))
    out.vertex.normals = tensor(mesh.normals_map)
    # Open3D takes a mesh's colours as 0..1 whatever their type: as bytes, all that is not black turns white.
    out.vertex.colors = tensor(mesh.colors.astype(np.float32) / np.float32(255.0))
    _write(path, out, open3d.t.io.write_triangle_mesh)


def write_cloud_ply(path: Path, cloud: ColoredCloud) -> None:
    """Write a point cloud with normals and colours, whole or not at all.

    Raises
    ------
    MapFileError
        Where the cloud is empty or the file cannot be written.
    """
    open3d = load_open3d()

    _refuse_nothing(path, len(cloud.points_map), "points")
    tensor = open3d.core.Tensor.from_numpy
    out = open3d.t.geometry.PointCloud(tensor(cloud.points_map))
    out.point.normals = tensor(cloud.normals_map)
    out.point.colors = tensor(cloud.colors)
    _write(path, out, open3d.t.io.write_point_cloud)


def read_mesh_ply(path: Path) -> ColoredMesh:
    """Read a binary mesh of triangles that has colours and normals.

    Raises
    ------
    MapFileError
        Where the file cannot be read, is cut off, or lacks one of them.
    """
    open3d = load_open3d()

    _check_whole(path)
    mesh = open3d.t.io.read_triangle_mesh(path)
    if mesh.is_empty() or "colors" not in mesh.vertex or "normals" not in mesh.vertex:
        raise MapFileError(f"{path}: no mesh with colours and normals; is it a point cloud?")
    faces = mesh.triangle.indices.numpy().astype(np.int32)
    vertices_map, normals_map = (mesh.vertex[name].numpy().copy() for name in ("positions", "normals"))
    return ColoredMesh(vertices_map, _as_bytes(mesh.vertex.colors), normals_map, faces)


def read_cloud_ply(path: Path) -> ColoredCloud:
    """Read a binary point cloud that has colours and normals.

    Raises
    ------
    MapFileError
        Where the file cannot be read, is cut off, or lacks one of them.
    """
    open3d = load_open3d()

    _check_whole(path)
    cloud = open3d.t.io.read_point_cloud(path)
    if cloud.is_empty() or "colors" not in cloud.point or "normals" not in cloud.point:
        raise MapFileError(f"{path}: no points with colours and normals")
    points_map, normals_map = (
        cloud.point[name].numpy().astype(np.float32) for name in ("positions", "normals")
    )
    return ColoredCloud(points_map, _as_bytes(cloud.point.colors), normals_map)


def _write(path: Path, geometry: Any, writer: Any) -> None:
    """Write an Open3D geometry; the file is measured, because Open3D reports success on a full disk too."""
    with replacing(path) as temporary:
        if not writer(temporary, geometry):
            raise MapFileError(f"cannot write {path}; check the folder and its free space")
        _check_whole(temporary)


def _refuse_nothing(path: Path, count: int, what: str) -> None:
    """Open3D writes no file without content, and nobody could use one."""
    if count == 0:
        raise MapFileError(
            f"no {what} for {path}: no surface was seen often enough; lower minimum_views or give more frames"
        )


def _as_bytes(colors: Any) -> Colors:
    """Colours of an Open3D geometry, which are bytes in a cloud and 0..1 in a mesh."""
    values = colors.numpy()
    if values.dtype == np.uint8:
        return values.copy()
    return np.rint(values * 255.0).astype(np.uint8)


def _check_whole(path: Path) -> None:
    """Compare a binary PLY file's length with its header: Open3D reads a cut cloud as if it were whole."""
    try:
        with path.open("rb") as stream:
            header, mark, _ = stream.read(_HEADER_BYTES).partition(b"end_header\n")
        length = path.stat().st_size
    except OSError as error:
        raise MapFileError(f"cannot read {path}: {error.strerror or error}") from error
    if not (header.startswith(b"ply\n") and b"\nformat binary_" in header and mark):
        raise MapFileError(f"{path}: not a binary PLY file")
    expected = len(header) + len(mark) + _content_bytes(header, path)
    if length < expected:
        raise MapFileError(f"{path}: cut off, {length} of {expected} bytes; save the map again")


def _content_bytes(header: bytes, path: Path) -> int:
    """Bytes that the header announces; a list is taken for the three corners of a triangle."""
    total = count = 0
    try:
        for fields in (line.split() for line in header.decode("ascii").splitlines()):
            if fields[0] == "element":
                count = int(fields[2])
            elif fields[0] == "property" and fields[1] == "list":
                total += count * (_PROPERTY_BYTES[fields[2]] + 3 * _PROPERTY_BYTES[fields[3]])
            elif fields[0] == "property":
                total += count * _PROPERTY_BYTES[fields[1]]
    except (ValueError, IndexError, KeyError) as error:
        raise MapFileError(f"{path}: damaged PLY header ({error}); save the map again") from error
    return total
