"""A furnished room for sample recordings: the images and ranges in it are known exactly.

Everything is computed, without noise and motion during an image or a revolution. So an error of a reader in a
lens, a unit, a mounting or a registration is a difference from the true view of the room.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import gtsam
import numpy as np

from slam.measurements import CameraIntrinsics, FloatArray

# Corners of the room, seen from inside, and of the objects in it.
_ROOM = np.array([[-4.0, -3.5, 0.0], [5.0, 4.0, 2.8]])
_THINGS = np.array(
    [
        [[2.0, -1.2, 0.0], [2.8, -0.5, 1.1]],
        [[3.2, 0.6, 0.0], [3.9, 1.9, 1.6]],
        [[1.6, 1.1, 0.3], [2.1, 1.5, 0.8]],
        [[-2.5, -2.6, 0.0], [-1.4, -1.8, 1.9]],
        [[-2.8, 1.8, 0.0], [-2.1, 2.9, 1.2]],
        [[0.6, -2.9, 0.0], [1.4, -2.2, 2.2]],
    ]
)
_PATCH_M = 0.15  # of one colour


@dataclass(frozen=True)
class Seen:
    """What a camera sees: (H, W, 3) RGB and (H, W) metres along its axis."""

    color: Any
    depth_m: Any


def hits(origin: FloatArray, rays: FloatArray) -> FloatArray:
    """Distances along (N, 3) rays from a point in the room to the first surface, in lengths of the ray."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / rays
        far = np.nanmin(np.fmax(*((corner - origin) * inverse for corner in _ROOM)), axis=1)
        for box in _THINGS:
            sides = [(corner - origin) * inverse for corner in box]
            enters = np.fmin(*sides).max(axis=1)
            leaves = np.fmax(*sides).min(axis=1)
            far = np.where((enters < leaves) & (enters > 0.0) & (enters < far), enters, far)
    return far


def colors_at(points: FloatArray) -> Any:
    """(N, 3) RGB of points on surfaces: patches of random colours, each with its own."""
    cells = np.floor((points + 1e-4) / _PATCH_M).astype(np.int64)
    mixed = cells @ np.array(
        [[73856093, 19349663, 83492791], [12582917, 50331653, 25165843], [402653189, 6291469, 3145739]]
    )
    mixed ^= mixed >> 13
    return (40 + np.abs(mixed * 2654435761 >> 7) % 190).astype(np.uint8)


def looked_at(lens: CameraIntrinsics, pose: FloatArray, distortion: Any = None) -> Seen:
    """What a camera sees.

    Parameters
    ----------
    pose
        (4, 4) of its optical frame in the room.
    distortion
        Of OpenCV's models; None for a pin-hole.
    """
    columns, rows = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    if distortion is None:
        plane = (pixels - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    else:
        matrix = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
        plane = cv2.undistortPoints(pixels[:, None], matrix, np.asarray(distortion, np.float64))[:, 0]
    rays = np.column_stack([plane, np.ones(len(plane))]) @ pose[:3, :3].T
    depth = hits(pose[:3, 3], rays)
    color = colors_at(pose[:3, 3] + depth[:, None] * rays)
    shape = lens.height, lens.width
    return Seen(color.reshape(*shape, 3), depth.reshape(shape))


def turn(pose: FloatArray, elevations_deg: Any, count: int = 360) -> tuple[Any, Any]:
    """A clockwise revolution of a lidar from the front: (N, 3) points in its frame, (N,) shares 0..1."""
    part = np.repeat(np.arange(count) / count, len(elevations_deg))
    elevation = np.tile(np.radians(elevations_deg), count)
    bearing = -2.0 * np.pi * part
    flat = np.cos(elevation)
    rays = np.column_stack([flat * np.cos(bearing), flat * np.sin(bearing), np.sin(elevation)])
    ranges = hits(pose[:3, 3], rays @ pose[:3, :3].T)
    return (rays * ranges[:, None]).astype(np.float32), part


def scanned(pose: FloatArray, bearings_rad: FloatArray) -> FloatArray:
    """Ranges (N,) of a 2D scan at its bearings."""
    rays = np.column_stack([np.cos(bearings_rad), np.sin(bearings_rad), np.zeros(len(bearings_rad))])
    return hits(pose[:3, 3], rays @ pose[:3, :3].T)


OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # a camera that looks ahead


def placed(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw: float = 0.0, pitch: float = 0.0
) -> FloatArray:
    """(4, 4) of a pose by metres and radians."""
    turned = gtsam.Rot3.Ypr(yaw, pitch, 0.0)
    return np.asarray(gtsam.Pose3(turned, np.array([x, y, z])).matrix())


def way(count: int, step_m: float = 0.03, turn_rad: float = 0.012) -> list[FloatArray]:
    """Poses of a robot on the floor: a shallow curve."""
    return [placed(step_m * k, 0.3 * step_m * k, 0.0, turn_rad * k) for k in range(count)]
