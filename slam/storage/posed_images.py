"""Camera keyframes of a map as image files, with their poses and camera intrinsics."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from slam.measurements import CameraIntrinsics
from slam.storage.files import make_folder, write_bytes
from slam.storage.map_frames import MapFrames

IMAGES, DEPTHS, MASKS = "images", "depth", "masks"
DEPTH_STEPS_PER_M = 1000.0  # 16-bit millimetres, the default of nerfstudio


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
