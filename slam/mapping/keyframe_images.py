"""Keyframe images kept on disk while a log is read, so that memory does not grow with it."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import gtsam

from slam.errors import ScanweaveError
from slam.mapping.image_packing import depth_steps_per_m, packed_color, packed_depth, unpacked_images
from slam.measurements import CameraIntrinsics, RgbdFrame


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

    See `slam.mapping.image_packing` for what is lost.
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
        steps_per_m = depth_steps_per_m(frame)
        index = len(self)
        try:
            self._path(index, "jpg").write_bytes(packed_color(frame.color))
            self._path(index, "png").write_bytes(packed_depth(frame.depth_m, steps_per_m))
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
        if not 0 <= index < len(self):
            raise IndexError(f"keyframe {index} of {len(self)}")
        entry = self._entries[index]
        try:
            color, depth_m = unpacked_images(
                self._path(index, "jpg").read_bytes(),
                self._path(index, "png").read_bytes(),
                entry.steps_per_m,
                entry.intrinsics,
            )
        except OSError as error:
            raise ScanweaveError(
                f"keyframe {index} is gone from {self._folder}: {error.strerror or error}; run again"
            ) from error
        except ValueError as error:
            raise ScanweaveError(
                f"keyframe {index} in {self._folder} is damaged ({error}); check the disk and run again"
            ) from error
        return RgbdFrame(entry.stamp_s, color, depth_m, entry.intrinsics, entry.T_base_camera, entry.sensor)

    def _path(self, index: int, suffix: str) -> Path:
        return self._folder / f"{index:06d}.{suffix}"
