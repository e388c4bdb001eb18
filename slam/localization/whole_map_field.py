"""A likelihood field of a whole map, max-pooled as deep as the map is wide.

As in `slam.matching.correlative` (Olson 2009, Hess 2016 Sec. V-B), but free space and unseen space speak too:
a point costs its share where the map is free, and little where the map knows nothing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam.mapping.occupancy_grid import FREE, OccupancyGrid
from slam.matching.correlative import blurred
from slam.measurements import AnyFloatArray

Picture = NDArray[np.uint8]

# The robot may stand so far beyond what the map knows as free: its own body was there when it was mapped.
_STANDING_ROOM_M = 0.3
# More levels than that are wider than any map of cells of a decimetre.
_MOST_LEVELS = 14


class WholeMapField(NamedTuple):
    """All levels in one buffer, so that the kernels compile once whatever their number.

    Attributes
    ----------
    buffer
        Level after level, row by row. Pixel (r + w - 1, c + w - 1) of level k is the maximum of level 0 over
        rows r..r+w-1 and columns c..c+w-1, w = 2^k; beyond the map is ``unknown``. 255 is likelihood 1.
    standing
        In the same manner for where a robot may stand, 0 or 1; pixel (r, c) of level k tells of the rows
        r w..r w + w - 1 and columns c w..c w + w - 1.
    table
        (levels, 6) offset, rows and columns of each level in ``buffer``, then in ``standing``.
    unknown
        Value beyond the map.
    origin_x, origin_y
        Lower-left corner of pixel (0, 0) of level 0, metres.
    cell_m
        Edge of a pixel.
    """

    buffer: Picture
    standing: Picture
    table: NDArray[np.int64]
    unknown: int
    origin_x: float
    origin_y: float
    cell_m: float


def build_whole_map_field(
    points_map: AnyFloatArray,
    grid: OccupancyGrid | None,
    cell_m: float,
    sigma_m: float,
    unknown_likelihood: float,
) -> WholeMapField:
    """Draw walls, free space and unseen space of a map.

    Parameters
    ----------
    points_map
        (M, 2) points on the map's walls, M > 0.
    grid
        Tells free from unseen; None takes everything as unseen.
    cell_m, sigma_m
        Edge of a pixel and blur of the walls.
    unknown_likelihood
        Likelihood of a point where the map knows nothing.
    """
    level, origin_x, origin_y = blurred(points_map, cell_m, sigma_m)
    unknown = round(255.0 * unknown_likelihood)
    free = np.zeros(level.shape, np.bool_)
    standing = np.ones(level.shape, np.uint8)
    if grid is not None:
        free = _free_pixels(level.shape, origin_x, origin_y, cell_m, grid)
        standing = _grown(free, math.ceil(_STANDING_ROOM_M / cell_m)).astype(np.uint8)
    level = np.where(free, level, np.maximum(level, np.uint8(unknown)))
    levels, places = [level], [standing]
    while max(places[-1].shape) > 1 and len(levels) < _MOST_LEVELS:
        levels.append(_pool_twice(levels[-1], 1 << (len(levels) - 1), unknown))
        places.append(_halved(places[-1]))
    table = np.array(
        [
            [start, *level.shape, first, *place.shape]
            for level, place, start, first in zip(
                levels, places, _starts(levels), _starts(places), strict=True
            )
        ],
        np.int64,
    )
    return WholeMapField(
        np.concatenate([level.ravel() for level in levels]),
        np.concatenate([place.ravel() for place in places]),
        table,
        unknown,
        origin_x,
        origin_y,
        cell_m,
    )


def _starts(pictures: list[Picture]) -> list[int]:
    """Offset of each picture when all are laid end to end."""
    return [0, *np.cumsum([picture.size for picture in pictures]).tolist()[:-1]]


def _free_pixels(
    shape: tuple[int, ...], origin_x: float, origin_y: float, cell_m: float, grid: OccupancyGrid
) -> NDArray[np.bool_]:
    """Whether the grid is free at the middle of each pixel."""
    rows, columns = np.indices(shape)
    middles = np.column_stack(
        [origin_x + (columns.ravel() + 0.5) * cell_m, origin_y + (rows.ravel() + 0.5) * cell_m]
    )
    cells = grid.cells_of(middles)
    inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
    free = np.zeros(len(cells), np.bool_)
    free[inside] = grid.states()[cells[inside, 0], cells[inside, 1]] == FREE
    return free.reshape(shape)


def _grown(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """A mask with all pixels up to so far away, along rows and columns."""
    for axis in (0, 1):
        padded = np.pad(mask, [(pixels, pixels) if a == axis else (0, 0) for a in (0, 1)])
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * pixels + 1, axis=axis)
        mask = np.asarray(windows.any(axis=-1))
    return mask


def _pool_twice(level: Picture, width: int, outside: int) -> Picture:
    """From maxima over ``width`` pixels to maxima over twice as many."""
    for axis in (0, 1):
        after = [(0, width) if a == axis else (0, 0) for a in (0, 1)]
        before = [(width, 0) if a == axis else (0, 0) for a in (0, 1)]
        level = np.maximum(
            np.pad(level, after, constant_values=outside), np.pad(level, before, constant_values=outside)
        )
    return level


def _halved(place: Picture) -> Picture:
    """Maxima of blocks of two by two."""
    rows, columns = place.shape
    even = np.pad(place, ((0, rows % 2), (0, columns % 2)))
    blocks: Picture = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).max(axis=(1, 3))
    return blocks
