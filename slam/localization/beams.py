"""Trace beams through a grid of cells (x, y, z) that are known as free or as wall."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import FloatArray

# States of cells: NEAR is within reach of a surface, where a small error may have put it.
UNKNOWN, FREE, NEAR, WALL = 0, 1, 2, 3
# A beam in a wall for so many consecutive steps does not just graze its edge.
_THROUGH, _STEP_CELLS = 2, 0.4


def follow(
    cells: NDArray[np.uint8], origin: FloatArray, ends: FloatArray, end_cells: float
) -> NDArray[np.uint8]:
    """Return what (N,) beams hit: FREE if it ends in free space, WALL if it passes a wall, else UNKNOWN.

    Parameters
    ----------
    origin, ends
        (3,) and (N, 3), in cells.
    end_cells
        Length of the last part of a beam, which is in its wall, and grazes adjacent cells.
    """
    first_hits = np.zeros(len(ends), np.uint8)
    _follow(cells.ravel(), cells.shape, origin, ends, end_cells, first_hits)
    return first_hits


@kernel
def _follow(cells, shape, origin, ends, end_cells, first_hits):  # type: ignore[no-untyped-def]
    """See `follow`."""
    for i in range(ends.shape[0]):
        if _at(cells, shape, origin, ends, i, 1.0) == FREE:
            first_hits[i] = FREE
            continue
        length = _length(origin, ends, i)
        inside = 0
        for n in range(int((length - end_cells) / _STEP_CELLS)):
            inside = inside + 1 if _at(cells, shape, origin, ends, i, n * _STEP_CELLS / length) == WALL else 0
            if inside == _THROUGH:
                first_hits[i] = WALL
                break


@kernel
def count_passes(passes, shape, origin, ends, end_cells):  # type: ignore[no-untyped-def]
    """Count the beams through each cell of a flat grid, without their last part; see `follow`."""
    for i in range(ends.shape[0]):
        length = _length(origin, ends, i)
        last = -1
        for n in range(int((length - end_cells) / _STEP_CELLS)):
            cell = _index(shape, origin, ends, i, n * _STEP_CELLS / length)
            if cell < 0:
                break
            if cell != last and passes[cell] < 65535:
                passes[cell] += 1
            last = cell


@kernel
def _length(origin, ends, i):  # type: ignore[no-untyped-def]
    """Return the length of a beam, in cells."""
    x = ends[i, 0] - origin[0]
    y = ends[i, 1] - origin[1]
    z = ends[i, 2] - origin[2]
    return np.sqrt(x * x + y * y + z * z)


@kernel
def _index(shape, origin, ends, i, share):  # type: ignore[no-untyped-def]
    """Return the index of the cell at a share of a beam; -1 outside the grid."""
    x = int(np.floor(origin[0] + share * (ends[i, 0] - origin[0])))
    y = int(np.floor(origin[1] + share * (ends[i, 1] - origin[1])))
    z = int(np.floor(origin[2] + share * (ends[i, 2] - origin[2])))
    if 0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]:
        return (x * shape[1] + y) * shape[2] + z
    return -1


@kernel
def _at(cells, shape, origin, ends, i, share):  # type: ignore[no-untyped-def]
    """Return the state of the cell at a share of a beam; unknown outside the grid."""
    cell = _index(shape, origin, ends, i, share)
    return cells[cell] if cell >= 0 else UNKNOWN
