"""Evidence of one laser scan for the cells of a map, with noise by range: Li2020 Eq. (1), (8)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import gtsam
import numpy as np

from fusion.bayes import evidence_steps
from fusion.depth_model import RangeNoise, hit_evidence
from fusion.estimation import TINY
from fusion.kernel import kernel
from slam.mapping.evidence_tiles import Board
from slam.mapping.occupancy_grid import Steps
from slam.mapping.ray_tracing import HIT, TAKEN, Box, Evidence, beam_ends, mark_lines
from slam.measurements import FloatArray, LaserScan


@dataclass(frozen=True, slots=True)
class LidarModel:
    """The inverse sensor model of a 2D lidar.

    Attributes
    ----------
    p_hit, p_miss
        Probability that a cell is occupied when a beam of the scan ended in it, or passed it.
    max_hit_range_m
        A return from farther away counts as no return.
    max_clear_range_m
        A beam without return clears up to here: black and reflecting objects give no return either.
    noise
        Of a range. A hit has less weight the more of it is in the neighbouring cells.
    margin_sigmas
        A beam clears nothing nearer to its end than so many standard deviations.
    """

    p_hit: float
    p_miss: float
    max_hit_range_m: float
    max_clear_range_m: float
    noise: RangeNoise = field(default_factory=lambda: RangeNoise(0.01, share=0.005))
    margin_sigmas: float = 1.0


def lidar_board(scan: LaserScan, T_grid_base: gtsam.Pose2, model: LidarModel, cell_m: float) -> Board:
    """Return the evidence of one scan.

    Parameters
    ----------
    T_grid_base
        Pose of the robot on the lattice.
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
    hits, miss = _hits_by_range(model, cell_m), evidence_steps(model.p_miss)
    noise, margin = model.noise, model.margin_sigmas
    steps = weigh_beams(ends, kinds, box, (x_cells, y_cells), cell_m, noise, margin, hits, miss)
    return Board(steps, box[0], box[1])


def weigh_beams(
    ends: FloatArray,
    kinds: Evidence,
    box: Box,
    laser_cells: tuple[float, float],
    cell_m: float,
    noise: RangeNoise,
    margin_sigmas: float,
    hit_steps: Steps,
    miss_step: int,
) -> Steps:
    """Return the evidence of a scan's box: first lines up to the margin, then the ends on top.

    So a cell in which a beam ended is never cleared by a neighbouring beam. A beam whose end was removed
    clears as before, and marks nothing.

    Parameters
    ----------
    ends, kinds, box
        As from `beam_ends`.
    laser_cells
        x and y of the laser, as `beam_ends` took them.
    hit_steps
        (N,) evidence of a hit by range, `_BINS_A_M` to a metre.
    miss_step
        Evidence of a passing beam.

    Returns
    -------
    (rows, cols); where several beams end in one cell, the nearest decides.
    """
    steps, sigma_m = np.zeros(box[2:], np.int16), (noise.floor_m, noise.share, noise.per_m)
    how = sigma_m, margin_sigmas, hit_steps, miss_step
    _weigh(ends, kinds, box, laser_cells, cell_m, *how, np.empty_like(ends), steps.reshape(-1))
    return steps


@kernel(error_model="numpy")
def _weigh(  # type: ignore[no-untyped-def]
    ends, kinds, box, laser, cell_m, sigma_m, margin_sigmas, hit_steps, miss_step, short, steps
):
    """Write the steps of `weigh_beams`, row by row; ``short`` is a buffer for ends of cleared lines."""
    for beam in range(kinds.size):
        away_x, away_y = ends[beam, 0] - laser[0], ends[beam, 1] - laser[1]
        range_m = math.sqrt(away_x * away_x + away_y * away_y) * cell_m
        share = 1.0
        if kinds[beam] == HIT or kinds[beam] == TAKEN:
            margin_m = margin_sigmas * (sigma_m[0] + sigma_m[1] * range_m + sigma_m[2] * range_m * range_m)
            share = max(0.0, 1.0 - margin_m / max(range_m, TINY))
        short[beam, 0] = laser[0] + share * away_x
        short[beam, 1] = laser[1] + share * away_y
    mark_lines(short, kinds, box, laser[0], laser[1], miss_step, steps)
    for beam in range(kinds.size):
        if kinds[beam] == HIT:
            row = min(math.floor(ends[beam, 1]) - box[0], box[2] - 1)
            column = min(math.floor(ends[beam, 0]) - box[1], box[3] - 1)
            away_x, away_y = ends[beam, 0] - laser[0], ends[beam, 1] - laser[1]
            range_cells = math.sqrt(away_x * away_x + away_y * away_y)
            place = min(np.int64(range_cells), hit_steps.size - 1)
            steps[row * box[3] + column] = max(steps[row * box[3] + column], hit_steps[place])


@lru_cache(maxsize=8)
def _hits_by_range(model: LidarModel, cell_m: float) -> Steps:
    """Return the evidence of a hit by range."""
    return hit_evidence(model.noise, model.p_hit, cell_m, min(model.max_hit_range_m, 200.0))
