"""A furnished room seen by an RGB-D camera in closed form: depth and colour from any pose inside it.

World axes: x east, y north, z up, metres; the floor is z = 0. Walls, floor, ceiling and two cupboards carry
patches of random grey, of which each place has its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.config.stages import RgbdConfig
from slam.measurements import CameraIntrinsics, FloatArray, RgbdFrame
from slam.vision.prepared_frame import FramePreparer, PreparedFrame

SMALL = CameraIntrinsics(132.0, 131.0, 79.2, 60.3, 160, 120)
LESS = CameraIntrinsics(198.0, 197.0, 119.1, 90.6, 240, 180)
MIDDLE = CameraIntrinsics(264.0, 262.0, 158.9, 121.1, 320, 240)
DEPTH_STEPS_PER_M = 5000

# A camera that looks along x of its body, z up.
T_BODY_CAMERA = gtsam.Pose3(gtsam.Rot3.Ypr(-0.5 * math.pi, 0.0, -0.5 * math.pi), np.zeros(3))

_PATCH_M = 0.1
_TEXTURE_CELLS = 256


@dataclass(frozen=True)
class Room:
    """Boxes from inside and outside.

    Attributes
    ----------
    inside
        (2, 3) low and high corner of the room.
    outside
        Solid boxes in it, (2, 3) each.
    seed
        Of the pattern.
    frame
        ``T_world_room``: the same room elsewhere.
    """

    inside: FloatArray
    outside: tuple[FloatArray, ...] = ()
    seed: int = 0
    frame: gtsam.Pose3 = field(default_factory=gtsam.Pose3)


def furnished(seed: int = 0) -> Room:
    """5 x 4 x 2.5 m with two cupboards, so that no direction of motion is free."""
    cupboards = (
        np.array([[1.6, 0.4, 0.0], [2.5, 1.5, 1.6]]),
        np.array([[-2.5, -2.0, 0.0], [-1.7, -1.1, 1.9]]),
    )
    return Room(np.array([[-2.5, -2.0, 0.0], [2.5, 2.0, 2.5]]), cupboards, seed)


def hall(seed: int = 0) -> Room:
    """So wide that a camera near the middle of a wall sees nothing but this wall, x = 2."""
    return Room(np.array([[-50.0, -50.0, -50.0], [2.0, 50.0, 50.0]]), (), seed)


def looking(x: float, y: float, z: float, yaw: float, pitch: float = 0.0, roll: float = 0.0) -> gtsam.Pose3:
    """T_room_camera of a camera that looks along a yaw; pitch down, roll clockwise."""
    return gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array([x, y, z])) * T_BODY_CAMERA


def turning_walk(count: int, turns: float = 1.1, radius_m: float = 0.4) -> list[gtsam.Pose3]:
    """A loop around the middle of the room, looking outward, with a little sway."""
    angles = np.linspace(0.0, 2.0 * math.pi * turns, count)
    return [
        looking(
            radius_m * math.cos(a),
            radius_m * math.sin(a),
            1.3 + 0.05 * math.sin(3.0 * a),
            a,
            0.05 * math.sin(2.0 * a),
        )
        for a in angles
    ]


def render(
    room: Room,
    T_world_camera: gtsam.Pose3,
    camera: CameraIntrinsics = SMALL,
    stamp_s: float = 0.0,
    *,
    noise: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
    smooth: bool = True,
    sensor: str = "camera",
    T_base_camera: gtsam.Pose3 | None = None,
) -> RgbdFrame:
    """Depth along the ray of every pixel's centre, colour as the mean of four rays a pixel if smooth.

    Parameters
    ----------
    noise
        Sigma of depth: floor, and share of the squared distance.
    """
    pose = room.frame.inverse() * T_world_camera
    depth_m, gray = _cast(room, pose, *_pixel_centres(camera, 1))
    if smooth:
        _, gray = _cast(room, pose, *_pixel_centres(camera, 2))
        gray = gray.reshape(camera.height, 2, camera.width, 2).mean(axis=(1, 3))
    if any(noise):
        sigma = noise[0] + noise[1] * depth_m**2
        depth_m = depth_m + sigma * np.random.default_rng(seed).standard_normal(depth_m.shape)
    color = np.repeat(np.rint(gray).astype(np.uint8)[..., None], 3, axis=2)
    return RgbdFrame(stamp_s, color, depth_m.astype(np.float32), camera, T_base_camera, sensor)


def blind(frame: RgbdFrame) -> RgbdFrame:
    """The same frame of a dead camera: black, and no depth."""
    return replace(frame, color=np.zeros_like(frame.color), depth_m=np.zeros_like(frame.depth_m))


def dark(frame: RgbdFrame) -> RgbdFrame:
    """The same frame at night: depth alone."""
    return replace(frame, color=np.zeros_like(frame.color))


def prepared(frame: RgbdFrame, **settings: float) -> PreparedFrame:
    """With its features and surface points."""
    found = FramePreparer(RgbdConfig(**settings), {})(frame)  # type: ignore[arg-type]
    assert isinstance(found, PreparedFrame)
    return found


def error_of(pose: gtsam.Pose3, truth: gtsam.Pose3) -> FloatArray:
    """(6,) rotation and translation by which a pose is wrong, GTSAM's order, in the true frame."""
    error: FloatArray = gtsam.Pose3.Logmap(truth.between(pose))
    return error


