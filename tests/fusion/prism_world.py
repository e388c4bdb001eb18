"""A world of upright boxes, seen without noise by a planar lidar and a pin-hole camera, in closed form."""

from __future__ import annotations

import math

import numpy as np

import fusion
from fusion.curves import FORWARD

# x0, y0, x1, y1, height: four walls, a low cupboard ahead on the left, a cabinet on the right, a pillar.
WALLS = (
    (4.0, -3.0, 4.2, 3.5, 2.5),
    (-2.5, -3.0, -2.3, 3.5, 2.5),
    (-2.5, 3.3, 4.2, 3.5, 2.5),
    (-2.5, -3.0, 4.2, -2.8, 2.5),
)
CABINET = (2.2, -2.8, 3.0, -1.5, 2.0)
PILLAR = (3.2, 0.9, 3.5, 1.2, 2.5)
CUPBOARD = (1.6, 0.3, 2.0, 1.3, 0.4)
ROOM = (*WALLS, CABINET, PILLAR)
INTRINSICS = fusion.Intrinsics(160.0, 160.0, 99.5, 74.5)
SHAPE = (150, 200)


def cast(origin, directions, boxes=ROOM):
    """(N,) distance to the first box, in lengths of the directions; boxes stand on z = 0."""
    best = np.full(len(directions), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for x0, y0, x1, y1, top in boxes:
            low = (np.array([x0, y0, 0.0]) - origin) / directions
            high = (np.array([x1, y1, top]) - origin) / directions
            enter = np.nanmax(np.minimum(low, high), axis=1)
            leave = np.nanmin(np.maximum(low, high), axis=1)
            hit = (enter <= leave) & (enter > 1e-9)
            best = np.where(hit & (enter < best), enter, best)
    return best


def turned(yaw):
    """Rotation about z."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def lidar(
    pose=(0.0, 0.0, 0.0), height=0.3, boxes=ROOM, mount_yaw=0.0, beams=481, aperture=4.0 * math.pi / 3.0
):
    """A sweep from a pose x, y, yaw of the robot; the lidar is turned by mount_yaw on it."""
    step = aperture / (beams - 1)
    bearings = -0.5 * aperture + step * np.arange(beams)
    directions = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(beams)])
    ranges = cast(np.array([pose[0], pose[1], height]), directions @ turned(pose[2] + mount_yaw).T, boxes)
    return fusion.LidarCurve(ranges.astype(np.float32), -0.5 * aperture, step, 8.0)


def camera(
    pose=(0.0, 0.0, 0.0),
    height=0.9,
    boxes=ROOM,
    offset=(0.0, 0.0),
    R_level_camera=FORWARD,
    intrinsics=INTRINSICS,
):
    """Depth image from a pose of the robot; the camera stands an offset ahead and to the left on it."""
    rows, cols = np.indices(SHAPE)
    optical = np.stack(
        [(cols - intrinsics.cx) / intrinsics.fx, (rows - intrinsics.cy) / intrinsics.fy, np.ones(SHAPE)],
        axis=-1,
    ).reshape(-1, 3)
    world = turned(pose[2])
    origin = np.array([pose[0], pose[1], height]) + world @ np.array([*offset, 0.0])
    depth = cast(origin, optical @ (world @ R_level_camera).T, boxes).reshape(SHAPE)
    depth[~np.isfinite(depth)] = 0.0
    return fusion.DepthImage(depth.astype(np.float32), intrinsics, R_level_camera)


POSES = tuple(
    (x, y, yaw) for x, y in ((0.0, 0.0), (-1.0, 0.5), (0.6, -1.0)) for yaw in (-0.6, 0.0, 0.5, 1.4, 2.6)
)
