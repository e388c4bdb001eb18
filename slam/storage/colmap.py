"""Images with poses as a COLMAP model, in binary and in text: cameras, images and an initial cloud.

https://colmap.github.io/format.html. COLMAP's pixels start at their corner, ours at their centre: the
principal points differ by half a pixel. Points have no tracks: they come from a surface, not from features.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam.mapping.dense_map import ColoredCloud
from slam.measurements import CameraIntrinsics, row_from_pose
from slam.storage.files import make_folder, write_bytes, write_lines
from slam.storage.posed_images import PosedImage

_PINHOLE = 1


def write_colmap(folder: Path, images: Sequence[PosedImage], cloud: ColoredCloud) -> list[Path]:
    """Write ``sparse/0/*.bin`` and ``sparse/text/*.txt``; return the written files.

    Raises
    ------
    MapFileError
        If a file cannot be written.
    """
    cameras: dict[tuple[str, CameraIntrinsics], int] = {}
    for image in images:
        cameras.setdefault((image.sensor, image.intrinsics), len(cameras) + 1)
    lenses = [
        # COLMAP measures pixels from their corners.
        (number, lens.width, lens.height, [lens.fx, lens.fy, lens.cx + 0.5, lens.cy + 0.5])
        for (_, lens), number in cameras.items()
    ]
    views = []
    for number, image in enumerate(images, start=1):
        x, y, z, *axis, w = row_from_pose(image.T_map_camera.inverse())
        views.append((number, [w, *axis, x, y, z], cameras[image.sensor, image.intrinsics], image.name))
    binary, text = folder / "sparse" / "0", folder / "sparse" / "text"
    for made in (binary, text):
        make_folder(made)
    write_bytes(
        binary / "cameras.bin",
        _count(lenses) + b"".join(struct.pack("<iiQQ4d", n, _PINHOLE, w, h, *k) for n, w, h, k in lenses),
    )
    write_bytes(
        binary / "images.bin",
        _count(views)
        + b"".join(
            struct.pack("<i7di", n, *pose, camera) + name.encode() + b"\0" + struct.pack("<Q", 0)
            for n, pose, camera, name in views
        ),
    )
    write_bytes(binary / "points3D.bin", _points(cloud))
    write_lines(
        text / "cameras.txt", (f"{n} PINHOLE {w} {h} {' '.join(map(repr, k))}" for n, w, h, k in lenses)
    )
    # The second line of an image is for its matched features.
    write_lines(
        text / "images.txt",
        (f"{n} {' '.join(map(repr, pose))} {camera} {name}\n" for n, pose, camera, name in views),
    )
    rows = zip(cloud.points_map.tolist(), cloud.colors.tolist(), strict=True)
    write_lines(
        text / "points3D.txt",
        (
            f"{n} {x:.6f} {y:.6f} {z:.6f} {red} {green} {blue} 0"
            for n, ((x, y, z), (red, green, blue)) in enumerate(rows, start=1)
        ),
    )
    return [binary, text]


def _points(cloud: ColoredCloud) -> bytes:
    """Pack the points, without tracks."""
    record = np.dtype(
        [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    )
    rows = np.zeros(len(cloud.points_map), record)
    rows["id"] = np.arange(1, len(rows) + 1)
    rows["xyz"], rows["rgb"] = cloud.points_map, cloud.colors
    return _count(rows) + rows.tobytes()


def _count(rows: Sequence[object] | np.ndarray[tuple[int], np.dtype[np.void]]) -> bytes:
    """Pack the number of following records."""
    return struct.pack("<Q", len(rows))
