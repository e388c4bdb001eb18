"""Yang2021's experiment: a room of 5.20 m x 4.05 m, a D435i at 0.68 m, ten observation points, ten drives.

The paper does not describe the objects in the room; here they are a cupboard, a table, a chair, boxes of 5 to
40 cm and a low platform. As in the paper, the first pose of a drive is the world frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slam.measurements import RgbdFrame
from slam.simulation.furniture import chair
from slam.simulation.home_model import Home, Part, Room, Style, Thing, assemble
from slam.simulation.rigs import RIGS
from slam.simulation.scene import Scene
from slam.simulation.sensors import render_rgbd

LENGTH_M, WIDTH_M, WALL_M = 5.20, 4.05, 0.1
KEYFRAMES = 60
# What RGB-D SLAM leaves of errors along a drive; the simulator's poses would be exact.
POSE_SIGMA_M, POSE_SIGMA_RAD = 0.008, math.radians(0.2)
_SMOOTH_KEYFRAMES = 6
_STREAM = 22

# x, y in the room: 4 points on the floor, 6 on obstacles, each on a face or top inside the band.
FLOOR_POINTS = ((0.9, 3.3), (3.7, 3.4), (4.3, 1.8), (3.4, 0.5))
OBSTACLE_POINTS = ((0.45, 2.0), (0.75, 0.75), (2.55, 3.4), (4.55, 3.15), (4.45, 0.75), (2.41, 0.5))

# What is measured: pairs of faces, each (axis, place) with axis 0 for x = place, and a stretch across.
SEGMENTS = (
    ((0, 0.0), (0, LENGTH_M), (1.15, 1.55)),
    ((1, 0.0), (1, WIDTH_M), (3.4, 3.9)),
    ((0, 0.45), (0, LENGTH_M), (1.6, 2.4)),
    ((1, 0.0), (1, 3.4), (2.3, 2.8)),
)
CORNERS = (((0, LENGTH_M), (1, 0.0)), ((0, LENGTH_M), (1, WIDTH_M)))


@dataclass(frozen=True)
class Run:
    """One drive: the room in the map frame, keyframes, their true poses and those of a SLAM."""

    home: Home
    frames: list[RgbdFrame]
    true_poses: list[gtsam.Pose2]
    poses: list[gtsam.Pose2]
    T_map_room: gtsam.Pose2

    def in_map(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) points of the room in the map frame."""
        moved = np.asarray(points, dtype=float) @ self.T_map_room.rotation().matrix().T
        return np.asarray(moved + self.T_map_room.translation())


def drive(seed: int) -> Run:
    """Once round the middle of the room, from a start of its own, looking to both sides."""
    rng = np.random.default_rng([seed, _STREAM])
    round_rad = rng.uniform(0.0, 2.0 * math.pi) + rng.choice([-1.0, 1.0]) * np.linspace(
        0.0, 2.0 * math.pi, KEYFRAMES
    )
    x = 0.5 * LENGTH_M + 0.95 * np.cos(round_rad)
    y = 0.5 * WIDTH_M - 0.05 + 0.45 * np.sin(round_rad)
    # Outward, and swaying from there to both sides.
    yaw = round_rad + math.radians(55.0) * np.sin(np.arange(KEYFRAMES) * 0.9 + rng.uniform(0.0, 6.0))
    in_room = [gtsam.Pose2(*row) for row in np.column_stack([x, y, yaw])]
    T_map_room = in_room[0].inverse()
    home = assemble(_things(T_map_room, rng), [Room("room", (0, 0, LENGTH_M, WIDTH_M))], [], (0.0, 0.0, 0.0))
    true_poses = [T_map_room.compose(pose) for pose in in_room]
    caster, camera = Scene(home), RIGS["yang2021"].cameras[0]
    frames = []
    for index, pose in enumerate(true_poses):
        image = render_rgbd(caster, gtsam.Pose3(pose).compose(camera.T_base_camera), camera.model, rng)
        images = (image.color, image.depth_m, camera.model.intrinsics)
        frames.append(RgbdFrame(float(index), *images, camera.T_base_camera))
    errors = ndimage.gaussian_filter1d(rng.standard_normal((KEYFRAMES, 3)), _SMOOTH_KEYFRAMES, axis=0)
    errors *= np.array([POSE_SIGMA_M, POSE_SIGMA_M, POSE_SIGMA_RAD]) / errors.std(axis=0)
    poses = [pose.compose(gtsam.Pose2(*row)) for pose, row in zip(true_poses, errors, strict=True)]
    return Run(home, frames, true_poses, poses, T_map_room)


def _things(T_map_room: gtsam.Pose2, rng: np.random.Generator) -> list[Thing]:
    """All that stands in the room, in the map frame."""
    middle, half = (0.5 * LENGTH_M, 0.5 * WIDTH_M), (0.5 * LENGTH_M, 0.5 * WIDTH_M)
    thick = 0.5 * WALL_M
    boxes = [
        ("wall", (-thick, middle[1]), (thick, half[1] + WALL_M), 2.5),
        ("wall", (LENGTH_M + thick, middle[1]), (thick, half[1] + WALL_M), 2.5),
        ("wall", (middle[0], -thick), (half[0], thick), 2.5),
        ("wall", (middle[0], WIDTH_M + thick), (half[0], thick), 2.5),
        ("cupboard", (0.225, 2.0), (0.225, 0.5), 1.2),
        ("platform", (0.75, 0.6), (0.45, 0.35), 0.10),
        ("sideboard", (2.55, 3.725), (0.5, 0.325), 0.55),
        ("box", (4.55, 3.3), (0.2, 0.15), 0.40),
        ("low_box", (4.5, 0.7), (0.16, 0.14), 0.05),
    ]
    floor = Part(middle, (half[0] + 1.0, half[1] + 1.0), -0.1, 0.0, style=Style.PLANKS)
    things = [Thing("floor", (floor,))]
    things += [Thing(kind, (Part(at, size, 0.0, height),)) for kind, at, size, height in boxes]
    seat = chair(rng)
    things.append(Thing("chair", tuple(part.placed(2.6, 0.1, 0.0) for part in seat.parts)))
    x, y, yaw = T_map_room.x(), T_map_room.y(), T_map_room.theta()
    return [Thing(thing.kind, tuple(part.placed(x, y, yaw) for part in thing.parts)) for thing in things]
