"""A robot that drives round in an empty hall, by wheels that turn too little, past tags ahead of it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
from flat_worlds import box, sweep

from slam.matching.planar import compose
from slam.measurements import (
    CameraIntrinsics,
    ColorImage,
    FloatArray,
    Measurement,
    RgbdFrame,
    WheelOdometry,
    pose2_from_row,
)
from slam.simulation.home_model import WallTag
from slam.simulation.rigs import camera_pose
from slam.simulation.wall_tags import paint_tags
from slam.vision.tags import tag_cells

LENS = CameraIntrinsics(260.0, 260.0, 159.5, 119.5, 320, 240)
T_BASE_CAMERA = camera_pose((0.1, 0.05, 0.4), pitch_rad=0.05)
SIDE_M = 0.16
# Round in 40 moments, and 12 more: about 10 m.
STEP = np.array([0.25, 0.0, 2.0 * math.pi / 40])
MOMENTS = 52


def tag_at(number: int, x_m: float, y_m: float, yaw_rad: float, family: str = "36h11") -> WallTag:
    """A tag that looks along a yaw, as high as the camera or a bit higher."""
    out = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    axes = np.array([[-out[1], out[0], 0.0], [0.0, 0.0, 1.0], out]).T
    place = np.array([x_m, y_m, 0.5 + 0.03 * (number % 3)])
    return WallTag(number, gtsam.Pose3(gtsam.Rot3(axes), place), SIDE_M, tag_cells(family, number))


def way() -> list[FloatArray]:
    """Where the robot truly is."""
    poses = [np.zeros(3)]
    for _ in range(MOMENTS - 1):
        poses.append(compose(poses[-1], STEP))
    return poses


def ahead_of(moment: int, number: int, slant_rad: float = 0.5) -> WallTag:
    """A tag that the robot has 1.6 m ahead at a moment."""
    x, y, yaw = compose(way()[moment], np.array([1.6, 0.25, math.pi + slant_rad]))
    return tag_at(number, x, y, yaw)


# The first three and the last moments see tag 0; the others are about a third of the round apart.
TAGS = (ahead_of(2, 0), ahead_of(15, 1), ahead_of(28, 2))


def seen(tags: Iterable[WallTag], T_world_camera: gtsam.Pose3, seed: int = 0) -> ColorImage:
    """A gray hall with tags in it."""
    rng = np.random.default_rng(seed)
    image = np.full((LENS.width * LENS.height, 3), 150.0, np.float32)
    rays = np.indices((LENS.height, LENS.width)).reshape(2, -1)
    for tag in tags:  # nothing stands before it
        T_camera_tag = T_world_camera.between(tag.T_map_tag)
        normal = np.asarray(T_camera_tag.rotation().matrix())[:, 2]
        slopes = np.column_stack(
            [(rays[1] - LENS.cx) / LENS.fx, (rays[0] - LENS.cy) / LENS.fy, rays[0] * 0 + 1]
        )
        range_m = ((normal @ T_camera_tag.translation()) / (slopes @ normal)).astype(np.float32)
        paint_tags(image, range_m, [tag], T_world_camera, LENS)
    image += rng.normal(0.0, 2.0, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8).reshape(LENS.height, LENS.width, 3)


@cache
def usual() -> list[Measurement]:
    """The drive past the usual tags."""
    return drive(TAGS)


def drive(tags: Iterable[WallTag], later: Mapping[int, Iterable[WallTag]] | None = None) -> list[Measurement]:
    """Wheels, a lidar that soon sees nothing, and images; from some moments on other tags hang."""
    found, wheels = list[Measurement](), np.zeros(3)
    for moment, true in enumerate(way()):
        stamp_s, tags = 10.0 + 0.5 * moment, (later or {}).get(moment, tags)
        camera = gtsam.Pose3(pose2_from_row(true)).compose(T_BASE_CAMERA)
        color, depth_m = seen(tags, camera, moment), np.zeros((LENS.height, LENS.width), np.float32)
        scan = sweep(box(-3.0, -2.0, 6.0, 6.0), true, beams=181, fov_rad=math.pi, stamp_s=stamp_s)
        if moment > 2:
            scan = replace(scan, ranges_m=np.full_like(scan.ranges_m, np.nan))
        found += [
            WheelOdometry(stamp_s, pose2_from_row(wheels)),
            scan,
            RgbdFrame(stamp_s, color, depth_m, LENS, T_BASE_CAMERA),
        ]
        wheels = compose(wheels, STEP * [1.0, 1.0, 0.95])
    return found
