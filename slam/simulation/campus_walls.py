"""Generates the walls of a campus, around corridors, doorways and rooms, and the objects in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from slam.measurements import BoolArray, FloatArray

_INWARD_M = 1e-6  # a wall that only touches another free area is kept
_WALL_M = 0.45  # between a corridor and its rooms: more than the recess of a closed door
_CLEAR_M = 1.3  # of wall next to a junction
_HALL_M = 4.0  # a wider corridor has two rows of pillars


@dataclass(frozen=True, slots=True, eq=False)
class Corridor:
    """A straight corridor between two junctions.

    Attributes
    ----------
    junctions
        Indices of the junctions.
    ends_m
        (2, 2) their positions, map frame.
    width_m
        Distance between the walls.
    style
        Seed of the door positions, equal for wings with the same pattern.
    door_pitch_m
        Distance between door positions.
    hand
        1, or -1 if the wing is mirrored.
    """

    junctions: tuple[int, int]
    ends_m: FloatArray
    width_m: float
    style: tuple[int, ...]
    door_pitch_m: float
    hand: int = 1

    @property
    def length_m(self) -> float:
        """Distance between the junctions."""
        return float(np.linalg.norm(self.ends_m[1] - self.ends_m[0]))

    def box(self, u0: float, u1: float, v0: float, v1: float) -> FloatArray:
        """Corners (4, 2) of a rectangle, map frame: u along from the first junction, v across to the left."""
        along = (self.ends_m[1] - self.ends_m[0]) / self.length_m
        axes = np.array([along, [-self.hand * along[1], self.hand * along[0]]])
        return np.asarray(self.ends_m[0] + np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]) @ axes)


def campus_walls(corridors: Sequence[Corridor], rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Return walls and glass, (W, 4) and (G, 4) rows of x1, y1, x2, y2.

    Parameters
    ----------
    rng
        For what differs between wings of one pattern: open doors and their rooms, furniture.
    """
    building = _Building(corridors, rng)
    for corridor in corridors:
        for side in (1, -1):
            building.furnish(corridor, side)
        if corridor.width_m > _HALL_M:
            for u in np.arange(4.0, corridor.length_m - 3.0, 5.5):
                building.solid += [corridor.box(u - 0.2, u + 0.2, v - 0.2, v + 0.2) for v in (-1.7, 1.7)]
    walls = outline(building.free, building.holes)
    return np.concatenate([walls, _edges(np.array(building.solid))]), np.array(building.glass).reshape(-1, 4)


