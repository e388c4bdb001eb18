"""Free and occupied space of the map's clouds, and how the beams of another cloud agree with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slam.localization.beams import FREE, NEAR, UNKNOWN, WALL, count_passes, follow
from slam.localization.plane_sides import LEAST_SEEN, SidedPlanes
from slam.measurements import BoolArray, FloatArray

# A cell is a wall if at most about so many beams passed it for each that ended.
_PASSES_A_HIT = 4
# The end of a beam, in cells.
_END_CELLS = 3.0
# A grid with more cells gets larger ones.
_MOST_CELLS = 16_000_000


class CloudSpace(NamedTuple):
    """Known space as a grid of cells.

    Attributes
    ----------
    cells
        (x, y, z) 0 unknown, 1 free, 2 in a surface or beside one, 3 wall.
    corner
        (3,) of cell (0, 0, 0), map frame.
    """

    cells: NDArray[np.uint8]
    corner: FloatArray
    cell_m: float


class BeamVerdicts(NamedTuple):
    """Verdict of each of N beams; a beam without any of these gives no evidence.

    Attributes
    ----------
    explained
        (N,) ends on a known wall. Floors and ceilings explain beams at any pose, and give no evidence.
    in_free
        (N,) ends in free space.
    crossing
        (N,) passes through a known wall.
    """

    explained: BoolArray
    in_free: BoolArray
    crossing: BoolArray


def cloud_space(
    lidars: FloatArray, clouds: Sequence[FloatArray], planes: SidedPlanes, cell_m: float, reach_m: float
) -> CloudSpace:
    """Build known space from the beams of clouds.

    Parameters
    ----------
    lidars
        (K, 3) origins of the beams of each cloud, map frame.
    clouds
        K arrays (N, 3) of end points.
    reach_m
        Extent of the grid from the centre of the lidars.
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
        ends = (cloud - low) / cell_m
        count_passes(passes.ravel(), passes.shape, (lidar - low) / cell_m, ends, _END_CELLS)
    surfaces = np.zeros(shape, np.bool_)
    surfaces[_cells(points, low, cell_m)] = True
    for lidar, cloud in zip(lidars, clouds, strict=True):
        kept = cloud[np.abs(cloud - middle).max(axis=1) <= reach_m]
        np.add.at(hits, _cells(kept[planes.judge(lidar, kept, 0.5 * cell_m).upright], low, cell_m), 1)
    cells = np.where(passes >= LEAST_SEEN, FREE, UNKNOWN).astype(np.uint8)
    cells[ndimage.binary_dilation(surfaces, np.ones((3, 3, 3), np.bool_))] = NEAR
    cells[(hits > 0) & (passes <= _PASSES_A_HIT * hits)] = WALL
    return CloudSpace(cells, low, cell_m)


def judge_beams(
    space: CloudSpace, planes: SidedPlanes, lidar: FloatArray, points: FloatArray, reach_m: float
) -> BeamVerdicts:
    """Trace every beam through known space.

    Parameters
    ----------
    lidar
        (3,) origin of the beams, map frame.
    points
        (N, 3) end points.
    reach_m
        A point within this distance of a plane is on it.
    """
    on_planes = planes.judge(lidar, points, reach_m)
    open_, against = ~on_planes.on, np.zeros(len(points), np.uint8)
    origin, ends = ((at - space.corner) / space.cell_m for at in (lidar, points[open_]))
    against[open_] = follow(space.cells, origin, ends, _END_CELLS)
    return BeamVerdicts(on_planes.upright, against == FREE, against == WALL)


def _cells(points: FloatArray, corner: FloatArray, cell_m: float) -> tuple[NDArray[np.int64], ...]:
    """Return the indices of the cells of points (N, 3)."""
    return tuple(np.floor((points - corner) / cell_m).astype(np.int64).T)
