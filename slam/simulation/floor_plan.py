"""A small 2D building: walls, furniture, a tour through it, and exact ray casting."""

from __future__ import annotations

import numpy as np

from slam.measurements import FloatArray

# A corridor 12 m long with three rooms on its south side and two on its north side. Metres.
_WEST, _EAST, _SOUTH, _NORTH = 0.0, 12.0, 0.0, 9.0
_CORRIDOR_SOUTH, _CORRIDOR_NORTH = 3.0, 5.0
_HALF_DOOR = 0.55

# Furniture: x, y of the lower left corner, width, depth. Irregular on purpose, so that no two rooms look
# alike.
_BOXES = (
    (0.0, 0.0, 1.0, 0.6),  # cupboard, room A
    (3.2, 2.3, 0.5, 0.5),
    (5.2, 0.0, 1.6, 0.5),  # bench, room B
    (7.3, 2.4, 0.4, 0.4),
    (10.9, 0.2, 0.8, 0.8),  # table, room C
    (8.3, 2.2, 0.4, 0.6),
    (0.3, 8.0, 2.0, 0.7),  # bed, room D
    (4.6, 5.2, 0.9, 0.4),
    (6.4, 8.3, 1.2, 0.5),  # shelf, room E
    (10.8, 5.3, 0.7, 1.5),
    (5.9, 3.1, 0.3, 0.3),  # pillar, corridor
)

# Two loops that both return to the first point: through the rooms on the north side, then those on the south
# side.
TOUR_M = np.array(
    [
        [1.0, 4.0],
        [9.0, 4.1],
        [9.0, 7.0],
        [3.0, 7.0],
        [3.0, 4.0],
        [1.0, 4.0],
        [10.0, 4.1],
        [10.0, 1.5],
        [6.0, 1.4],
        [2.0, 1.5],
        [2.0, 4.0],
        [1.0, 4.0],
    ]
)


def walls() -> FloatArray:
    """Return all wall and furniture edges, (N, 4) rows of x1, y1, x2, y2 in the map frame.

    The east end of the corridor is open and room E has a window: beams that leave there have no return.
    """
    lines: list[tuple[float, float, float, float]] = []
    lines += _horizontal(_SOUTH, _WEST, _EAST)
    lines += _horizontal(_NORTH, _WEST, _EAST, openings=((7.9, 9.6),))
    lines += _vertical(_WEST, _SOUTH, _NORTH)
    lines += _vertical(_EAST, _SOUTH, _NORTH, openings=((3.4, 4.7),))
    lines += _horizontal(_CORRIDOR_SOUTH, _WEST, _EAST, openings=(_door(2.0), _door(10.0)))
    lines += _horizontal(_CORRIDOR_NORTH, _WEST, _EAST, openings=(_door(3.0), _door(9.0)))
    lines += _vertical(4.0, _SOUTH, _CORRIDOR_SOUTH, openings=(_door(1.45),))
    lines += _vertical(8.0, _SOUTH, _CORRIDOR_SOUTH, openings=(_door(1.45),))
    lines += _vertical(6.0, _CORRIDOR_NORTH, _NORTH, openings=(_door(7.0),))
    for x, y, width, depth in _BOXES:
        lines += _horizontal(y, x, x + width) + _horizontal(y + depth, x, x + width)
        lines += _vertical(x, y, y + depth) + _vertical(x + width, y, y + depth)
    return np.array(lines)


def _door(center: float) -> tuple[float, float]:
    """Return the interval of a door along its wall."""
    return center - _HALF_DOOR, center + _HALF_DOOR


def _pieces(low: float, high: float, openings: tuple[tuple[float, float], ...]) -> list[tuple[float, float]]:
    """Subtract openings from an interval."""
    edges = [low, *(edge for opening in openings for edge in opening), high]
    return list(zip(edges[::2], edges[1::2], strict=True))


def _horizontal(
    y: float, x1: float, x2: float, openings: tuple[tuple[float, float], ...] = ()
) -> list[tuple[float, float, float, float]]:
    """A wall along x."""
    return [(a, y, b, y) for a, b in _pieces(x1, x2, openings)]


def _vertical(
    x: float, y1: float, y2: float, openings: tuple[tuple[float, float], ...] = ()
) -> list[tuple[float, float, float, float]]:
    """A wall along y."""
    return [(x, a, x, b) for a, b in _pieces(y1, y2, openings)]


def cast_rays(segments: FloatArray, origin_m: FloatArray, bearings_rad: FloatArray) -> FloatArray:
    """Compute the exact distance along every ray to the nearest segment, ``inf`` if there is none.

    Parameters
    ----------
    segments
        (S, 4) rows of x1, y1, x2, y2, same frame as the origin.
    origin_m
        (2,) origin of all rays.
    bearings_rad
        (N,) directions in that frame.

    Returns
    -------
    FloatArray
        (N,) metres.
    """
    # Ray o + r d meets segment p + s e where r = (p - o) x e / (d x e) and s = (p - o) x d / (d x e).
    direction_x, direction_y = np.cos(bearings_rad)[:, None], np.sin(bearings_rad)[:, None]
    to_x, to_y = segments[:, 0] - origin_m[0], segments[:, 1] - origin_m[1]
    edge_x, edge_y = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    cross = direction_x * edge_y - direction_y * edge_x
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = (to_x * edge_y - to_y * edge_x) / cross
        share = (to_x * direction_y - to_y * direction_x) / cross
    meets = (range_m > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.asarray(np.where(meets, range_m, np.inf).min(axis=1, initial=np.inf))
