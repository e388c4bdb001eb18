"""The furniture catalogue: pieces made of boxes, with random dimensions and colours.

The origin of a piece is on the floor in the middle of its back, x to its right, y away from the wall.
Heights are deliberately distributed over the scan planes of sensors: toys and rugs below every lidar, a low
cupboard and a bench between a low and a higher one (0.20-0.30 m), table tops and shelves above them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from slam.simulation.home_model import Color, Material, Part, Style, Thing

Piece: TypeAlias = Callable[[np.random.Generator], Thing]

_WOODS: tuple[Color, ...] = ((176, 132, 84), (120, 82, 50), (214, 190, 150), (92, 64, 44), (232, 228, 220))
_FABRICS: tuple[Color, ...] = ((150, 60, 56), (64, 92, 140), (90, 128, 84), (170, 150, 120), (110, 100, 130))
_METAL: Color = (150, 152, 156)
_BLACK: Color = (24, 23, 26)


def _pick(colors: tuple[Color, ...], rng: np.random.Generator) -> Color:
    """One of the colours, slightly varied."""
    base = colors[int(rng.integers(len(colors)))]
    r, g, b = (int(np.clip(c + rng.integers(-14, 15), 8, 245)) for c in base)
    return r, g, b


def _box(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    color: Color,
    style: Style = Style.WOOD,
    material: Material = Material.MATTE,
) -> Part:
    """A part defined by its extent along the piece's axes."""
    center = (0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]))
    half = (0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0]))
    return Part(center, half, z[0], z[1], color=color, style=style, material=material)


def _solid(
    kind: str,
    size: tuple[float, float, float],
    color: Color,
    style: Style = Style.WOOD,
    material: Material = Material.MATTE,
) -> Thing:
    """A piece that is one box: width, depth, height."""
    width, depth, height = size
    half = 0.5 * width
    return Thing(kind, (_box((-half, half), (0.0, depth), (0.0, height), color, style, material),))


def _legs(width: float, depth: float, height: float, thick: float, color: Color) -> list[Part]:
    """Four legs at the corners."""
    half = 0.5 * width
    return [
        _box(x, y, (0.0, height), color)
        for x in ((-half, -half + thick), (half - thick, half))
        for y in ((0.0, thick), (depth - thick, depth))
    ]


def table(rng: np.random.Generator) -> Thing:
    """A table: a lidar sees its legs, a camera its top."""
    width, depth, height = rng.uniform(1.0, 1.7), rng.uniform(0.7, 0.95), rng.uniform(0.71, 0.76)
    color, half = _pick(_WOODS, rng), 0.5 * width
    top = _box((-half, half), (0.0, depth), (height - 0.03, height), color)
    return Thing("table", (top, *_legs(width, depth, height - 0.03, 0.05, color)))


def coffee_table(rng: np.random.Generator) -> Thing:
    """A low table on legs, its top above a low lidar."""
    width, depth, height = rng.uniform(0.7, 1.1), rng.uniform(0.5, 0.65), rng.uniform(0.38, 0.45)
    color, half = _pick(_WOODS, rng), 0.5 * width
    top = _box((-half, half), (0.0, depth), (height - 0.04, height), color)
    return Thing("coffee_table", (top, *_legs(width, depth, height - 0.04, 0.05, color)))


def desk(rng: np.random.Generator) -> Thing:
    """A desk with drawers on one side and a dark screen on top."""
    width, depth, height = rng.uniform(1.1, 1.6), rng.uniform(0.6, 0.75), 0.73
    color, half = _pick(_WOODS, rng), 0.5 * width
    screen = rng.uniform(-half + 0.35, half - 0.35)
    parts = (
        _box((-half, half), (0.0, depth), (height - 0.03, height), color),
        _box((-half, -half + 0.4), (0.05, depth - 0.05), (0.03, height - 0.03), color),
        _box((half - 0.04, half), (0.0, depth), (0.0, height - 0.03), color),
        _box((screen - 0.27, screen + 0.27), (0.12, 0.15), (0.84, 1.17), _BLACK, Style.SMOOTH, Material.DARK),
        _box((screen - 0.04, screen + 0.04), (0.1, 0.17), (height, 0.84), _METAL, Style.SMOOTH),
    )
    return Thing("desk", parts)