def off_surfaces(room: Room, points_world: FloatArray) -> FloatArray:
    """(N,) distances of points to the nearest surface of the room."""
    points = in_world(points_world, room.frame.inverse())
    found = np.abs(np.minimum(points - room.inside[0], room.inside[1] - points)).min(axis=1)
    for low, high in room.outside:
        beyond = np.maximum(low - points, points - high)
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        found = np.minimum(found, np.abs(outside + np.minimum(beyond.max(axis=1), 0.0)))
    return found


def in_world(points_camera: FloatArray, T_world_camera: gtsam.Pose3) -> FloatArray:
    """(N, 3) points of a camera where it stands."""
    moved: FloatArray = points_camera @ T_world_camera.rotation().matrix().T + T_world_camera.translation()
    return moved


def write_tum_folder(folder: Path, frames: list[RgbdFrame], truth: list[gtsam.Pose3]) -> Path:
    """A TUM folder of frames and their true poses."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for n, (frame, pose) in enumerate(zip(frames, truth, strict=True)):
        steps = np.rint(frame.depth_m * DEPTH_STEPS_PER_M).clip(0, 65535).astype(np.uint16)
        for name, image in (("rgb", frame.color[..., ::-1]), ("depth", steps)):
            assert cv2.imwrite(str(folder / name / f"{n:04d}.png"), np.ascontiguousarray(image))
            lists[name].append(f"{frame.stamp_s:.6f} {name}/{n:04d}.png")
        q = pose.rotation().toQuaternion()
        row = [*pose.translation(), q.x(), q.y(), q.z(), q.w()]
        lists["groundtruth"].append(" ".join(f"{value:.9f}" for value in [frame.stamp_s, *row]))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    k = frames[0].intrinsics
    fields = {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "width": k.width, "height": k.height}
    body = "\n".join(f"  {name}: {value}" for name, value in fields.items())
    (folder / "calibration.yaml").write_text(f"intrinsics:\n{body}\ndepth_steps_per_m: {DEPTH_STEPS_PER_M}\n")
    return folder


def _pixel_centres(k: CameraIntrinsics, fold: int) -> tuple[FloatArray, FloatArray]:
    """Slopes x/z and y/z of the rays of every pixel, so many in a row."""
    u = (np.arange(k.width * fold) + 0.5) / fold - 0.5
    v = (np.arange(k.height * fold) + 0.5) / fold - 0.5
    grid = np.meshgrid((u - k.cx) / k.fx, (v - k.cy) / k.fy)
    return grid[0], grid[1]


def _cast(room: Room, pose: gtsam.Pose3, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Depth and brightness (H, W) along rays of unit depth."""
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ pose.rotation().matrix().T
    origin = pose.translation()
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    depth, gray = np.empty(x.shape), np.empty(x.shape)
    solids = np.stack([room.inside, *room.outside])
    _meet(rays.reshape(-1, 3), origin, solids, _pattern(room.seed), depth.ravel(), gray.ravel())
    return depth, gray


@kernel
def _meet(
    rays: FloatArray,
    origin: FloatArray,
    solids: FloatArray,
    pattern: NDArray[np.uint8],
    depth: FloatArray,
    gray: FloatArray,
) -> None:
    """Depth and brightness along each ray, in the first of the solids or against the others."""
    point = np.empty(3)
    for ray in range(rays.shape[0]):
        nearest, box = np.inf, 0
        for solid in range(solids.shape[0]):
            enter, leave = -np.inf, np.inf
            for axis in range(3):
                low = (solids[solid, 0, axis] - origin[axis]) / rays[ray, axis]
                high = (solids[solid, 1, axis] - origin[axis]) / rays[ray, axis]
                enter, leave = max(enter, min(low, high)), min(leave, max(low, high))
            if solid == 0:
                nearest = leave
            elif 0.0 < enter < min(leave, nearest):
                nearest, box = enter, solid
        for axis in range(3):
            point[axis] = origin[axis] + rays[ray, axis] * nearest
        # The side of its box that a point lies on has its own pattern.
        side, least = 0, np.inf
        for one in range(6):
            off = abs(point[one % 3] - solids[box, one // 3, one % 3])
            if off < least:
                side, least = one, off
        a, b = point[(side + 1) % 3], point[(side + 2) % 3]
        depth[ray] = nearest
        gray[ray] = pattern[box * 6 + side, _cell(a), _cell(b)]


@kernel
def _cell(metres: float) -> int:
    """Number of the patch at a coordinate."""
    return np.int64(np.floor(metres / _PATCH_M)) % _TEXTURE_CELLS


@cache
def _pattern(seed: int) -> NDArray[np.uint8]:
    """Brightness of every patch of every side: of the room, and of three that stand in it."""
    shape = (24, _TEXTURE_CELLS, _TEXTURE_CELLS)
    return np.random.default_rng(seed).integers(20, 236, shape, dtype=np.uint8)
