"""The model of a simulated home: solid parts, their mesh, and the object that each part belongs to.

Frame map: x and y in the plane of the floor, z up, floor at z = 0. Metres and radians.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.measurements import BoolArray, Float32Array, FloatArray

Rectangle: TypeAlias = tuple[float, float, float, float]
Color: TypeAlias = tuple[int, int, int]
Int32Array: TypeAlias = NDArray[np.int32]


class Material(IntEnum):
    """Optical behaviour of a surface, the cause of most faults."""

    MATTE = 0
    DARK = 1  # absorbs the light of the sensor
    GLASS = 2  # transmits it, or reflects it away
    WINDOW = 3  # glass with daylight behind it, which blinds a depth camera
    SHINY = 4  # metal, lacquer: reflects light to another surface


class Style(IntEnum):
    """Pattern of a surface; see `slam.simulation.texture`."""

    PLASTER = 0
    PLANKS = 1
    TILES = 2
    WOOD = 3
    FABRIC = 4
    BOOKS = 5
    PANELS = 6
    SMOOTH = 7
    SKY = 8


@dataclass(frozen=True, slots=True)
class Part:
    """An upright box, rotated about its vertical axis.

    Attributes
    ----------
    center_xy, half_xy
        Centre of the footprint, and half its size along its own axes.
    yaw_rad
        Rotation of these axes in the frame.
    z_low_m, z_high_m
        Lowest and highest z.
    color, style, material
        Appearance of all its faces.
    """

    center_xy: tuple[float, float]
    half_xy: tuple[float, float]
    z_low_m: float
    z_high_m: float
    yaw_rad: float = 0.0
    color: Color = (180, 170, 155)
    style: Style = Style.WOOD
    material: Material = Material.MATTE

    def placed(self, x_m: float, y_m: float, yaw_rad: float) -> Part:
        """Transform a part from the frame of a piece of furniture at this pose."""
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        px, py = self.center_xy
        center = (x_m + c * px - s * py, y_m + s * px + c * py)
        return replace(self, center_xy=center, yaw_rad=self.yaw_rad + yaw_rad)

    def corners_xy(self) -> FloatArray:
        """(4, 2) corners of the footprint, counter-clockwise."""
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        hx, hy = self.half_xy
        local = np.array([[-hx, -hy], [hx, -hy], [hx, hy], [-hx, hy]])
        return local @ np.array([[c, s], [-s, c]]) + self.center_xy


@dataclass(frozen=True, slots=True)
class Thing:
    """Parts that form one obstacle: a wall, a table with its legs."""

    kind: str
    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True)
class Rearrangement:
    """A piece of furniture that was moved between two days.

    Attributes
    ----------
    before, after
        Before and after the change; None if it was added or removed.
    """

    before: Thing | None
    after: Thing | None


@dataclass(frozen=True, slots=True)
class Obstacle:
    """One object of the home.

    Attributes
    ----------
    id
        Its index in `Home.obstacles`.
    kind
        ``floor``, ``ceiling``, ``wall``, ``table``, ...
    box
        (2, 3) minimum and maximum corner, map frame.
    """

    id: int
    kind: str
    box: FloatArray


@dataclass(frozen=True, slots=True)
class Room:
    """A room; its rectangle is x0, y0, x1, y1 between the inner faces of its walls."""

    name: str
    rectangle: Rectangle


@dataclass(frozen=True, slots=True)
class Door:
    """An open doorway between two rooms, with its clear width."""

    room_a: str
    room_b: str
    center_xy: tuple[float, float]
    width_m: float


@dataclass(frozen=True, slots=True)
class WallTag:
    """A printed tag on a wall.

    Attributes
    ----------
    number
        Number in the tag family.
    T_map_tag
        Its centre: x to the right as seen by a viewer, y up, z out of the wall.
    side_m
        Side of the black square.
    cells
        (n, n) white cells of the paper: a white border, a black one, and the bits inside; the upper row
        first.
    """

    number: int
    T_map_tag: gtsam.Pose3
    side_m: float
    cells: BoolArray


@dataclass(frozen=True)
class Home:
    """A furnished home or office.

    Attributes
    ----------
    vertices, triangles
        (V, 3) metres, map frame; (T, 3) counter-clockwise seen from outside the solid.
    obstacle_of_triangle, material_of_triangle, style_of_triangle, color_of_triangle
        (T,) index into the obstacles; (T,) `Material`; (T,) `Style`; (T, 3) RGB.
    obstacles, parts, obstacle_of_part
        The objects, their solids, and (P,) the object of each solid.
    rooms, doors
        Corridors are rooms too.
    start_xy_yaw
        A pose where a robot fits.
    changes
        Differences to the home of the seed alone.
    tags
        Tags on its walls.
    """

    vertices: Float32Array
    triangles: Int32Array
    obstacle_of_triangle: Int32Array
    material_of_triangle: NDArray[np.uint8]
    style_of_triangle: NDArray[np.uint8]
    color_of_triangle: NDArray[np.uint8]
    obstacles: tuple[Obstacle, ...]
    parts: tuple[Part, ...]
    obstacle_of_part: Int32Array
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    start_xy_yaw: tuple[float, float, float]
    changes: tuple[Rearrangement, ...] = ()
    tags: tuple[WallTag, ...] = ()


# Corners of a box are 0-3 below and 4-7 above, counter-clockwise; outward faces, two triangles each.
BOX_TRIANGLES = np.array(
    [
        *([0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]),
        *([0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5]),
        *([2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]),
    ],
    dtype=np.int32,
)


def assemble(
    things: Sequence[Thing],
    rooms: Sequence[Room],
    doors: Sequence[Door],
    start_xy_yaw: tuple[float, float, float],
) -> Home:
    """Create the mesh of all objects.

    Parameters
    ----------
    things
        At least one, each of at least one part; their order gives the ids.
    """
    parts = [part for thing in things for part in thing.parts]
    owner = [index for index, thing in enumerate(things) for _ in thing.parts]
    corners = np.stack([_corners(part) for part in parts])
    count, faces = len(parts), len(BOX_TRIANGLES)
    triangles = BOX_TRIANGLES[None] + 8 * np.arange(count, dtype=np.int32)[:, None, None]
    obstacles = []
    for index, thing in enumerate(things):
        own = corners[[part for part, owns in enumerate(owner) if owns == index]].reshape(-1, 3)
        obstacles.append(Obstacle(index, thing.kind, np.stack([own.min(axis=0), own.max(axis=0)])))
    return Home(
        vertices=corners.reshape(-1, 3).astype(np.float32),
        triangles=triangles.reshape(-1, 3),
        obstacle_of_triangle=np.repeat(np.array(owner, dtype=np.int32), faces),
        material_of_triangle=np.repeat(np.array([p.material for p in parts], dtype=np.uint8), faces),
        style_of_triangle=np.repeat(np.array([p.style for p in parts], dtype=np.uint8), faces),
        color_of_triangle=np.repeat(np.array([p.color for p in parts], dtype=np.uint8), faces, axis=0),
        obstacles=tuple(obstacles),
        parts=tuple(parts),
        obstacle_of_part=np.array(owner, dtype=np.int32),
        rooms=tuple(rooms),
        doors=tuple(doors),
        start_xy_yaw=start_xy_yaw,
    )


def _corners(part: Part) -> FloatArray:
    """(8, 3) corners of a part, the lower four first."""
    footprint = part.corners_xy()
    low = np.column_stack([footprint, np.full(4, part.z_low_m)])
    high = np.column_stack([footprint, np.full(4, part.z_high_m)])
    return np.vstack([low, high])
