"""Keyframe images kept on disk while a log is read, so that memory does not grow with it."""

from __future__ import annotations

import math
import shutil
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from slam.errors import ScanweaveError
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array, RgbdFrame

JPEG_QUALITY = 95
STEPS_PER_M = 5000.0  # 0.2 mm, as in TUM's logs; coarser only for a frame that reaches beyond 13.1 m
MAX_STEPS = 65535


@dataclass(frozen=True, slots=True)
class _Entry:
    """What is kept in memory of a frame: all but its images."""

    stamp_s: float
    intrinsics: CameraIntrinsics
    T_base_camera: gtsam.Pose3 | None
    sensor: str
    steps_per_m: float


class KeyframeImages:
    """A spool of RGB-D keyframes in a temporary folder of its own.

    Colour is kept as JPEG, which alters it by a few grey levels, depth as a 16-bit PNG in steps of 0.2 mm.
    The folder goes when the spool is closed, leaves its ``with`` block or is forgotten.

    Parameters
    ----------
    parent
        Where the temporary folder is made; the system's own place by default, which on some systems is
        memory and not a disk.

    Raises
    ------
    ScanweaveError
        Where the folder cannot be made.
    """

    def __init__(self, parent: Path | None = None) -> None:
        try:
            self._folder = Path(tempfile.mkdtemp(prefix="scanweave-keyframes-", dir=parent))
        except OSError as error:
            raise ScanweaveError(
                f"cannot make a folder for keyframe images in {parent or tempfile.gettempdir()}: "
                f"{error.strerror or error}; set TMPDIR to a folder with free space"
            ) from error
        self._entries: list[_Entry] = []
        self._remove = weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)

    def __enter__(self) -> KeyframeImages:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[RgbdFrame]:
        """The frames in the order they came, one in memory at a time."""
        return (self.frame(index) for index in range(len(self)))

    def close(self) -> None:
        """Remove the images; nothing can be added or read afterwards."""
        self._remove()

    def add(self, frame: RgbdFrame) -> int:
        """Store one frame and return its index.

        Raises
        ------
        ScanweaveError
            Where a depth is not finite, or the images cannot be written.
        """
        reach_m = float(frame.depth_m.max(initial=0.0))
        if not math.isfinite(reach_m):
            raise ScanweaveError(
                f"depth image at {frame.stamp_s:.6f} s holds {reach_m}; an invalid reading must be 0"
            )
        steps_per_m = min(STEPS_PER_M, MAX_STEPS / reach_m) if reach_m > 0.0 else STEPS_PER_M
        index = len(self)
        try:
            self._path(index, "jpg").write_bytes(_jpeg(frame.color))
            self._path(index, "png").write_bytes(_png(frame.depth_m, steps_per_m))
        except OSError as error:
            raise ScanweaveError(
                f"cannot keep keyframe {index} in {self._folder}: {error.strerror or error}; "
                "set TMPDIR to a folder with free space"
            ) from error
        self._entries.append(
            _Entry(frame.stamp_s, frame.intrinsics, frame.T_base_camera, frame.sensor, steps_per_m)
        )
        return index

    def frame(self, index: int) -> RgbdFrame:
        """The frame that `add` numbered ``index``.

        Raises
        ------
        IndexError
            Where there is no such frame.
        ScanweaveError
            Where its images are gone or damaged.
        """
        import cv2

        if not 0 <= index < len(self):
            raise IndexError(f"keyframe {index} of {len(self)}")
        entry = self._entries[index]
        try:
            color = cv2.imdecode(np.fromfile(self._path(index, "jpg"), np.uint8), cv2.IMREAD_COLOR_RGB)
            steps = cv2.imdecode(np.fromfile(self._path(index, "png"), np.uint8), cv2.IMREAD_UNCHANGED)
        except OSError as error:
            raise ScanweaveError(
                f"keyframe {index} is gone from {self._folder}: {error.strerror or error}; run again"
            ) from error
        if color is None or steps is None:
            raise ScanweaveError(
                f"keyframe {index} in {self._folder} is damaged; check the disk and run again"
            )
        depth_m = steps.astype(np.float32) / np.float32(entry.steps_per_m)
        return RgbdFrame(entry.stamp_s, color, depth_m, entry.intrinsics, entry.T_base_camera, entry.sensor)

    def _path(self, index: int, suffix: str) -> Path:
        return self._folder / f"{index:06d}.{suffix}"


def _jpeg(color: ColorImage) -> bytes:
    """An (H, W, 3) RGB image, packed."""
    import cv2

    bgr = cv2.cvtColor(np.ascontiguousarray(color), cv2.COLOR_RGB2BGR)
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()


def _png(depth_m: Float32Array, steps_per_m: float) -> bytes:
    """An (H, W) depth image, rounded to steps and packed."""
    import cv2

    steps = cv2.multiply(np.ascontiguousarray(depth_m), steps_per_m, dtype=cv2.CV_16U)
    # Differences to the row above, packed by run length: on a Kinect's frame 4 ms instead of the 11 of plain
    # level 1, on a noisy one 8 instead of 13, and the files are smaller.
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    options += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    return cv2.imencode(".png", steps, options)[1].tobytes()
