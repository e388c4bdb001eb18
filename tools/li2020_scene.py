"""Li2020's experiment: a room with five obstacles, and a robot that sees them during a short drive.

Obstacle 1 is a box that both sensors see, 2 a box below the lidar's plane, 3 a chair, 4 a mat thinner than 1
cm, and 5 a box next to the robot, outside the camera's view.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from layer_homes import readings_at

from slam.measurements import LaserScan, RgbdFrame
from slam.simulation.furniture import chair
from slam.simulation.home_model import Home, Part, Room, Style, Thing, assemble
from slam.simulation.rigs import RIGS
from slam.simulation.scene import Scene

ROOM = (-1.8, -2.2, 4.2, 2.2)
WALL_M, HEIGHT_M = 0.1, 2.5
KEYFRAMES, STEP_M, WOBBLE_RAD = 12, 0.06, math.radians(3.0)
_STREAM = 20


@dataclass(frozen=True)
class Li2020Scene:
    """The room, and which of its obstacles bears which of the paper's numbers."""

    home: Home
    number_of: dict[int, int]
    seed: int


def draw_scene(seed: int) -> Li2020Scene:
    """The same five things a little elsewhere and of other sizes for each seed."""
    rng = np.random.default_rng([seed, _STREAM])
    things = _walls()
    first = len(things)
    things += [
        _box("tall_box", (2.2, 0.75), (0.18, 0.18), rng.uniform(0.45, 0.6), rng),
        _box("low_box", (2.0, -0.12), (0.16, 0.14), rng.uniform(0.08, 0.2), rng),
        _placed(chair(rng), (2.7, -0.95), rng),
        _box("mat", (1.6, 0.35), (0.2, 0.15), rng.uniform(0.004, 0.008), rng),
        _box("beside", (0.2, 1.45), (0.17, 0.17), rng.uniform(0.45, 0.6), rng),
    ]
    home = assemble(things, [Room("room", ROOM)], [], (0.0, 0.0, 0.0))
    return Li2020Scene(home, {first + index: index + 1 for index in range(5)}, seed)


def readings(scene: Li2020Scene) -> Iterator[tuple[LaserScan | RgbdFrame, gtsam.Pose2]]:
    """Scan and image of every keyframe of a short drive ahead, with the true pose of the robot."""
    rng = np.random.default_rng([scene.seed, _STREAM, 1])
    caster, rig = Scene(scene.home), RIGS["li2020"]
    for index in range(KEYFRAMES):
        yaw = rng.uniform(-WOBBLE_RAD, WOBBLE_RAD)
        base = gtsam.Pose2(STEP_M * index - 0.3, rng.uniform(-0.03, 0.03), yaw)
        yield from readings_at(base, caster, rig, float(index), rng)


def _walls() -> list[Thing]:
    """Floor and four walls."""
    x0, y0, x1, y1 = ROOM
    middle, half = (0.5 * (x0 + x1), 0.5 * (y0 + y1)), (0.5 * (x1 - x0), 0.5 * (y1 - y0))
    thick = 0.5 * WALL_M
    floor = Part(middle, (half[0] + 1.0, half[1] + 1.0), -0.1, 0.0, style=Style.PLANKS)
    sides = [
        *(Part((x, middle[1]), (thick, half[1] + WALL_M), 0.0, HEIGHT_M) for x in (x0 - thick, x1 + thick)),
        *(Part((middle[0], y), (half[0], thick), 0.0, HEIGHT_M) for y in (y0 - thick, y1 + thick)),
    ]
    return [Thing("floor", (floor,)), *(Thing("wall", (side,)) for side in sides)]


def _box(
    kind: str, at: tuple[float, float], half: tuple[float, float], height: float, rng: np.random.Generator
) -> Thing:
    """A box on the floor, turned and shifted at random."""
    return _placed(Thing(kind, (Part((0.0, 0.0), half, 0.0, height),)), at, rng)


def _placed(thing: Thing, at: tuple[float, float], rng: np.random.Generator) -> Thing:
    """A thing at a place, turned and shifted at random."""
    x, y = np.array(at) + rng.uniform(-0.08, 0.08, 2)
    yaw = float(rng.uniform(-math.pi, math.pi))
    return Thing(thing.kind, tuple(part.placed(float(x), float(y), yaw) for part in thing.parts))
