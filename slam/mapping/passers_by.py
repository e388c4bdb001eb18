"""Remove temporary objects from the lidar grid: those that beams passed through before or after.

Bayes' rule counts all hits of a cell at any time, so a person who stands still for some scans outweighs the
few beams that pass. But a fixed object is hit from the first to the last time that the lidar looks at it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.bayes import STEPS_A_UNIT, evidence_steps
from fusion.estimation import CONFIDENCE
from fusion.kernel import ZERO, kernel
from slam.mapping.evidence_tiles import Board
from slam.mapping.glass_panes import SHORTEST_M
from slam.mapping.lidar_layer import LidarModel, lidar_board
from slam.mapping.occupancy_grid import THRESHOLDS, OccupancyGrid
from slam.measurements import FloatArray, LaserScan


def without_passers_by(
    grid: OccupancyGrid, scans: Iterable[tuple[LaserScan, gtsam.Pose2]], model: LidarModel
) -> tuple[OccupancyGrid, OccupancyGrid | None]:
    """Remove from a grid the objects whose cells were all passed before the first hit or after the last.

    An object is a connected component of the occupied cells, corners included. On average, its cells must
    have been passed more often than their share of hits from the first to the last one allows (Laplace's rule
    of succession): a thin leg is often passed while it stands, an edge of a wall is connected to cells that
    are not passed. And so often that these beams alone make them twice as likely free as not. Beams count if
    they are at most a cell apart. A straight row may be a pane of glass, which only some beams hit, and
    stays. Cells become free if the beams since the last hit alone suffice; otherwise the object may still be
    there, and they become unknown.

    Parameters
    ----------
    grid
        Drawn from the scans, at their original resolution.
    scans
        With ``T_map_base`` of each, in the order of time.
    model
        The lidar's, as the grid was drawn with.

    Returns
    -------
    The static grid, and a grid of removed objects; None if nothing was removed.
    """
    cell_m, miss = grid.resolution_m, evidence_steps(model.p_miss)
    enough = math.ceil(math.log(2.0) * STEPS_A_UNIT / -miss)
    cells = np.flatnonzero(THRESHOLDS.occupied(grid.steps))
    if not cells.size:
        return grid, None
    before, since, missed = _passes(grid, cells, scans, model)
    of_cell = components_of(cells, grid.shape[1])
    rows_cols = np.column_stack(np.unravel_index(cells, grid.shape))
    moved = _moved_objects(of_cell, before + since, missed, enough)
    removed = [thing for thing in moved if not _may_be_a_pane(rows_cols[of_cell == thing] * cell_m, cell_m)]
    own = np.isin(of_cell, removed)
    taken = cells[own]
    if not taken.size:
        return grid, None
    is_free = np.isin(of_cell[own], _moved_objects(of_cell, since, missed, enough))
    static, stood = grid.steps.copy(), np.zeros(grid.shape, grid.steps.dtype)
    stood.flat[taken] = static.flat[taken]
    static.flat[taken] = np.where(is_free, enough * miss, 0)
    return replace(grid, steps=static), replace(grid, steps=stood)


def components_of(cells: NDArray[np.intp], cols: int) -> NDArray[np.intp]:
    """Return (C,) the connected component of each cell, given by ascending indices.

    A label image would take twice the memory of the grid.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = list[NDArray[np.intp]]()
    for right, offset in ((1, 1), (-1, cols - 1), (0, cols), (1, cols + 1)):
        at = np.searchsorted(cells, cells + offset)
        inside = (cells % cols + right >= 0) & (cells % cols + right < cols) & (at < len(cells))
        (touching,) = np.nonzero(inside & (cells[at.clip(max=len(cells) - 1)] == cells + offset))
        ends.append(np.stack([touching, at[touching]]))
    first, second = np.concatenate(ends, axis=1)
    joined = coo_array((np.ones(len(first), np.bool_), (first, second)), shape=(len(cells), len(cells)))
    return np.asarray(connected_components(joined, directed=False)[1], np.intp)


