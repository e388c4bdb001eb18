"""What stood only for a while: things that beams have passed since, taken out of the lidar's grid.

Bayes' rule counts all hits of a cell, whenever they were, so that a person who stands still for some scans
outweighs the few beams that pass later. But what is fixed is hit up to the last time that somebody looks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fusion.bayes import STEPS_A_UNIT, evidence_steps
from fusion.estimation import CONFIDENCE
from slam.mapping.evidence_tiles import Board
from slam.mapping.glass_panes import straight_runs
from slam.mapping.lidar_layer import LidarModel, lidar_board
from slam.mapping.occupancy_grid import OCCUPIED, OccupancyGrid
from slam.measurements import BoolArray, LaserScan


class StaticGrid(NamedTuple):
    """A grid of what stays, and another of what has gone; None where nothing has."""

    static: OccupancyGrid
    passed_by: OccupancyGrid | None


def without_passers_by(
    grid: OccupancyGrid, scans: Iterable[tuple[LaserScan, gtsam.Pose2]], model: LidarModel
) -> StaticGrid:
    """Take out of a grid each thing all of whose cells were passed after they were last hit.

    A thing is what hangs together of the occupied cells, corners included. In the mean its cells must have
    been passed more often than their own share of hits up to the last one allows (Laplace's rule of
    succession): a thin leg is often passed while it stands, an edge of a wall hangs together with what is not
    passed. And so often that these beams alone make them twice as likely free as not. Beams count where they
    are no farther apart than a cell is wide. What stands in a straight row may be a pane of glass, which only
    some beams meet, and stays; so does what came last.

    Parameters
    ----------
    grid
        Drawn of the scans, in cells as fine as they were drawn.
    scans
        With ``T_map_base`` of each, in the order of time.
    model
        The lidar's, as the grid was drawn with.
    """
    cell_m, miss = grid.resolution_m, evidence_steps(model.p_miss)
    enough = math.ceil(math.log(2.0) * STEPS_A_UNIT / -miss)
    corner = np.rint([grid.T_map_grid.y() / cell_m, grid.T_map_grid.x() / cell_m]).astype(int)
    # What gives no return may be dark, and passes nothing.
    model = replace(model, max_clear_range_m=0.0)
    hits, between, since = (np.zeros(grid.shape, np.uint16) for _ in range(3))
    for scan, T_map_base in scans:
        board = _where_dense(lidar_board(scan, T_map_base, model, cell_m), scan, T_map_base, cell_m)
        (row, col), (rows, cols) = np.array([board.row, board.col]) - corner, board.steps.shape
        part = np.s_[row : row + rows, col : col + cols]
        met = _and_beside(board.steps > 0)
        hits[part] += met
        between[part] += np.where(met, since[part], np.uint16(0))
        since[part] = np.where(met, np.uint16(0), since[part] + ((board.steps < 0) & (hits[part] > 0)))
    # What the chance is that so many passes of a cell hold no hit.
    chance = np.log1p(-(hits + 1.0) / (hits + between + 2.0)) * since
    occupied = grid.states() == OCCUPIED
    things, count = ndimage.label(occupied, np.ones((3, 3)))
    fewest, passes, chances = (
        np.asarray(of(values, things, np.arange(count + 1)), dtype=np.float64)
        for of, values in ((ndimage.minimum, since), (ndimage.mean, since), (ndimage.mean, chance))
    )
    passed = (fewest > 0) & (passes >= enough) & (chances < math.log(1.0 - CONFIDENCE))
    gone = occupied & passed[things]
    panes = np.unique(things[straight_runs(gone, cell_m)])
    passed[[thing for thing in panes if _is_straight(np.argwhere(things == thing))]] = False
    gone &= passed[things]
    if not gone.any():
        return StaticGrid(grid, None)
    free = np.where(gone, np.int16(enough * miss), grid.steps)
    stood = np.where(gone, grid.steps, np.int16(0))
    return StaticGrid(replace(grid, steps=free), replace(grid, steps=stood))


def _where_dense(board: Board, scan: LaserScan, T_map_base: gtsam.Pose2, cell_m: float) -> Board:
    """The part of a board where neighbouring beams are no farther apart than a cell is wide."""
    laser = T_map_base.compose(scan.T_base_laser)
    reach = int(1.0 / abs(scan.step_rad))
    row, col = (math.floor(at / cell_m) for at in (laser.y(), laser.x()))
    row, col = row - board.row, col - board.col
    first_row, first_col = max(0, row - reach), max(0, col - reach)
    return Board(
        board.steps[first_row : row + reach, first_col : col + reach],
        board.row + first_row,
        board.col + first_col,
    )


def _is_straight(cells: NDArray[np.intp]) -> bool:
    """Whether (N, 2) cells lie within one of a line."""
    away = cells - cells.mean(axis=0)
    across = np.linalg.svd(away, full_matrices=False)[2][1]
    return bool(np.abs(away @ across).max() <= 1.0)


def _and_beside(cells: BoolArray) -> BoolArray:
    """Cells and their eight neighbours."""
    wide = cells.copy()
    wide[1:] |= cells[:-1]
    wide[:-1] |= cells[1:]
    both = wide.copy()
    both[:, 1:] |= wide[:, :-1]
    both[:, :-1] |= wide[:, 1:]
    return both