@dataclass
class _Building:
    """Convex areas, (4, 2) each: free areas are surrounded by walls, holes only remove walls."""

    corridors: Sequence[Corridor]
    rng: np.random.Generator
    free: list[FloatArray] = field(default_factory=list)
    holes: list[FloatArray] = field(default_factory=list)
    solid: list[FloatArray] = field(default_factory=list)
    glass: list[FloatArray] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Create the empty corridors."""
        for corridor in self.corridors:
            (before, after), half = self._reaches_m(corridor), 0.5 * corridor.width_m
            self.free.append(corridor.box(-before, corridor.length_m + after, -half, half))

    def furnish(self, corridor: Corridor, side: int) -> None:
        """Add objects along one wall, at the positions of the pattern and with random numbers of the wing."""
        rhythm = np.random.default_rng([*corridor.style, 1 + side])
        (before, after), wall = self._reaches_m(corridor), 0.5 * corridor.width_m
        setback_m, half_door_m = rhythm.uniform(0.08, 0.35), rhythm.uniform(0.45, 0.58)
        first, last = before + _CLEAR_M + rhythm.uniform(0.0, 2.0), corridor.length_m - after - _CLEAR_M

        def box(u: float, half_m: float, low: float, high: float) -> FloatArray:
            return corridor.box(u - half_m, u + half_m, side * (wall + low), side * (wall + high))

        for u in np.arange(first, last, corridor.door_pitch_m).tolist():
            kind, size = rhythm.random(2).tolist()
            own, share = self.rng.random(2).tolist()
            if overlapping(box(u, 0.7, 0.05, 0.4), np.array(self.free[: len(self.corridors)])).any():
                continue  # another corridor passes here
            if kind < 0.5:
                room = box(u, 1.5 + 1.5 * size, _WALL_M, _WALL_M + 3.0 + 3.0 * share)
                is_open = own < 0.15 and self._add_room(room)
                self.free.append(box(u, half_door_m, -0.1, _WALL_M + 0.1 if is_open else setback_m))
            elif kind < 0.6:
                niche = box(u, 0.5 + size, -0.1, 0.4 + 0.6 * size)
                if not overlapping(niche, np.array(self.free))[len(self.corridors) :].any():
                    self.free.append(niche)
            elif kind < 0.68:
                self.solid.append(box(u, 0.2, -0.1 - 0.2 * size, 0.0))
            elif kind < 0.74:
                self.holes.append(box(u, 0.5 + size, -0.1, 0.1))
                self.glass.append(box(u, 0.5 + size, 0.0, 0.0)[:2].ravel())
            elif own < 0.12 and wall > 1.15:
                self.solid.append(box(u, 0.2 + 0.6 * share, -0.45, 0.0))

    def _reaches_m(self, corridor: Corridor) -> list[float]:
        """How far a corridor extends beyond its junctions: to the far wall of the widest corridor there."""
        return [
            max(
                (0.5 * o.width_m for o in self.corridors if o is not corridor and junction in o.junctions),
                default=0.0,
            )
            for junction in corridor.junctions
        ]

    def _add_room(self, room: FloatArray) -> bool:
        """Add a room with some boxes, unless another part of the building is there."""
        middle = room.mean(axis=0)
        if overlapping(middle + 1.2 * (room - middle), np.array(self.free)).any():
            return False
        self.free.append(room)
        for _ in range(int(self.rng.integers(1, 4))):
            place = middle + self.rng.uniform(-0.8, 0.8) * (room[self.rng.integers(0, 4)] - middle)
            self.solid.append(place + self.rng.uniform(0.1, 0.25) * (room - middle))
        return True


def outline(free: list[FloatArray], holes: list[FloatArray]) -> FloatArray:
    """Return the boundary of a union of convex areas: their edges without parts inside others, (N, 4).

    Parameters
    ----------
    free
        Corners of each area, (4, 2), in either orientation.
    holes
        Areas that remove edges of others and have none themselves.
    """
    areas = np.array(free + holes)
    pieces = []
    for index, area in enumerate(free):
        edges = _edges(area[None])
        enter, leave = _inside(edges, areas)
        leave[:, index] = -1.0  # an area does not cut its own edges
        for edge, starts, ends in zip(edges, enter, leave, strict=True):
            at, inside = 0.0, starts < ends
            spans = sorted(zip(starts[inside].tolist(), ends[inside].tolist(), strict=True))
            for low, high in [*spans, (1.0, 1.0)]:
                if low > at:
                    corners = [edge[:2] + share * (edge[2:] - edge[:2]) for share in (at, low)]
                    pieces.append(np.concatenate(corners))
                at = max(at, high)
    return np.array(pieces).reshape(-1, 4)


def overlapping(area: FloatArray, others: FloatArray) -> BoolArray:
    """Return which convex areas (N, 4, 2) an area (4, 2) overlaps, also if one contains the other."""
    enter, leave = _inside(_edges(area[None]), others)
    is_crossed = (enter < leave).any(axis=0)
    enter, leave = _inside(_edges(others), area[None])
    return np.asarray(is_crossed | (enter < leave).reshape(-1, 4).any(axis=1))


def _inside(edges: FloatArray, areas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the shares of its length between which each edge (E, 4) is inside each area (N, 4, 2), (E, N)
    each.

    It is outside if the second is not greater. M. Cyrus and J. Beck, "Generalized two- and three-dimensional
    clipping", Computers and Graphics 3(1), 1978.
    """
    sides = np.roll(areas, -1, axis=1) - areas
    normals = np.stack([sides[..., 1], -sides[..., 0]], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    # Normals point outward for either orientation of the corners.
    normals *= np.sign(((areas - areas.mean(axis=1, keepdims=True)) * normals).sum(axis=2, keepdims=True))
    # Inside is where normal . (start + t step - corner) < 0 for all four sides.
    slope = np.einsum("nsk,ek->ens", normals, edges[:, 2:] - edges[:, :2])
    room = (normals * areas).sum(axis=2) - _INWARD_M - np.einsum("nsk,ek->ens", normals, edges[:, :2])
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = room / slope
    parallel = np.where(room > 0.0, -np.inf, np.inf)
    enter = np.where(slope < 0.0, cut, np.where(slope > 0.0, -np.inf, parallel)).max(axis=2)
    leave = np.where(slope > 0.0, cut, np.inf).min(axis=2)
    return np.maximum(enter, 0.0), np.minimum(leave, 1.0)


def _edges(areas: FloatArray) -> FloatArray:
    """Return the edges of areas (N, 4, 2) as (4 N, 4) rows of x1, y1, x2, y2."""
    return np.concatenate([areas, np.roll(areas, -1, axis=1)], axis=2).reshape(-1, 4)
