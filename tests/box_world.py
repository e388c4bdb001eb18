"""A wall and a box before it, seen by a camera in closed form: ground truth for maps from RGB-D frames.

World axes are those of the first camera: x right, y down, z forward; metres.
"""

from __future__ import annotations

import gtsam
import numpy as np

from slam.measurements import CameraIntrinsics, FloatArray, RgbdFrame

WALL_Z = 2.0
BOX_LOW, BOX_HIGH = np.array([-0.3, -0.2, 1.4]), np.array([0.3, 0.25, 1.8])
WALL_RGB, BOX_RGB = (40, 90, 200), (200, 60, 30)
CAMERA = CameraIntrinsics(150.0, 152.0, 78.3, 61.2, 160, 120)


def camera_poses(T_map_world: gtsam.Pose3 | None = None, count: int = 6) -> list[gtsam.Pose3]:
    """T_map_camera of a camera that swings past the box, looking at it from both sides and from above."""
    angles = np.linspace(-0.5, 0.5, count)
    world = T_map_world or gtsam.Pose3()
    return [
        world
        * gtsam.Pose3(gtsam.Rot3.Ypr(0.1 * a, a, -0.15), [-1.1 * np.sin(a), -0.3, 2.0 - 1.9 * np.cos(a)])
        for a in angles
    ]


def box_frames(count: int = 6) -> list[RgbdFrame]:
    """What the cameras of `camera_poses` see."""
    return [box_frame(T, stamp_s=0.1 * i) for i, T in enumerate(camera_poses(count=count))]


def box_frame(T_world_camera: gtsam.Pose3, stamp_s: float = 0.0) -> RgbdFrame:
    """Depth and colour along the ray of every pixel's centre."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    rays = rays @ T_world_camera.rotation().matrix().T  # of unit depth, so lengths along them are depths
    origin = T_world_camera.translation()
    to_wall = (WALL_Z - origin[2]) / rays[..., 2]
    low, high = (BOX_LOW - origin) / rays, (BOX_HIGH - origin) / rays
    enter, leave = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
    on_box = (enter < leave) & (enter > 0.0)
    depth_m = np.where(on_box, enter, to_wall).astype(np.float32)
    color = np.where(on_box[..., None], BOX_RGB, WALL_RGB).astype(np.uint8)
    return RgbdFrame(stamp_s, color, depth_m, CAMERA)


def distances(points_world: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N,) distances to the wall and to the surface of the box."""
    outside = np.maximum(BOX_LOW - points_world, points_world - BOX_HIGH)
    signed = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0)
    return np.abs(points_world[:, 2] - WALL_Z), np.abs(signed)
