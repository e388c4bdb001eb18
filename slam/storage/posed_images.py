"""Images of a map with poses, as nerfstudio's ``transforms.json`` or as a COLMAP model.

https://docs.nerf.studio/quickstart/data_conventions.html: cameras look along their -z with y up; z of the
world is up. https://colmap.github.io/format.html: cameras, images and an initial cloud, in binary and in
text; points have no tracks: they come from a surface, not from features. In both, pixels start at their
corner, ours at their centre: the principal points differ by half a pixel.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.mapping.dense_map import ColoredCloud
from slam.measurements import CameraIntrinsics, row_from_pose
from slam.storage.files import make_folder, write_bytes, write_lines
from slam.storage.map_frames import MapFrames

IMAGES, DEPTHS, MASKS = "images", "depth", "masks"
DEPTH_STEPS_PER_M = 1000.0  # 16-bit millimetres, the default of nerfstudio

# From the optical frame's axes to those of OpenGL.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

_PINHOLE = 1


@dataclass(frozen=True, slots=True)
class PosedImage:
    """An image without lens distortion.

    Attributes
    ----------
    name
        Of its file in ``images/``; that of its depth is the same with ``.png``.
    T_map_camera
        Of the optical frame: z forward, x right, y down.
    masked
        Whether ``masks/`` shows which of its pixels are known.
    """

    name: str
    T_map_camera: gtsam.Pose3
    intrinsics: CameraIntrinsics
    sensor: str
    masked: bool


def plain_name(sensor: str) -> str:
    """The name of a sensor as a part of a file's name."""
    return "".join(sign if sign.isalnum() or sign in "-_" else "_" for sign in sensor)


def write_posed_images(
    folder: Path, frames: MapFrames, poses: Sequence[gtsam.Pose3], moved: Collection[str]
) -> list[PosedImage]:
    """Write the colours as they are kept, depth in millimetres (0 unknown), and masks where they are needed.

    Parameters
    ----------
    poses
        ``T_map_camera`` of each frame.
    moved
        Cameras whose colours were moved to where the depth camera sees them: they are black without depth,
        and get masks (255 known).

    Raises
    ------
    MapFileError
        If a frame is damaged, or a file cannot be written.
    """
    import cv2

    images = []
    for number, pose in enumerate(poses):
        head = frames.head(number)
        stem = f"{number:06d}_{plain_name(head.sensor)}"
        image = PosedImage(f"{stem}.jpg", pose, head.intrinsics, head.sensor, head.sensor in moved)
        depth_m = frames.frame(number).depth_m
        files = {IMAGES: (image.name, frames.jpeg(number))}
        steps = np.minimum(np.rint(depth_m * DEPTH_STEPS_PER_M), np.iinfo(np.uint16).max).astype(np.uint16)
        files[DEPTHS] = (f"{stem}.png", cv2.imencode(".png", steps)[1].tobytes())
        if image.masked:
            known = np.where(depth_m > 0.0, 255, 0).astype(np.uint8)
            # COLMAP looks for the name of the image and .png behind.
            files[MASKS] = (f"{image.name}.png", cv2.imencode(".png", known)[1].tobytes())
        for kind, (name, content) in files.items():
            make_folder(folder / kind)
            write_bytes(folder / kind / name, content)
        images.append(image)
    return images


def write_transforms(path: Path, images: Sequence[PosedImage]) -> None:
    """Write the file; images, depths, masks and the cloud (``points.ply``) lie beside it.

    Raises
    ------
    MapFileError
        If it cannot be written.
    """
    lenses = {image.intrinsics for image in images}
    head: dict[str, Any] = {"camera_model": "OPENCV", "ply_file_path": "points.ply"}
    if len(lenses) == 1:
        head |= _lens(*lenses)
    head["frames"] = [_frame(image, len(lenses) > 1) for image in images]
    write_lines(path, [json.dumps(head, indent=1)])


def _frame(image: PosedImage, with_lens: bool) -> dict[str, Any]:
    """One image."""
    frame: dict[str, Any] = {
        "file_path": f"{IMAGES}/{image.name}",
        "depth_file_path": f"{DEPTHS}/{Path(image.name).with_suffix('.png')}",
        "transform_matrix": (image.T_map_camera.matrix() @ _OPENGL).tolist(),
    }
    if image.masked:
        frame["mask_path"] = f"{MASKS}/{image.name}.png"
    return frame | (_lens(image.intrinsics) if with_lens else {})


def _lens(lens: CameraIntrinsics) -> dict[str, float]:
    """A lens without distortion."""
    size = {"w": lens.width, "h": lens.height}
    middle = {"cx": lens.cx + 0.5, "cy": lens.cy + 0.5}
    none = {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    return {"fl_x": lens.fx, "fl_y": lens.fy, **middle, **size, **none}


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
