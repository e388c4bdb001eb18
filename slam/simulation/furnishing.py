"""Furnishes rooms so that a robot can still reach everything."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.measurements import BoolArray
from slam.simulation import furniture as f
from slam.simulation.floor_layout import RoomPlan
from slam.simulation.home_model import Part, Rectangle, Thing
from slam.simulation.true_grid import drivable_cells, largest_region, occupied_cells

# Radius of the robot: 0.25 m, plus a margin for the cells of other grids.
PASSABLE_RADIUS_M = 0.32
OBSTACLE_Z_M = (0.01, 1.2)
_CELL_M = 0.05
_TRIES = 16
_WHOLE_SHARE = 0.97
_LEAST_DRIVABLE_SHARE = 0.2
_APART_M = 0.03
_WALL_GAP_M = 0.01

_WALL: dict[str, tuple[f.Piece, ...]] = {
    "living": (f.sofa, f.television, f.bookcase, f.low_cupboard, f.plant, f.cupboard, f.wall_shelf, f.bench),
    "bedroom": (f.bed, f.wardrobe, f.low_cupboard, f.dark_cabinet, f.wall_shelf, f.bin_or_case),
    "kitchen": (f.counter, f.fridge, f.cupboard, f.wall_shelf, f.bin_or_case, f.low_cupboard),
    "bathroom": (f.bathtub, f.basin, f.low_cupboard, f.cupboard),
    "study": (f.desk, f.bookcase, f.bookcase, f.dark_cabinet, f.plant, f.low_cupboard, f.wall_shelf),
    "storage": (f.wardrobe, f.bookcase, f.low_cupboard, f.bench, f.bin_or_case, f.dark_cabinet),
    "office": (f.desk, f.bookcase, f.desk, f.low_cupboard, f.bin_or_case, f.plant, f.wall_shelf),
    "openplan": (f.desk, f.desk, f.desk, f.bookcase, f.cupboard, f.plant, f.low_cupboard, f.dark_cabinet),
    "meeting": (f.television, f.cupboard, f.plant, f.low_cupboard, f.wall_shelf),
    "copyroom": (f.copier, f.copier, f.bookcase, f.low_cupboard, f.bin_or_case, f.dark_cabinet),
    "corridor": (f.low_cupboard, f.plant, f.bench, f.bin_or_case, f.wall_shelf),
}
_FREE: dict[str, tuple[f.Piece, ...]] = {
    "living": (f.rug, f.coffee_table, f.chair, f.toy_box, f.toy_box),
    "bedroom": (f.rug, f.toy_box, f.chair),
    "kitchen": (f.table, f.chair, f.chair, f.chair),
    "bathroom": (f.toy_box,),
    "study": (f.chair, f.rug, f.toy_box),
    "storage": (f.toy_box, f.bin_or_case),
    "office": (f.chair, f.chair, f.toy_box),
    "openplan": (f.table, f.chair, f.chair, f.chair, f.rug),
    "meeting": (f.table, f.chair, f.chair, f.chair, f.chair),
    "copyroom": (f.toy_box,),
    "corridor": (f.rug,),
}

# Furniture of a room by its purpose: at the walls, and anywhere.
OF_ROOMS = {purpose: (_WALL[purpose], _FREE[purpose]) for purpose in _WALL}


@dataclass
class _Site:
    """A room while it is furnished: its contents, as pieces and as cells."""

    plan: RoomPlan
    placed: list[Thing]
    blocked: BoolArray
    origin_xy: tuple[float, float]


def furnish(plan: RoomPlan, rng: np.random.Generator) -> list[Thing]:
    """Furnish one room.

    Every piece is tried at random positions; it is placed if it overlaps nothing, keeps the space at doors
    free, and leaves all doorways and nearly all free floor of the room in one drivable region.

    Parameters
    ----------
    plan
        The room, its doors, and its fixed contents.

    Returns
    -------
    The pieces in the map frame, without fixed ones.
    """
    site = _site(plan, plan.fixed, [part for thing in plan.fixed for part in thing.parts])
    for piece in _WALL[plan.purpose]:
        _try_places(site, piece(rng), rng, at_wall=True)
    for piece in _FREE[plan.purpose]:
        _try_places(site, piece(rng), rng, at_wall=False)
    return site.placed[len(plan.fixed) :]


def place_once_more(
    plan: RoomPlan, others: Sequence[Thing], thing: Thing, rng: np.random.Generator, at_wall: bool
) -> Thing | None:
    """Place a piece in a furnished room; None if it fits nowhere."""
    standing = [*plan.fixed, *others]
    site = _site(plan, standing, _low(standing))
    _try_places(site, thing, rng, at_wall=at_wall)
    return site.placed[-1] if len(site.placed) > len(standing) else None


def _site(plan: RoomPlan, standing: Sequence[Thing], parts: Sequence[Part]) -> _Site:
    """A room, its contents, and those parts that are obstacles."""
    x0, y0, x1, y1 = plan.room.rectangle
    shape = (math.ceil((y1 - y0) / _CELL_M), math.ceil((x1 - x0) / _CELL_M))
    return _Site(plan, list(standing), occupied_cells(parts, (x0, y0), shape, _CELL_M), (x0, y0))


def _low(things: Sequence[Thing]) -> list[Part]:
    """The parts that a robot could hit."""
    parts = [part for thing in things for part in thing.parts]
    return [part for part in parts if part.z_high_m > OBSTACLE_Z_M[0] and part.z_low_m < OBSTACLE_Z_M[1]]


def _try_places(site: _Site, thing: Thing, rng: np.random.Generator, *, at_wall: bool) -> None:
    """Place a piece where it fits, or omit it."""
    for _ in range(_TRIES):
        pose = _wall_pose(site.plan, thing, rng) if at_wall else _free_pose(site.plan, rng)
        candidate = Thing(thing.kind, tuple(part.placed(*pose) for part in thing.parts))
        if not _fits(site, candidate):
            continue
        blocked = site.blocked | occupied_cells(
            _low([candidate]), site.origin_xy, site.blocked.shape, _CELL_M
        )
        if _passable(site, blocked):
            site.blocked = blocked
            site.placed.append(candidate)
            return


def _wall_pose(plan: RoomPlan, thing: Thing, rng: np.random.Generator) -> tuple[float, float, float]:
    """A pose with the back to a random wall, sometimes not quite parallel to it."""
    x0, y0, x1, y1 = plan.room.rectangle
    width = np.ptp([corner for part in thing.parts for corner in part.corners_xy()[:, 0]])
    side = int(rng.choice(4, p=_side_shares(x1 - x0, y1 - y0)))
    length = (x1 - x0) if side % 2 == 0 else (y1 - y0)
    along = float(rng.uniform(0.5 * width, max(0.5 * width, length - 0.5 * width)))
    tilt = float(rng.uniform(-0.12, 0.12)) if rng.random() < 0.25 else 0.0
    gap = _WALL_GAP_M + 0.5 * float(width) * abs(math.sin(tilt))
    if side == 0:
        return x0 + along, y0 + gap, tilt
    if side == 1:
        return x1 - gap, y0 + along, 0.5 * math.pi + tilt
    if side == 2:
        return x0 + along, y1 - gap, math.pi + tilt
    return x0 + gap, y0 + along, -0.5 * math.pi + tilt


def _side_shares(width: float, depth: float) -> list[float]:
    """Probability of each wall by its length, so that a corridor is furnished along its sides."""
    total = 2.0 * (width**2 + depth**2)
    return [width**2 / total, depth**2 / total, width**2 / total, depth**2 / total]


def _free_pose(plan: RoomPlan, rng: np.random.Generator) -> tuple[float, float, float]:
    """A random position with a random rotation."""
    x0, y0, x1, y1 = plan.room.rectangle
    return float(rng.uniform(x0, x1)), float(rng.uniform(y0, y1)), float(rng.uniform(-math.pi, math.pi))


def _fits(site: _Site, candidate: Thing) -> bool:
    """Whether it is inside the room, apart from all other pieces, and outside of free spaces."""
    x0, y0, x1, y1 = site.plan.room.rectangle
    corners = np.concatenate([part.corners_xy() for part in candidate.parts])
    if (corners < (x0 + 0.001, y0 + 0.001)).any() or (corners > (x1 - 0.001, y1 - 0.001)).any():
        return False
    if any(_meets(part, _patch(area)) for area in site.plan.kept_clear for part in candidate.parts):
        return False
    return not any(
        _meets(mine, theirs)
        for thing in site.placed
        # Objects may stand on rugs.
        if "rug" not in {thing.kind, candidate.kind}
        for theirs in thing.parts
        for mine in candidate.parts
    )


def _patch(area: Rectangle) -> Part:
    """A rectangle as a part, for overlap tests."""
    x0, y0, x1, y1 = area
    return Part((0.5 * (x0 + x1), 0.5 * (y0 + y1)), (0.5 * (x1 - x0), 0.5 * (y1 - y0)), 0.0, 2.0)


def _meets(a: Part, b: Part) -> bool:
    """Whether two footprints are closer than the minimum gap (separating axes)."""
    dx, dy = b.center_xy[0] - a.center_xy[0], b.center_xy[1] - a.center_xy[1]
    if math.hypot(dx, dy) > math.hypot(*a.half_xy) + math.hypot(*b.half_xy) + _APART_M:
        return False
    for yaw in (a.yaw_rad, a.yaw_rad + 0.5 * math.pi, b.yaw_rad, b.yaw_rad + 0.5 * math.pi):
        reach = _reach(a, yaw) + _reach(b, yaw) + _APART_M
        if abs(math.cos(yaw) * dx + math.sin(yaw) * dy) >= reach:
            return False
    return True


def _reach(part: Part, yaw_rad: float) -> float:
    """Half the extent of a footprint along a direction."""
    turn = yaw_rad - part.yaw_rad
    return part.half_xy[0] * abs(math.cos(turn)) + part.half_xy[1] * abs(math.sin(turn))


def _passable(site: _Site, blocked: BoolArray) -> bool:
    """Whether a robot can still drive from every doorway to every other, and nothing large is cut off."""
    region, drivable = _region(site, blocked)
    if not _all_inside(region, site.plan.doorways, site.origin_xy):
        return False
    bare, _ = _region(site, np.zeros_like(blocked))
    inside = int(np.count_nonzero(region))
    # Small areas behind furniture may be cut off; a robot need not go there.
    connected = inside >= _WHOLE_SHARE * int(np.count_nonzero(drivable))
    return connected and inside >= _LEAST_DRIVABLE_SHARE * int(np.count_nonzero(bare))


def _region(site: _Site, blocked: BoolArray) -> tuple[BoolArray, BoolArray]:
    """The largest drivable region, and all drivable cells."""
    drivable = drivable_cells(blocked, _CELL_M, PASSABLE_RADIUS_M)
    return largest_region(drivable), drivable


def _all_inside(
    region: BoolArray, points: Sequence[tuple[float, float]], origin_xy: tuple[float, float]
) -> bool:
    """Whether all points are in the region."""
    cells = [(int((y - origin_xy[1]) / _CELL_M), int((x - origin_xy[0]) / _CELL_M)) for x, y in points]
    return all(region[row, col] for row, col in cells)
