"""Generates an empty home: rooms on both sides of a corridor, with walls, doors, windows, floors, ceiling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from slam.measurements import FloatArray
from slam.simulation.home_model import Color, Door, Part, Rectangle, Room, Style, Thing
from slam.simulation.walls import HEIGHT_M, Kind, Opening, WallLine, wall_things

_SLAB_M = 0.1
_EDGE_M = 0.22  # of wall that remains next to an opening
_SWING_M = 0.85  # in front of a door, kept free of furniture
_LEAF_HALF_M = 0.02


@dataclass(frozen=True, slots=True)
class LayoutStyle:
    """Dimensions of a type of building; pairs are minimum and maximum."""

    purposes: tuple[str, ...]
    rooms: tuple[int, int]
    depth_m: tuple[float, float]
    width_m: tuple[float, float]
    corridor_m: tuple[float, float]
    door_m: tuple[float, float]
    side_door_share: float


STYLES = {
    "home": LayoutStyle(
        ("living", "bedroom", "kitchen", "bathroom", "study", "bedroom", "storage"),
        (4, 6),
        (3.2, 4.3),
        (2.7, 4.6),
        (1.4, 1.8),
        (0.9, 1.0),
        0.45,
    ),
    "office": LayoutStyle(
        ("openplan", "office", "meeting", "office", "copyroom", "office", "kitchen", "office"),
        (5, 8),
        (3.8, 5.0),
        (3.0, 5.2),
        (1.8, 2.4),
        (0.95, 1.1),
        0.25,
    ),
}


@dataclass
class RoomPlan:
    """A room before it is furnished.

    Attributes
    ----------
    room, purpose
        Room and purpose: ``bedroom2`` has the purpose ``bedroom``.
    doorways
        Points inside the room in front of its doors.
    kept_clear
        Rectangles without furniture.
    fixed
        Objects that exist from the start: open doors.
    """

    room: Room
    purpose: str
    doorways: list[tuple[float, float]] = field(default_factory=list)
    kept_clear: list[Rectangle] = field(default_factory=list)
    fixed: list[Thing] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Layout:
    """The empty home: its rooms, the corridor last; its doors; floors, ceiling and walls."""

    plans: list[RoomPlan]
    doors: list[Door]
    things: list[Thing]


def draw_layout(style: LayoutStyle, rooms: int, rng: np.random.Generator) -> Layout:
    """Draw the plan of a building.

    Parameters
    ----------
    rooms
        Number of rooms, two or more, without the corridor.
    """
    south = rooms // 2
    depths = rng.uniform(*style.depth_m, 2)
    corridor, thickness = rng.uniform(*style.corridor_m), rng.uniform(0.1, 0.16)
    length = float(rng.uniform(*style.width_m, rooms - south).sum())
    y = np.cumsum([0.0, depths[0], corridor + thickness, depths[1]])
    below, above = _divide(length, south, rng), _divide(length, rooms - south, rng)
    cells = [(below[i], y[0], below[i + 1], y[1]) for i in range(south)]
    cells += [(above[i], y[2], above[i + 1], y[3]) for i in range(rooms - south)]
    cells.append((0.0, y[1], length, y[2]))
    plans = _name_rooms([*_purposes(style, rooms, rng), "corridor"], cells, thickness)
    builder = _Builder(style, thickness, rng, plans)
    halls = {index: builder.corridor_openings(index, lower=index < south) for index in range(rooms)}
    builder.add_line(True, y[1], 0.0, length, [o for i in range(south) for o in halls[i]])
    builder.add_line(True, y[2], 0.0, length, [o for i in range(south, rooms) for o in halls[i]])
    builder.add_side_walls(below, (y[0], y[1]), 0)
    builder.add_side_walls(above, (y[2], y[3]), south)
    builder.add_outside(cells, y, length, south)
    return Layout(plans, builder.doors, [*_slabs(cells, thickness, rng), *builder.things])


def _divide(length: float, count: int, rng: np.random.Generator) -> FloatArray:
    """Unequal borders of rooms that share a length, (count + 1,)."""
    shares = rng.uniform(0.8, 1.25, count)
    return np.concatenate([[0.0], np.cumsum(shares / shares.sum())]) * length


def _purposes(style: LayoutStyle, rooms: int, rng: np.random.Generator) -> list[str]:
    """Purposes of the rooms: the first ones of the style always exist, the order is random."""
    names = [style.purposes[index % len(style.purposes)] for index in range(rooms)]
    return [names[index] for index in rng.permutation(rooms)]


def _name_rooms(purposes: Sequence[str], cells: Sequence[Rectangle], thickness: float) -> list[RoomPlan]:
    """Number the rooms of each type and subtract their walls."""
    half = 0.5 * thickness
    plans: list[RoomPlan] = []
    for index, (purpose, (x0, y0, x1, y1)) in enumerate(zip(purposes, cells, strict=True)):
        number = 1 + purposes[:index].count(purpose)
        inside = (float(x0 + half), float(y0 + half), float(x1 - half), float(y1 - half))
        plans.append(RoomPlan(Room(f"{purpose}{number}", inside), purpose))
    return plans


def _slabs(cells: Sequence[Rectangle], thickness: float, rng: np.random.Generator) -> list[Thing]:
    """A separate floor for each room, so that rooms look different, and one ceiling for all."""
    things = []
    # Also under the outer walls; the outermost cells extend by half a wall.
    east, north = max(cell[2] for cell in cells), max(cell[3] for cell in cells)
    half = 0.5 * thickness
    for x0, y0, x1, y1 in cells:
        x0, x1 = x0 - half * (x0 <= 0.0), x1 + half * (x1 >= east)
        y0, y1 = y0 - half * (y0 <= 0.0), y1 + half * (y1 >= north)
        style = Style.TILES if rng.random() < 0.35 else Style.PLANKS
        color = _tint((168, 150, 128), rng, 34)
        things.append(Thing("floor", (_slab((x0, y0, x1, y1), -_SLAB_M, style, color),)))
    outline = (-half, -half, east + half, north + half)
    return [*things, Thing("ceiling", (_slab(outline, HEIGHT_M, Style.PANELS, (226, 226, 222)),))]


def _slab(cell: Rectangle, z_low: float, style: Style, color: Color) -> Part:
    """A flat box over a rectangle."""
    x0, y0, x1, y1 = map(float, cell)
    center, half = (0.5 * (x0 + x1), 0.5 * (y0 + y1)), (0.5 * (x1 - x0), 0.5 * (y1 - y0))
    return Part(center, half, z_low, z_low + _SLAB_M, color=color, style=style)


def _tint(color: Color, rng: np.random.Generator, spread: int) -> Color:
    """A similar colour: lighter or darker, with a slightly different hue."""
    shade = int(rng.integers(-spread, spread + 1))
    r, g, b = (int(np.clip(c + shade + rng.integers(-12, 13), 20, 245)) for c in color)
    return r, g, b


class _Builder:
    """Collects walls and doors while a layout is drawn."""

    def __init__(
        self, style: LayoutStyle, thickness: float, rng: np.random.Generator, plans: list[RoomPlan]
    ) -> None:
        self._style, self._thickness, self._rng, self._plans = style, thickness, rng, plans
        self._color = _tint((206, 200, 186), rng, 24)
        self._panes = 0
        self.doors: list[Door] = []
        self.things: list[Thing] = []

    def add_line(
        self, along_x: bool, at: float, low: float, high: float, openings: Sequence[Opening]
    ) -> None:
        """Add a wall between two others: it ends at their faces; an outer one along x has the corners."""
        half = 0.5 * self._thickness
        ends = (low - half, high + half) if along_x else (low + half, high - half)
        line = WallLine(along_x, float(at), float(ends[0]), float(ends[1]), tuple(openings))
        self.things += wall_things(line, self._thickness, _tint(self._color, self._rng, 14))

    def corridor_openings(self, index: int, *, lower: bool) -> list[Opening]:
        """The door from a room to the corridor, and next to it a pane of glass if there is space."""
        x0, y0, x1, y1 = self._plans[index].room.rectangle
        wide = self._plans[index].purpose in {"living", "openplan"}
        width = float(self._rng.uniform(*self._style.door_m)) * (1.5 if wide else 1.0)
        width = min(width, x1 - x0 - 2.0 * _EDGE_M)
        low = float(self._rng.uniform(x0 + _EDGE_M, x1 - _EDGE_M - width))
        at = 0.5 * self._thickness + y1 if lower else y0 - 0.5 * self._thickness
        openings = [self._door(index, len(self._plans) - 1, True, at, low, width, leaf=not wide)]
        left, right = low - x0, x1 - (low + width)
        if max(left, right) > 1.4 and (self._panes == 0 or self._rng.random() < 0.25):
            self._panes += 1
            start = x0 + _EDGE_M if left > right else low + width + _EDGE_M
            end = min(start + 1.4, (low if left > right else x1) - _EDGE_M)
            openings.append(Opening(start, end, Kind.PANE))
            self._keep(index, start, end, y1 if lower else y0, -0.35 if lower else 0.35)
        return openings

    def add_side_walls(self, borders: FloatArray, span: tuple[float, float], first: int) -> None:
        """Add the walls between neighbours on one side of the corridor, some with a door."""
        for place in range(1, len(borders) - 1):
            openings = []
            if self._rng.random() < self._style.side_door_share:
                width = float(self._rng.uniform(*self._style.door_m))
                low = float(self._rng.uniform(span[0] + 0.4, span[1] - 0.4 - width))
                a = first + place - 1
                openings.append(self._door(a, a + 1, False, borders[place], low, width, leaf=False))
            self.add_line(False, borders[place], *span, openings)

    def add_outside(self, cells: Sequence[Rectangle], y: FloatArray, length: float, south: int) -> None:
        """Add the outer walls: one window per room, one of them a glass door down to the floor."""
        rooms = len(cells) - 1
        balcony = int(self._rng.integers(rooms))
        sides: tuple[list[Opening], list[Opening]] = ([], [])
        for index in range(rooms):
            x0, y0, x1, y1 = self._plans[index].room.rectangle
            width = min(float(self._rng.uniform(0.9, 1.7)), x1 - x0 - 2.0 * _EDGE_M)
            low = float(self._rng.uniform(x0 + _EDGE_M, x1 - _EDGE_M - width))
            kind = Kind.BALCONY if index == balcony else Kind.WINDOW
            sides[index >= south].append(Opening(low, low + width, kind))
            if kind == Kind.BALCONY:
                lower = index < south
                self._keep(index, low, low + width, y0 if lower else y1, 0.4 if lower else -0.4)
        self.add_line(True, y[0], 0.0, length, sides[0])
        self.add_line(True, y[3], 0.0, length, sides[1])
        for x in (0.0, length):
            self.add_line(False, x, y[0], y[1], ())
            middle = 0.5 * float(y[1] + y[2])
            self.add_line(False, x, y[1], y[2], [Opening(middle - 0.4, middle + 0.4, Kind.WINDOW)])
            self.add_line(False, x, y[2], y[3], ())

    def _door(
        self, a: int, b: int, along_x: bool, at: float, low: float, width: float, *, leaf: bool
    ) -> Opening:
        """Add a doorway between two rooms, with the space that it needs in both."""
        middle, offset = low + 0.5 * width, 0.5 * self._thickness
        center = (middle, float(at)) if along_x else (float(at), middle)
        self.doors.append(Door(self._plans[a].room.name, self._plans[b].room.name, center, width))
        for plan in (self._plans[a], self._plans[b]):
            x0, y0, x1, y1 = plan.room.rectangle
            inward = 1.0 if (0.5 * (y0 + y1) if along_x else 0.5 * (x0 + x1)) > at else -1.0
            face, deep = at + inward * offset, at + inward * (offset + 0.5)
            plan.doorways.append((middle, float(deep)) if along_x else (float(deep), middle))
            reach = sorted((float(face), float(face + inward * _SWING_M)))
            box = (low, reach[0], low + width, reach[1])
            plan.kept_clear.append(box if along_x else (box[1], box[0], box[3], box[2]))
        if leaf and self._rng.random() < 0.6:
            self._plans[a].fixed.append(self._leaf(low, width, at, self._plans[a].room))
        return Opening(low, low + width, Kind.DOOR, float(self._rng.choice([0.0, 0.006, 0.009])))

    def _leaf(self, low: float, width: float, at: float, room: Room) -> Thing:
        """A door open at a right angle to a wall along x, outside its doorway."""
        left = self._rng.random() < 0.5
        x = low - _LEAF_HALF_M if left else low + width + _LEAF_HALF_M
        inward = 1.0 if room.rectangle[1] > at else -1.0
        y = at + inward * 0.5 * (self._thickness + width)
        color = _tint((190, 160, 120), self._rng, 25)
        part = Part((x, float(y)), (_LEAF_HALF_M, 0.5 * width), 0.012, 2.0, color=color, style=Style.WOOD)
        return Thing("door", (part,))

    def _keep(self, index: int, low: float, high: float, face: float, depth: float) -> None:
        """Leave the space in front of glass free, so that the sensors meet it."""
        reach = sorted((float(face), float(face + depth)))
        self._plans[index].kept_clear.append((low, reach[0], high, reach[1]))