def chair(rng: np.random.Generator) -> Thing:
    """Four thin legs, a seat and a back."""
    color, seat = _pick(_WOODS, rng), rng.uniform(0.43, 0.47)
    cushion = _pick(_FABRICS, rng)
    parts = (
        _box((-0.21, 0.21), (0.0, 0.42), (seat - 0.04, seat), cushion, Style.FABRIC),
        _box((-0.21, 0.21), (0.0, 0.03), (seat, seat + 0.45), color, Style.FABRIC),
        *_legs(0.42, 0.42, seat - 0.04, 0.035, color),
    )
    return Thing("chair", parts)


def bed(rng: np.random.Generator) -> Thing:
    """A bed with a mattress over a gap that is visible to a low sensor, and a headboard."""
    width, length, top = rng.uniform(0.95, 1.65), rng.uniform(1.95, 2.1), rng.uniform(0.45, 0.55)
    half, color = 0.5 * width, _pick(_WOODS, rng)
    parts = (
        _box((-half, half), (0.05, length), (0.22, top), _pick(_FABRICS, rng), Style.FABRIC),
        _box((-half, half), (0.0, 0.05), (0.0, 0.95), color),
        *_legs(width, length, 0.22, 0.08, color),
    )
    return Thing("bed", parts)


def sofa(rng: np.random.Generator) -> Thing:
    """Seat, back and two arms."""
    width, color = rng.uniform(1.5, 2.2), _pick(_FABRICS, rng)
    half = 0.5 * width
    parts = (
        _box((-half, half), (0.22, 0.88), (0.0, 0.43), color, Style.FABRIC),
        _box((-half, half), (0.0, 0.22), (0.0, 0.84), color, Style.FABRIC),
        _box((-half, -half + 0.16), (0.22, 0.88), (0.43, 0.62), color, Style.FABRIC),
        _box((half - 0.16, half), (0.22, 0.88), (0.43, 0.62), color, Style.FABRIC),
    )
    return Thing("sofa", parts)


def bookcase(rng: np.random.Generator) -> Thing:
    """A tall case full of books."""
    size = (rng.uniform(0.7, 1.3), rng.uniform(0.26, 0.34), rng.uniform(1.6, 2.05))
    return _solid("bookcase", size, _pick(_WOODS, rng), Style.BOOKS)


def wardrobe(rng: np.random.Generator) -> Thing:
    """A tall closed cupboard."""
    size = (rng.uniform(0.9, 1.6), rng.uniform(0.52, 0.62), rng.uniform(1.9, 2.2))
    return _solid("wardrobe", size, _pick(_WOODS, rng))


def low_cupboard(rng: np.random.Generator) -> Thing:
    """A cupboard with its top between the planes of a low lidar and a higher one, below a camera's view."""
    size = (rng.uniform(0.6, 1.1), rng.uniform(0.3, 0.42), rng.uniform(0.2, 0.29))
    return _solid("low_cupboard", size, _pick(_WOODS, rng))


def cupboard(rng: np.random.Generator) -> Thing:
    """A sideboard, higher than every lidar."""
    size = (rng.uniform(0.8, 1.5), rng.uniform(0.36, 0.46), rng.uniform(0.6, 0.9))
    return _solid("cupboard", size, _pick(_WOODS, rng))


def bench(rng: np.random.Generator) -> Thing:
    """A plank on two blocks, its underside near a lidar's plane."""
    width, top, color = rng.uniform(0.9, 1.4), rng.uniform(0.3, 0.42), _pick(_WOODS, rng)
    half = 0.5 * width
    parts = (
        _box((-half, half), (0.0, 0.36), (top - 0.05, top), color),
        _box((-half + 0.08, -half + 0.14), (0.03, 0.33), (0.0, top - 0.05), color),
        _box((half - 0.14, half - 0.08), (0.03, 0.33), (0.0, top - 0.05), color),
    )
    return Thing("bench", parts)


def television(rng: np.random.Generator) -> Thing:
    """A dark screen on a low stand."""
    width, color = rng.uniform(0.9, 1.3), _pick(_WOODS, rng)
    half = 0.5 * width
    parts = (
        _box((-half - 0.1, half + 0.1), (0.0, 0.4), (0.0, 0.42), color),
        _box((-half, half), (0.12, 0.16), (0.46, 1.08), _BLACK, Style.SMOOTH, Material.DARK),
        _box((-0.15, 0.15), (0.08, 0.2), (0.42, 0.46), _BLACK, Style.SMOOTH, Material.DARK),
    )
    return Thing("television", parts)


