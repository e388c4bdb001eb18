"""Coloured mesh as binary glTF 2.0, for browsers, Blender and phones.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html: y is up, vertex colours are linear. They contain
the light of the scene, so the material is not lit again (KHR_materials_unlit).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.errors import MapFileError
from slam.mapping.dense_map import ColoredMesh
from slam.storage.files import write_bytes

_FLOAT, _UINT32, _UINT16 = 5126, 5125, 5123
_ARRAYS, _ELEMENTS = 34962, 34963
# Rotates z up to y up: quaternion x, y, z, w of -90 degrees about x.
_Y_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]


def write_mesh_glb(path: Path, mesh: ColoredMesh) -> None:
    """Write a mesh with normals and colours of its vertices, whole or not at all.

    Raises
    ------
    MapFileError
        If the mesh is empty or the file cannot be written.
    """
    if not len(mesh.faces):
        raise MapFileError(f"no triangles for {path}: no surface was seen often enough")
    parts: list[tuple[NDArray[Any], str, int, int]] = [
        (mesh.vertices_map.astype("<f4"), "VEC3", _FLOAT, _ARRAYS),
        (mesh.normals_map.astype("<f4"), "VEC3", _FLOAT, _ARRAYS),
        (_linear(mesh.colors), "VEC4", _UINT16, _ARRAYS),
        (mesh.faces.astype("<u4").ravel(), "SCALAR", _UINT32, _ELEMENTS),
    ]
    views, accessors, offset = [], list[dict[str, Any]](), 0
    for number, (values, shape, kind, target) in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": values.nbytes, "target": target})
        accessor = {"bufferView": number, "componentType": kind, "count": len(values), "type": shape}
        accessors.append(accessor | ({"normalized": True} if kind == _UINT16 else {}))
        offset += values.nbytes
    accessors[0] |= {end: getattr(parts[0][0], end)(axis=0).tolist() for end in ("min", "max")}
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}
    head = {
        "asset": {"version": "2.0", "generator": "Scanweave"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _Y_UP}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}],
        "buffers": [{"byteLength": offset}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(values.tobytes() for values, *_ in parts)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    write_bytes(path, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def _linear(colors: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return (N, 4) linear RGB and opacity of (N, 3) sRGB (IEC 61966-2-1)."""
    share = np.arange(256) / 255.0
    curve = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    most = np.iinfo(np.uint16).max
    linear = np.full((len(colors), 4), most, "<u2")
    linear[:, :3] = np.rint(most * curve).astype(np.uint16)[colors]
    return linear
