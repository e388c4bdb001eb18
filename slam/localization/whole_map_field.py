"""Likelihood field of a whole map, max-pooled over as many levels as its size needs.

As in `slam.matching.correlative` (Olson 2009, Hess 2016 Sec. V-B), but free and unknown space count too: a
point in free space of the map lowers the score fully, a point in unknown space only a little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slam.mapping.occupancy_grid import FREE, OccupancyGrid, looked_up
from slam.matching.correlative import blurred
from slam.measurements import AnyFloatArray, BoolArray

Picture = NDArray[np.uint8]

# Standard deviation of a wall, in pixels.
BLUR = 1.5
# Likelihood of a point where the map knows nothing.
_UNKNOWN = 0.25
# The robot may stand so far beyond what the map knows as free: its own body was there when it was mapped.
_STANDING_ROOM_M = 0.3


class WholeMapField(NamedTuple):
    """The map as a picture and its max-pooled copies.

    Attributes
    ----------
    levels
        (rows, columns) each; pixel (r + w - 1, c + w - 1) of level k is the maximum of level 0 over rows
        r..r+w-1 and columns c..c+w-1, w = 2^k; beyond the map is ``unknown``. 255 is likelihood 1.
    standing
        For each level where a robot may stand; pixel (r, c) of level k covers rows r w..r w + w - 1 and
        columns c w..c w + w - 1.
    unknown
        Value beyond the map.
    origin_x, origin_y
        Lower-left corner of pixel (0, 0) of level 0, metres.
    """

    levels: Sequence[Picture]
    standing: Sequence[BoolArray]
    unknown: int
    origin_x: float
    origin_y: float
    cell_m: float


def build_whole_map_field(
    points_map: AnyFloatArray, grid: OccupancyGrid | None, cell_m: float
) -> WholeMapField:
    """Draw walls, free space and unseen space of a map.

    Parameters
    ----------
    points_map
        (M, 2) points on the map's walls, M > 0.
    grid
        Tells free from unseen; None takes everything as unseen.
    """
    level, origin_x, origin_y = blurred(points_map, cell_m, BLUR * cell_m)
    unknown = round(255.0 * _UNKNOWN)
    free, stands = np.zeros(level.shape, np.bool_), np.ones(level.shape, np.bool_)
    if grid is not None:
        known, (rows, columns) = grid.states() == FREE, level.shape
        middles = [origin_x, origin_y] + cell_m * (np.arange(columns)[:, None] * [1, 0] + 0.5)
        for row in range(rows):  # one at a time stays in the processor's own memory
            above = np.array([0.0, cell_m * row])
            free[row] = looked_up(known, grid.cells_of(middles + above))
        room, stands = 2 * math.ceil(_STANDING_ROOM_M / cell_m) + 1, free
        for shape in ((room, 1), (1, room)):
            stands = ndimage.binary_dilation(stands, np.ones(shape, np.bool_))
    levels, standing = [np.where(free, level, np.maximum(level, np.uint8(unknown)))], [stands]
    while max(standing[-1].shape) > 1:
        levels.append(_pool_twice(levels[-1], 1 << (len(levels) - 1), unknown))
        standing.append(_halved(standing[-1]))
    return WholeMapField(levels, standing, unknown, origin_x, origin_y, cell_m)


def _pool_twice(level: Picture, width: int, outside: int) -> Picture:
    """From maxima over ``width`` pixels to maxima over twice as many."""
    for axis in (0, 1):
        after = [(0, width) if a == axis else (0, 0) for a in (0, 1)]
        before = [(width, 0) if a == axis else (0, 0) for a in (0, 1)]
        level = np.maximum(
            np.pad(level, after, constant_values=outside), np.pad(level, before, constant_values=outside)
        )
    return level


def _halved(place: BoolArray) -> BoolArray:
    """Whether any is true, of blocks of two by two."""
    rows, columns = place.shape
    even = np.pad(place, ((0, rows % 2), (0, columns % 2)))
    return np.asarray(even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).any(axis=(1, 3)))
