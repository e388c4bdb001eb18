"""What the images of one camera hold."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam

from slam.measurements import RgbdFrame
from slam.vision.camera_frame import T_BODY_CAMERA

_EVERY_PIXEL = 4  # along rows and columns: 19200 of 640 x 480 tell the shares well enough


@dataclass(frozen=True, slots=True)
class CameraSummary:
    """The frames of one camera.

    Attributes
    ----------
    width, height, fx, fy, cx, cy
        Of the latest frame, pixels.
    valid_depth_share
        Of a sample of the pixels of all frames, 0..1.
    depth_min_m, depth_max_m
        Of the same sample, None where no depth is valid.
    mount_m, mount_rpy_rad
        The optical frame on the robot: position, and the roll, pitch and yaw of a body that looks along x
        with its image upright. None where the log does not tell it.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    valid_depth_share: float
    depth_min_m: float | None
    depth_max_m: float | None
    mount_m: tuple[float, float, float] | None
    mount_rpy_rad: tuple[float, float, float] | None


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

    def summary(self) -> CameraSummary | None:
        """The figures, frozen; None before the first frame."""
        if self.last is None:
            return None
        lens, mount = self.last.intrinsics, self.last.T_base_camera
        return CameraSummary(
            width=lens.width,
            height=lens.height,
            fx=lens.fx,
            fy=lens.fy,
            cx=lens.cx,
            cy=lens.cy,
            valid_depth_share=self.valid / self.pixels,
            depth_min_m=self.nearest_m if self.valid else None,
            depth_max_m=self.farthest_m if self.valid else None,
            mount_m=None if mount is None else (mount.x(), mount.y(), mount.z()),
            mount_rpy_rad=None if mount is None else _body_rpy_rad(mount),
        )


def _body_rpy_rad(T_base_camera: gtsam.Pose3) -> tuple[float, float, float]:
    """Roll, pitch and yaw of the body whose x axis is the optical z, y the left and z the up of the image."""
    roll, pitch, yaw = T_base_camera.compose(T_BODY_CAMERA.inverse()).rotation().rpy().tolist()
    return roll, pitch, yaw
