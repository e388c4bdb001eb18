"""Generates furnished homes and offices from a seed; a robot can reach every room."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.errors import ConfigError
from slam.measurements import BoolArray
from slam.simulation.floor_layout import STYLES, Layout, draw_layout
from slam.simulation.furnishing import OBSTACLE_Z_M, PASSABLE_RADIUS_M, furnish
from slam.simulation.home_model import Door, Home, Material, Obstacle, Part, Room, Style, Thing, assemble
from slam.simulation.rearranging import rearrange
from slam.simulation.true_grid import TrueGrid, drivable_cells, largest_region, true_grid

__all__ = [
    "Door",
    "Home",
    "Material",
    "Obstacle",
    "Part",
    "Room",
    "Style",
    "Thing",
    "TrueGrid",
    "assemble",
    "generate_home",
    "rooms_out_of_reach",
    "true_grid",
]

log = logging.getLogger(__name__)

_CELL_M = 0.05
_FEWEST_ROOMS, _MOST_ROOMS = 2, 40
_TRIES = 16
_SMALLEST_AREA_M2 = 0.3  # of drivable floor, for a room to count as reachable


def generate_home(
    seed: int, kind: str = "home", *, rooms: int | None = None, moved: int = 0, day: int = 0
) -> Home:
    """Draw a building and furnish it.

    Parameters
    ----------
    seed
        The same seed gives the same home.
    kind
        ``home`` or ``office``.
    rooms
        Number of rooms, without the corridor; None draws a usual number.
    moved
        Number of pieces of furniture that are moved, removed or added; see `Home.changes`.
    day
        Seed of these changes.

    Returns
    -------
    A home with one corridor and rooms on both sides of it. A robot of radius 0.25 m can reach all of them.

    Raises
    ------
    ConfigError
        An unknown kind, a number of rooms outside 2..40, or a seed without a path to all rooms (none is
        known).
    """
    if kind not in STYLES:
        raise ConfigError(f"kind of home is {kind!r}; choose one of {', '.join(STYLES)}")
    if rooms is not None and not _FEWEST_ROOMS <= rooms <= _MOST_ROOMS:
        raise ConfigError(f"rooms is {rooms}; give a number from {_FEWEST_ROOMS} to {_MOST_ROOMS}")
    rng = np.random.default_rng([seed, sorted(STYLES).index(kind)])
    style = STYLES[kind]
    count = int(rng.integers(style.rooms[0], style.rooms[1] + 1)) if rooms is None else rooms
    layout = draw_layout(style, count, rng)
    furnished = [furnish(plan, rng) for plan in layout.plans]
    home = _build(layout, furnished)
    # Each room was checked separately; check the whole home, and try again if that fails.
    while blocked := rooms_out_of_reach(home, PASSABLE_RADIUS_M - _CELL_M):
        inside = [i for i, plan in enumerate(layout.plans) if plan.room.name in blocked and furnished[i]]
        anywhere = [i for i, pieces in enumerate(furnished) if pieces]
        if not anywhere:
            raise ConfigError(
                f"seed {seed} draws a {kind} with {', '.join(blocked)} shut off; use another seed"
            )
        room = (inside or anywhere)[-1]
        taken = furnished[room].pop()
        log.info("took a %s out of %s: it was in the way", taken.kind, layout.plans[room].room.name)
        home = _build(layout, furnished)
    if not moved:
        return home
    rng = np.random.default_rng([seed, sorted(STYLES).index(kind), day])
    for _ in range(_TRIES):
        after, changes = rearrange(layout.plans, furnished, moved, rng)
        home = replace(_build(layout, after), changes=tuple(changes))
        if not rooms_out_of_reach(home, PASSABLE_RADIUS_M - _CELL_M):
            return home
    raise ConfigError(f"no way to move {moved} things in {kind} {seed}; move fewer, or use another seed")


def rooms_out_of_reach(home: Home, radius_m: float) -> list[str]:
    """Names of the rooms into which a robot of this radius cannot drive from the start."""
    grid = true_grid(home, *OBSTACLE_Z_M, _CELL_M)
    region = largest_region(drivable_cells(grid.occupied, _CELL_M, radius_m))
    start = _cells_of((*home.start_xy_yaw[:2], *home.start_xy_yaw[:2]), grid)
    if not region[start].any():
        return [room.name for room in home.rooms]
    least = _SMALLEST_AREA_M2 / _CELL_M**2
    return [
        room.name for room in home.rooms if np.count_nonzero(region[_cells_of(room.rectangle, grid)]) < least
    ]


def _build(layout: Layout, furnished: Sequence[Sequence[Thing]]) -> Home:
    """Build the home with its remaining furniture, and a start pose along the corridor."""
    things = list(layout.things)
    for plan, pieces in zip(layout.plans, furnished, strict=True):
        things += [*plan.fixed, *pieces]
    rooms = [plan.room for plan in layout.plans]
    home = assemble(things, rooms, layout.doors, (0.0, 0.0, 0.0))
    grid = true_grid(home, *OBSTACLE_Z_M, _CELL_M)
    region = largest_region(drivable_cells(grid.occupied, _CELL_M, PASSABLE_RADIUS_M))
    start = _roomiest_in(rooms[-1], grid, region)
    return assemble(things, rooms, layout.doors, (*start, 0.0))


def _roomiest_in(room: Room, grid: TrueGrid, region: BoolArray) -> tuple[float, float]:
    """Centre of the drivable cell of a room nearest to its middle line, at a third of its length."""
    x0, y0, x1, y1 = room.rectangle
    rows, cols = np.nonzero(region)
    x = grid.origin_xy[0] + (cols + 0.5) * grid.resolution_m
    y = grid.origin_xy[1] + (rows + 0.5) * grid.resolution_m
    if not x.size:
        return 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    best = int(np.argmin((x - (2.0 * x0 + x1) / 3.0) ** 2 + (y - 0.5 * (y0 + y1)) ** 2))
    return float(x[best]), float(y[best])


def _cells_of(rectangle: tuple[float, float, float, float], grid: TrueGrid) -> tuple[slice, slice]:
    """The cells that contain a rectangle or a point."""
    x0, y0, x1, y1 = rectangle
    col, row = (int((v - o) / grid.resolution_m) for v, o in zip((x0, y0), grid.origin_xy, strict=True))
    col_end, row_end = (
        int((v - o) / grid.resolution_m) + 1 for v, o in zip((x1, y1), grid.origin_xy, strict=True)
    )
    return slice(row, row_end), slice(col, col_end)
