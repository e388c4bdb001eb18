"""What one laser scan says about the cells of a map, with noise by range: Li2020 Eq. (1), (8)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import gtsam
import numpy as np

from fusion.bayes import evidence_steps
from fusion.depth_model import RangeNoise, hit_evidence
from fusion.kernel import kernel
from slam.errors import ConfigError
from slam.mapping.evidence_tiles import Board
from slam.mapping.occupancy_grid import Steps
from slam.mapping.ray_tracing import HIT, Box, Evidence, beam_ends, draw_lines
from slam.measurements import FloatArray, LaserScan

_BINS_A_M = 10


@dataclass(frozen=True, slots=True)
class LidarModel:
    """The inverse sensor model of a 2D lidar.

    Attributes
    ----------
    p_hit, p_miss
        Probability that a cell is occupied when a beam of the scan ended in it, or passed it.
    noise
        Of a range. A hit weighs the less the more of it belongs to the neighbouring cells.
    max_hit_range_m
        A return from farther away is taken as no return.
    max_clear_range_m
        A beam without return clears up to here: black and mirroring things give no return either.
    margin_sigmas
        A beam clears nothing nearer to its end than so many standard deviations.
    """

    p_hit: float = 0.7
    p_miss: float = 0.45
    noise: RangeNoise = field(default_factory=lambda: RangeNoise(0.01, share=0.005))
    max_hit_range_m: float = 40.0
    max_clear_range_m: float = 8.0
    margin_sigmas: float = 1.0

    def __post_init__(self) -> None:
        """Refuse a model that would mark what it clears.

        Raises
        ------
        ConfigError
            Where the probabilities are not 0 < p_miss < 0.5 < p_hit < 1, or a range makes no sense.
        """
        if not 0.0 < self.p_miss < 0.5 < self.p_hit < 1.0:
            raise ConfigError(
                f"p_miss={self.p_miss:g} p_hit={self.p_hit:g}: needs 0 < p_miss < 0.5 < p_hit < 1"
            )
        if not (0.0 < self.max_hit_range_m <= 1e4 and 0.0 <= self.max_clear_range_m <= 1e4):
            raise ConfigError(
                f"max_hit_range_m={self.max_hit_range_m:g} max_clear_range_m={self.max_clear_range_m:g}: "
                "needs the first above 0, the second not negative, both at most 10000"
            )


def lidar_board(scan: LaserScan, T_grid_base: gtsam.Pose2, model: LidarModel, cell_m: float) -> Board:
    """The evidence of one scan.

    Parameters
    ----------
    T_grid_base
        The robot in the lattice's axes.
    cell_m
        Side of a cell.
    """
    laser = T_grid_base.compose(scan.T_base_laser)
    x_cells, y_cells = laser.x() / cell_m, laser.y() / cell_m
    ends, kinds, box = beam_ends(
        np.ascontiguousarray(scan.ranges_m, dtype=np.float32),
        x_cells,
        y_cells,
        laser.theta() + scan.start_angle_rad,
        float(scan.step_rad),
        1.0 / cell_m,
        min(model.max_hit_range_m, scan.range_max_m),
        min(model.max_clear_range_m, scan.range_max_m),
    )
    noise = (model.noise.floor_m, model.noise.share, model.noise.per_m)
    hits, miss = _hits_by_range(model, cell_m), evidence_steps(model.p_miss)
    steps = weigh_beams(ends, kinds, box, x_cells, y_cells, cell_m, noise, model.margin_sigmas, hits, miss)
    return Board(steps, box[0], box[1])


@kernel(error_model="numpy")
def weigh_beams(
    ends: FloatArray,
    kinds: Evidence,
    box: Box,
    x_cells: float,
    y_cells: float,
    cell_m: float,
    noise: tuple[float, float, float],
    margin_sigmas: float,
    hit_steps: Steps,
    miss_step: int,
) -> Steps:
    """Steps of evidence of a scan's box: lines up to the margin first, then the ends on top.

    So a cell in which a beam ended is never cleared by the neighbour that passes it.

    Parameters
    ----------
    ends, kinds, box, x_cells, y_cells
        As from `beam_ends`.
    noise
        floor_m, share and per_m of the range's standard deviation.
    hit_steps
        (N,) evidence of a hit by range, `_BINS_A_M` to a metre.
    miss_step
        Evidence of being passed.

    Returns
    -------
    (rows, cols); where several beams end in one cell, the nearest decides.
    """
    short, range_m = np.empty_like(ends), np.empty(kinds.size)
    for beam in range(kinds.size):
        dx, dy = ends[beam, 0] - x_cells, ends[beam, 1] - y_cells
        reach = math.sqrt(dx * dx + dy * dy) * cell_m
        range_m[beam] = reach
        share = 1.0
        if kinds[beam] == HIT:
            sigma = noise[0] + noise[1] * reach + noise[2] * reach * reach
            share = max(0.0, 1.0 - margin_sigmas * sigma / max(reach, 1e-6))
        short[beam, 0], short[beam, 1] = x_cells + share * dx, y_cells + share * dy
    board = draw_lines(short, kinds, box, x_cells, y_cells)
    steps = np.empty(board.shape, np.int16)
    miss = np.int16(miss_step)
    for row in range(board.shape[0]):
        for col in range(board.shape[1]):
            # FREE is 1 and NOTHING 0.
            steps[row, col] = np.int16(board[row, col]) * miss
    for beam in range(kinds.size):
        if kinds[beam] == HIT:
            end_row = min(math.floor(ends[beam, 1]) - box[0], box[2] - 1)
            end_col = min(math.floor(ends[beam, 0]) - box[1], box[3] - 1)
            weight = hit_steps[min(int(range_m[beam] * _BINS_A_M), hit_steps.size - 1)]
            steps[end_row, end_col] = max(steps[end_row, end_col], weight)
    return steps


@lru_cache(maxsize=8)
def _hits_by_range(model: LidarModel, cell_m: float) -> Steps:
    """Evidence of a hit by range."""
    return hit_evidence(model.noise, model.p_hit, cell_m, min(model.max_hit_range_m, 200.0), _BINS_A_M)