def dark_cabinet(rng: np.random.Generator) -> Thing:
    """A black lacquered cabinet, which absorbs infrared light at all heights."""
    size = (rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.5), rng.uniform(0.8, 1.4))
    return _solid("dark_cabinet", size, _BLACK, Style.SMOOTH, Material.DARK)


def fridge(rng: np.random.Generator) -> Thing:
    """A metal door that reflects light."""
    size = (0.6, 0.62, rng.uniform(1.5, 1.9))
    return _solid("fridge", size, _METAL, Style.SMOOTH, Material.SHINY)


def counter(rng: np.random.Generator) -> Thing:
    """A kitchen counter whose top protrudes over the toe space."""
    width, color = rng.uniform(1.2, 2.0), _pick(_WOODS, rng)
    half = 0.5 * width
    parts = (
        _box((-half, half), (0.0, 0.53), (0.0, 0.1), _BLACK, Style.SMOOTH, Material.DARK),
        _box((-half, half), (0.0, 0.58), (0.1, 0.87), color),
        _box((-half, half), (0.0, 0.62), (0.87, 0.91), (200, 198, 190), Style.TILES),
    )
    return Thing("counter", parts)


def bathtub(rng: np.random.Generator) -> Thing:
    """A white tub."""
    return _solid(
        "bathtub", (1.6, 0.72, rng.uniform(0.52, 0.6)), (232, 234, 236), Style.TILES, Material.SHINY
    )


def basin(rng: np.random.Generator) -> Thing:
    """A wash basin that is mounted above the floor."""
    parts = (
        _box((-0.3, 0.3), (0.0, 0.45), (0.68, 0.86), (230, 232, 234), Style.SMOOTH),
        _box((-0.09, 0.09), (0.0, 0.18), (0.0, 0.68), (230, 232, 234), Style.SMOOTH),
    )
    return Thing("basin", parts)


def wall_shelf(rng: np.random.Generator) -> Thing:
    """An overhanging shelf: nothing below it for a lidar to see."""
    width, z = rng.uniform(0.7, 1.2), rng.uniform(0.5, 1.05)
    half = 0.5 * width
    parts = (
        _box((-half, half), (0.0, 0.3), (z, z + 0.03), _pick(_WOODS, rng)),
        _box((-half + 0.1, half - 0.1), (0.02, 0.2), (z + 0.03, z + 0.27), _pick(_WOODS, rng), Style.BOOKS),
    )
    return Thing("wall_shelf", parts)


def plant(rng: np.random.Generator) -> Thing:
    """A pot with a bush."""
    pot, bush = rng.uniform(0.13, 0.18), rng.uniform(0.2, 0.28)
    top = rng.uniform(0.8, 1.4)
    parts = (
        _box((-pot, pot), (bush - pot, bush + pot), (0.0, 0.3), (150, 88, 60), Style.SMOOTH),
        _box((-bush, bush), (0.0, 2.0 * bush), (0.42, top), (70, 112, 58), Style.FABRIC),
        _box((-0.03, 0.03), (bush - 0.03, bush + 0.03), (0.3, 0.42), (84, 70, 50), Style.WOOD),
    )
    return Thing("plant", parts)


def toy_box(rng: np.random.Generator) -> Thing:
    """A box below every lidar."""
    size = (rng.uniform(0.25, 0.45), rng.uniform(0.2, 0.35), rng.uniform(0.08, 0.17))
    return _solid("toy_box", size, _pick(_FABRICS, rng), Style.FABRIC)


def bin_or_case(rng: np.random.Generator) -> Thing:
    """A waste bin."""
    size = (rng.uniform(0.25, 0.35), rng.uniform(0.25, 0.35), rng.uniform(0.35, 0.55))
    return _solid("bin", size, _pick(_FABRICS, rng), Style.SMOOTH)


def copier(rng: np.random.Generator) -> Thing:
    """An office copier."""
    size = (rng.uniform(0.6, 0.75), rng.uniform(0.6, 0.7), rng.uniform(0.95, 1.15))
    return _solid("copier", size, (196, 198, 200), Style.PANELS, Material.SHINY)


def rug(rng: np.random.Generator) -> Thing:
    """A rug thinner than 1 cm, which stops no robot."""
    size = (rng.uniform(1.0, 1.9), rng.uniform(0.8, 1.3), 0.006)
    return _solid("rug", size, _pick(_FABRICS, rng), Style.FABRIC)
