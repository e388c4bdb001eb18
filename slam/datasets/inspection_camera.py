"""What the images of one camera hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from slam.measurements import RgbdFrame
from slam.vision.camera_frame import T_BODY_CAMERA

_EVERY_PIXEL = 4  # along rows and columns: 19200 of 640 x 480 tell the shares well enough


@dataclass(slots=True)
class CameraFigures:
    """Running figures of one camera."""

    last: RgbdFrame | None = None
    pixels: int = 0
    valid: int = 0
    nearest_m: float = math.inf
    farthest_m: float = 0.0

    def add(self, frame: RgbdFrame) -> None:
        """One more frame."""
        sample = frame.depth_m[::_EVERY_PIXEL, ::_EVERY_PIXEL]
        depths = sample[sample > 0.0]
        self.pixels += sample.size
        self.valid += depths.size
        if depths.size:
            self.nearest_m = min(self.nearest_m, float(depths.min()))
            self.farthest_m = max(self.farthest_m, float(depths.max()))
        self.last = frame

    def facts(self) -> dict[str, Any] | None:
        """Lens and mounting of the latest frame, depths of a sample of all; None before the first frame.

        The mounting is the optical frame on the robot: its position, and the roll, pitch and yaw of a body
        that looks along x with its image upright; None where the log does not tell it.
        """
        if self.last is None:
            return None
        mount = self.last.T_base_camera
        return {
            **{
                name: getattr(self.last.intrinsics, name)
                for name in ("width", "height", "fx", "fy", "cx", "cy")
            },
            "valid_depth_share": self.valid / self.pixels,
            "depth_min_m": self.nearest_m if self.valid else None,
            "depth_max_m": self.farthest_m if self.valid else None,
            "mount_m": None if mount is None else mount.translation().tolist(),
            "mount_rpy_rad": None
            if mount is None
            else mount.compose(T_BODY_CAMERA.inverse()).rotation().rpy().tolist(),
        }