def _moved_objects(
    of_cell: NDArray[np.intp], passes: NDArray[np.int32], missed: FloatArray, enough: int
) -> NDArray[np.intp]:
    """Return the numbers of the objects that beams passed too often for a fixed object.

    ``of_cell`` (C,) is the number of each cell's object, the others are as of `_passes`.
    """
    size, fewest = np.bincount(of_cell), np.full(of_cell.max(initial=-1) + 1, np.iinfo(np.int32).max)
    np.minimum.at(fewest, of_cell, passes)
    mean, chance = (np.bincount(of_cell, values) / size for values in (passes, missed * passes))
    return np.flatnonzero((fewest > 0) & (mean >= enough) & (chance < math.log(1.0 - CONFIDENCE)))


def _passes(
    grid: OccupancyGrid,
    cells: NDArray[np.intp],
    scans: Iterable[tuple[LaserScan, gtsam.Pose2]],
    model: LidarModel,
) -> tuple[NDArray[np.int32], NDArray[np.int32], FloatArray]:
    """Count how often occupied cells (C,), ascending, were passed while nothing was in or beside them.

    Returns
    -------
    (C,) scans that passed it before the first hit, and since the last, and the log of the probability
    that one scan passes what is there.
    """
    cell_m, cols = grid.resolution_m, grid.shape[1]
    corner = round(grid.T_map_grid.y() / cell_m), round(grid.T_map_grid.x() / cell_m)
    # Without a return, the object may be dark: such a beam passes nothing.
    model = replace(model, max_clear_range_m=0.0)
    hits, between, since, before = np.zeros((4, cells.size), np.int32)
    for scan, T_map_base in scans:
        board = lidar_board(scan, T_map_base, model, cell_m)
        dense = _where_dense(board, scan, T_map_base, cell_m)
        begun = (board.row - corner[0]) * cols + board.col - corner[1]
        _pass(board.steps, begun, cols, dense, cells, hits, between, since, before)
    return before, since, np.log1p(-(hits + 1.0) / (hits + between + 2.0))


@kernel
def _pass(steps, begun, cols, dense, cells, hits, between, since, before):  # type: ignore[no-untyped-def]
    """Count the evidence of a board, at corner ``begun`` of a grid with so many columns, for occupied cells.

    ``dense`` are the first and last row and column of the part of the board that counts.
    """
    for i in range(dense[0], dense[1]):
        first = begun + i * cols
        # The first occupied cell of the row, by bisection.
        k, last = ZERO, np.int64(cells.size)
        while k < last:
            middle = (k + last) >> 1
            if cells[middle] < first + dense[2]:
                k = middle + 1
            else:
                last = middle
        while k < cells.size and cells[k] < first + dense[3]:
            j = cells[k] - first
            hit = False
            for near_i in range(max(i - 1, dense[0]), min(i + 2, dense[1])):
                for near_j in range(max(j - 1, dense[2]), min(j + 2, dense[3])):
                    hit = hit or steps[near_i, near_j] > 0
            if hit:
                hits[k] += 1
                between[k] += since[k]
                since[k] = 0
            elif steps[i, j] < 0 and hits[k] > 0:
                since[k] += 1
            elif steps[i, j] < 0:
                before[k] += 1
            k += 1


def _where_dense(board: Board, scan: LaserScan, T_map_base: gtsam.Pose2, cell_m: float) -> tuple[int, ...]:
    """Return the part of a board where neighbouring beams are at most a cell apart.

    Returns
    -------
    First row, the one after the last, first column, the one after the last.
    """
    laser = T_map_base.compose(scan.T_base_laser)
    reach = int(1.0 / abs(scan.step_rad))
    row, col = math.floor(laser.y() / cell_m) - board.row, math.floor(laser.x() / cell_m) - board.col
    rows, cols = board.steps.shape
    return max(0, row - reach), min(row + reach, rows), max(0, col - reach), min(col + reach, cols)


def _may_be_a_pane(points_m: FloatArray, cell_m: float) -> bool:
    """Return whether (N, 2) cell centres are within a cell of a line as long as the smallest pane."""
    centred = points_m - points_m.mean(axis=0)
    along, across = (centred @ np.linalg.svd(centred)[2].T).T
    return bool(np.ptp(along) >= SHORTEST_M and np.abs(across).max() <= cell_m)
