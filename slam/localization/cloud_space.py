"""What was free and what was wall when clouds were taken, and what the beams of another cloud say to it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.localization.plane_sides import SidedPlanes
from slam.measurements import BoolArray, FloatArray

_UNKNOWN, _FREE, _NEAR, _WALL = 0, 1, 2, 3
# A cell is surely free where so many beams have passed it, and a wall where few more have passed than ended.
_LEAST_PASSES = 3
_PASSES_A_HIT = 4
# The end of a beam, in cells: it lies in the wall that it meets, and grazes what is beside that.
_END_CELLS = 3.0
_STEP_CELLS = 0.7
# A beam that is in a wall for so many short steps on end is not one that grazes its edge.
_THROUGH, _SHORT_CELLS = 2, 0.4
# A picture of more cells is made of larger ones.
_MOST_CELLS = 16_000_000


class CloudSpace(NamedTuple):
    """Known space as a picture of cells.

    Attributes
    ----------
    cells
        (x, y, z) 0 unknown, 1 free, 2 in a surface or beside one, 3 wall.
    corner
        (3,) of cell (0, 0, 0), map frame.
    cell_m
        Side of a cell.
    """

    cells: NDArray[np.uint8]
    corner: FloatArray
    cell_m: float


class BeamVerdicts(NamedTuple):
    """What each of N beams says; one that is nothing of it says nothing.

    Attributes
    ----------
    explained
        (N,) ends on a known wall. Floors and ceilings explain beams at any pose: they say nothing.
    in_free
        (N,) ends where there was nothing.
    crossing
        (N,) passes through a known wall.
    """

    explained: BoolArray
    in_free: BoolArray
    crossing: BoolArray


def cloud_space(
    lidars: FloatArray, clouds: Sequence[FloatArray], planes: SidedPlanes, cell_m: float, reach_m: float
) -> CloudSpace:
    """Follow the beams of clouds.

    Parameters
    ----------
    lidars
        (K, 3) where the beams of each cloud begin, map frame.
    clouds
        K of (N, 3) where they end.
    planes
        Of all of them.
    cell_m
        Side of a cell.
    reach_m
        How far from the middle of the lidars the picture goes.
    """
    middle = 0.5 * (lidars.min(axis=0) + lidars.max(axis=0))
    points = np.vstack(clouds)
    points = points[np.abs(points - middle).max(axis=1) <= reach_m]
    ends = np.vstack([points, lidars])
    low, extent = ends.min(axis=0), np.ptp(ends, axis=0)
    cell_m = max(cell_m, float(np.cbrt(np.prod(extent + cell_m) / _MOST_CELLS)))
    low = low - cell_m
    shape = np.ceil(extent / cell_m).astype(np.int64) + 2
    passes, hits = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
    for lidar, cloud in zip(lidars, clouds, strict=True):
        _follow(passes, (lidar - low) / cell_m, (cloud - low) / cell_m)
    surfaces = np.zeros(shape, np.bool_)
    surfaces[_cells(points, low, cell_m)] = True
    for lidar, cloud in zip(lidars, clouds, strict=True):
        kept = cloud[np.abs(cloud - middle).max(axis=1) <= reach_m]
        np.add.at(hits, _cells(kept[planes.judge(lidar, kept, 0.5 * cell_m).upright], low, cell_m), 1)
    cells = np.where(passes >= _LEAST_PASSES, _FREE, _UNKNOWN).astype(np.uint8)
    cells[_grown(surfaces)] = _NEAR
    cells[(hits > 0) & (passes <= _PASSES_A_HIT * hits)] = _WALL
    return CloudSpace(cells, low, cell_m)


def judge_beams(
    space: CloudSpace, planes: SidedPlanes, lidar: FloatArray, points: FloatArray, reach_m: float
) -> BeamVerdicts:
    """Follow every beam through known space.

    Parameters
    ----------
    lidar
        (3,) where the beams begin, map frame.
    points
        (N, 3) where they end.
    reach_m
        A point so near to a plane lies on it.
    """
    found = planes.judge(lidar, points, reach_m)
    ends = (points - space.corner) / space.cell_m
    against = _against(space.cells, (lidar - space.corner) / space.cell_m, ends)
    return BeamVerdicts(found.upright, ~found.on & (against == _FREE), ~found.on & (against == _WALL))


def _cells(points: FloatArray, corner: FloatArray, cell_m: float) -> tuple[NDArray[np.int64], ...]:
    """Indices of the cells that points (N, 3) lie in."""
    return tuple(np.floor((points - corner) / cell_m).astype(np.int64).T)


def _grown(mask: BoolArray) -> BoolArray:
    """A mask with all neighbours, by edges and corners too."""
    for axis in range(3):
        grown = mask.copy()
        ahead = [slice(None)] * 3
        behind = [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        grown[tuple(ahead)] |= mask[tuple(behind)]
        grown[tuple(behind)] |= mask[tuple(ahead)]
        mask = grown
    return mask


@kernel
def _follow(passes, origin, ends):  # type: ignore[no-untyped-def]
    """Count the beams through each cell, all but their last stretch; in cells."""
    for i in range(ends.shape[0]):
        way = ends[i] - origin
        length = np.sqrt((way * way).sum())
        last = -1
        for n in range(int((length - _END_CELLS) / _STEP_CELLS)):
            share = n * _STEP_CELLS / length
            x = int(np.floor(origin[0] + share * way[0]))
            y = int(np.floor(origin[1] + share * way[1]))
            z = int(np.floor(origin[2] + share * way[2]))
            if not (0 <= x < passes.shape[0] and 0 <= y < passes.shape[1] and 0 <= z < passes.shape[2]):
                break
            cell = (x * passes.shape[1] + y) * passes.shape[2] + z
            if cell != last and passes[x, y, z] < 65535:
                passes[x, y, z] += 1
            last = cell


@kernel
def _against(cells, origin, ends):  # type: ignore[no-untyped-def]
    """Which beams end in free space (1), and which pass a wall on their way (3); in cells."""
    found = np.zeros(ends.shape[0], np.uint8)
    for i in range(ends.shape[0]):
        if _cell(cells, ends[i, 0], ends[i, 1], ends[i, 2]) == _FREE:
            found[i] = _FREE
            continue
        way = ends[i] - origin
        length = np.sqrt((way * way).sum())
        inside, entered = 0, False
        for n in range(int((length - _END_CELLS) / _SHORT_CELLS)):
            at = origin + n * _SHORT_CELLS / length * way
            there = _inside(cells, at[0], at[1], at[2])
            if entered and not there:
                break  # a way that has left the picture does not come back
            entered = there
            inside = inside + 1 if _cell(cells, at[0], at[1], at[2]) == _WALL else 0
            if inside == _THROUGH:
                found[i] = _WALL
                break
    return found


@kernel
def _inside(cells, x, y, z):  # type: ignore[no-untyped-def]
    """Whether a point is in the picture."""
    return 0 <= x < cells.shape[0] and 0 <= y < cells.shape[1] and 0 <= z < cells.shape[2]


@kernel
def _cell(cells, x, y, z):  # type: ignore[no-untyped-def]
    """What a point is in; unknown beyond the picture."""
    i = int(np.floor(x))
    j = int(np.floor(y))
    k = int(np.floor(z))
    if 0 <= i < cells.shape[0] and 0 <= j < cells.shape[1] and 0 <= k < cells.shape[2]:
        return cells[i, j, k]
    return _UNKNOWN
