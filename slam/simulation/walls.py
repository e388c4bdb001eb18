"""Builds thick walls: doorways with lintel and threshold, windows, panes of glass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from slam.simulation.home_model import Color, Material, Part, Style, Thing

HEIGHT_M = 2.5
_DOOR_TOP_M = 2.05
_SILL_M = 0.9
_PLINTH_M = 0.04  # height of the plinth under a pane of glass
_PANE_HALF_M = 0.006
_GLASS_COLOR, _SKY_COLOR, _METAL_COLOR = (196, 214, 210), (214, 232, 250), (120, 116, 110)


class Kind(IntEnum):
    """Type of an opening."""

    DOOR = 0
    PANE = 1  # glass down to the floor, with a room behind it
    WINDOW = 2
    BALCONY = 3  # glass down to the floor, with daylight behind it


@dataclass(frozen=True, slots=True)
class Opening:
    """An interval along a wall."""

    low_m: float
    high_m: float
    kind: Kind
    threshold_m: float = 0.0


@dataclass(frozen=True, slots=True)
class WallLine:
    """A straight wall along x or y.

    Attributes
    ----------
    along_x
        Whether it runs along x; otherwise along y.
    at_m
        Its centre line, the other coordinate.
    low_m, high_m
        Its start and end.
    openings
        Disjoint openings inside the wall.
    """

    along_x: bool
    at_m: float
    low_m: float
    high_m: float
    openings: tuple[Opening, ...] = ()


def wall_things(line: WallLine, thickness_m: float, color: Color) -> list[Thing]:
    """The solids of one wall: the wall itself, then thresholds, panes and windows as separate objects."""
    openings = sorted(line.openings, key=lambda opening: opening.low_m)
    solid: list[Part] = []
    others: list[Thing] = []
    at = line.low_m
    for opening in openings:
        if opening.low_m > at:
            solid.append(_piece(line, at, opening.low_m, thickness_m, 0.0, HEIGHT_M, color))
        others += _fill(line, opening, thickness_m)
        solid += _frame(line, opening, thickness_m, color)
        at = opening.high_m
    if line.high_m > at:
        solid.append(_piece(line, at, line.high_m, thickness_m, 0.0, HEIGHT_M, color))
    return [Thing("wall", tuple(solid)), *others]


def _piece(
    line: WallLine, low: float, high: float, thickness: float, z_low: float, z_high: float, color: Color
) -> Part:
    """A box of wall between two positions along it."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    center, halves = (middle, line.at_m), (half, 0.5 * thickness)
    if not line.along_x:
        center, halves = (line.at_m, middle), (0.5 * thickness, half)
    return Part(center, halves, z_low, z_high, color=color, style=Style.PLASTER)


def _frame(line: WallLine, opening: Opening, thickness: float, color: Color) -> Sequence[Part]:
    """The wall above and below an opening."""
    span = (opening.low_m, opening.high_m)
    parts = [_piece(line, *span, thickness, _DOOR_TOP_M, HEIGHT_M, color)]
    if opening.kind == Kind.WINDOW:
        parts.append(_piece(line, *span, thickness, 0.0, _SILL_M, color))
    elif opening.kind != Kind.DOOR:
        parts.append(_piece(line, *span, thickness, 0.0, _PLINTH_M, color))
    return parts


def _fill(line: WallLine, opening: Opening, thickness: float) -> list[Thing]:
    """The objects in the opening itself."""
    span = (opening.low_m, opening.high_m)
    if opening.kind == Kind.DOOR:
        if opening.threshold_m <= 0.0:
            return []
        strip = _piece(line, *span, thickness, 0.0, opening.threshold_m, _METAL_COLOR)
        return [Thing("threshold", (strip,))]
    low = _SILL_M if opening.kind == Kind.WINDOW else _PLINTH_M
    inside = opening.kind == Kind.PANE
    glass = _piece(line, *span, 2.0 * _PANE_HALF_M, low, _DOOR_TOP_M, _GLASS_COLOR if inside else _SKY_COLOR)
    pane = Part(
        glass.center_xy,
        glass.half_xy,
        glass.z_low_m,
        glass.z_high_m,
        color=glass.color,
        style=Style.SMOOTH if inside else Style.SKY,
        material=Material.GLASS if inside else Material.WINDOW,
    )
    return [Thing("glass" if inside else "window", (pane,))]
