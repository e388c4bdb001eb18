"""Writes colour and depth images in the layout of the TUM RGB-D benchmark, one folder per camera."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import yaml
from numpy.typing import NDArray

from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics, Float32Array, RgbdFrame
from slam.simulation.ordered_pool import OrderedPool

DEPTH_SCALE = 5000.0  # steps per metre, as in the benchmark


class TumWriter:
    """Writes the folder of one camera; use it as a context manager.

    The pool's threads compress images, so they are on disk only when the pool has finished.

    Parameters
    ----------
    folder
        Receives ``rgb/``, ``depth/``, ``rgb.txt``, ``depth.txt`` and ``calibration.yaml``.
    """

    def __init__(
        self, folder: Path, intrinsics: CameraIntrinsics, T_base_camera: gtsam.Pose3, pool: OrderedPool
    ) -> None:
        self._folder, self._pool = folder, pool
        self._indexes = {}
        for kind, what in (("rgb", "color images"), ("depth", "depth maps")):
            (folder / kind).mkdir(parents=True)
            index = (folder / f"{kind}.txt").open("w", encoding="ascii", newline="\n")
            index.write(f"# {what}\n# simulated by scanweave\n# timestamp filename\n")
            self._indexes[kind] = index
        write_yaml(folder / "calibration.yaml", calibration(intrinsics, T_base_camera))

    def __enter__(self) -> TumWriter:
        return self

    def __exit__(self, *_: object) -> None:
        for index in self._indexes.values():
            index.close()

    def write(self, frame: RgbdFrame) -> None:
        """Queue the two images of a frame, both under its stamp."""
        name = f"{frame.stamp_s:.6f}.png"
        for kind, index in self._indexes.items():
            index.write(f"{frame.stamp_s:.6f} {kind}/{name}\n")
        self._pool.submit(_write_color, self._folder / "rgb" / name, frame.color)
        self._pool.submit(_write_depth, self._folder / "depth" / name, frame.depth_m)


def depth_steps(depth_m: Float32Array, steps_per_m: float) -> NDArray[np.uint16]:
    """Depth as 16-bit steps, (height, width); 0 for none or if it is too far for 16 bits."""
    with np.errstate(invalid="ignore"):
        steps = np.rint(depth_m * np.float32(steps_per_m))
        return np.where((steps > 0.0) & (steps <= 65535.0), steps, 0.0).astype(np.uint16)


def calibration(intrinsics: CameraIntrinsics, T_base_camera: gtsam.Pose3) -> dict[str, Any]:
    """Contents of ``calibration.yaml`` for a camera."""
    return {
        "intrinsics": {
            **{name: float(getattr(intrinsics, name)) for name in ("fx", "fy", "cx", "cy")},
            "width": int(intrinsics.width),
            "height": int(intrinsics.height),
        },
        "depth_steps_per_m": DEPTH_SCALE,
        "T_base_camera": transform_fields(T_base_camera),
    }


def transform_fields(transform: gtsam.Pose3) -> dict[str, list[float]]:
    """A transform for a YAML file: metres, and a unit quaternion."""
    quaternion: Any = transform.rotation().toQuaternion()
    return {
        "translation_m": [transform.x(), transform.y(), transform.z()],
        "quaternion_xyzw": [quaternion.x(), quaternion.y(), quaternion.z(), quaternion.w()],
    }


def write_yaml(path: Path, content: dict[str, Any]) -> None:
    """Write a small YAML file in the given order."""
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
    path.write_text(text, encoding="utf-8", newline="\n")


def _write_color(path: Path, color: NDArray[np.uint8]) -> None:
    """RGB as PNG."""
    import cv2

    # Noise is incompressible: 40 % less storage would take ten times the time, also for reading.
    _write_png(path, cv2.cvtColor(color, cv2.COLOR_RGB2BGR), 0)


def _write_depth(path: Path, depth_m: Float32Array) -> None:
    """Depth as 16-bit PNG."""
    # Quantised depth compresses well without a filter.
    _write_png(path, depth_steps(depth_m, DEPTH_SCALE), 1)


def _write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16], level: int) -> None:
    """PNG with a zlib level and without filter."""
    import cv2

    options = [
        *(cv2.IMWRITE_PNG_COMPRESSION, level),
        *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_DEFAULT),
        *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE),
    ]
    packed, content = cv2.imencode(".png", image, options)
    if not packed:
        raise DatasetError(f"cannot pack {path.name} as PNG, {image.dtype} {image.shape}")
    path.write_bytes(content.tobytes())
