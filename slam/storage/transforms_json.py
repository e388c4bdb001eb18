"""Images with poses as ``transforms.json``, for nerfstudio and programs that read its format.

https://docs.nerf.studio/quickstart/data_conventions.html: cameras look along their -z with y up; z of the
world is up. Its rays pass pixels at half a pixel from their corner: the principal points are as in COLMAP.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.measurements import CameraIntrinsics
from slam.storage.files import write_lines
from slam.storage.posed_images import DEPTHS, IMAGES, MASKS, PosedImage

# From the optical frame's axes to those of OpenGL.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


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
