"""Evidence of one depth image for the cells of a map: obstacles in the height band, and free cells.

The obstacles are from Yang2021 Eq. (13)-(20); the inverse sensor model of Li2020 weights them by range.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.bayes import evidence_steps
from fusion.curves import HEIGHT_STEP_M, NEAREST_M
from fusion.depth_model import RangeNoise, hit_evidence
from fusion.height_band import HeightBand, back_project, obstacle_points, pixel_rays, to_frame
from slam.errors import ConfigError
from slam.mapping.evidence_tiles import Board
from slam.mapping.occupancy_grid import Steps
from slam.mapping.view_coverage import free_heights, heights_seen, holes_cleared, view_box
from slam.measurements import CameraIntrinsics, Float32Array, FloatArray, RgbdFrame

Rays: TypeAlias = FloatArray


@dataclass(frozen=True, slots=True)
class DepthModel:
    """The inverse sensor model of a depth camera.

    Attributes
    ----------
    band
        Heights at which an object is an obstacle.
    depth_max_m, depth_min_m
        Readings outside mark nothing; farther ones free cells up to the limit.
    p_hit, p_miss
        Probability that a cell is occupied if a keyframe saw points in it, or saw it free at all heights.
    margin_sigmas
        Number of standard deviations that a point must be above the lower end of the band, and within
        which a ray frees nothing before its end.
    radius_m, least_neighbours, voxel_m
        Of Yang2021's radius filter, after thinning to voxels.
    least_points
        N of Yang2021 Eq. (20): so many voxels make a cell occupied.
    pixel_stride
        Step in rows and columns between pixels used for obstacles, sufficient for voxels; free space uses
        every pixel downwards, and half of this step across.
    """

    band: HeightBand
    depth_max_m: float
    depth_min_m: float = NEAREST_M
    noise: RangeNoise = field(default_factory=lambda: RangeNoise(0.002, per_m=0.003))
    p_hit: float = 0.7
    p_miss: float = 0.4
    margin_sigmas: float = 2.0
    radius_m: float = 0.04
    least_neighbours: int = 6
    voxel_m: float = 0.015
    least_points: int = 3
    pixel_stride: int = 2

    @property
    def bins(self) -> int:
        """Return the number of height bins of the band."""
        most = np.iinfo(np.uint64).bits // 2 - 1  # two bits per bin, and one for the floor
        return min(most, max(1, math.ceil((self.band.high_m - self.band.low_m) / (2.0 * HEIGHT_STEP_M))))


def depth_board(
    frame: RgbdFrame, T_grid_camera: FloatArray, model: DepthModel, cell_m: float
) -> Board | None:
    """Return the evidence of one depth image by height; None if it has no reading within reach.

    A negative depth is a reading removed by an edit: its ray frees cells, and the cell at its end is not
    marked.

    Each cell has the floor and `DepthModel.bins` heights above it. Heights that a ray
    passes are freed, heights with a point are marked: many images together cover all heights of a cell, and
    also free those where somebody stood.

    Parameters
    ----------
    T_grid_camera
        (4, 4) of the optical frame in the lattice's axes, z up from the floor.
    cell_m
        Side of a cell; more than the model's radius (Yang2021: R > r).

    Raises
    ------
    ConfigError
        If the cell is not larger than the radius.
    """
    if not cell_m > model.radius_m:
        raise ConfigError(
            f"cells of {cell_m:g} m with radius_m {model.radius_m:g}; a cell must be larger (Yang2021: R > r)"
        )
    rays, rays32 = _rays_of(frame.depth_m.shape, frame.intrinsics)
    told_m = np.where(np.isfinite(frame.depth_m), frame.depth_m, np.float32(0.0))
    depth_m = np.abs(told_m)
    if not (depth_m > 0.0).any():
        return None
    matrix = np.ascontiguousarray(T_grid_camera, dtype=np.float64)
    # The image axis that points down; the other one is sampled less densely.
    upright = abs(matrix[2, 1]) >= abs(matrix[2, 0])
    stride = (1, 2 * model.pixel_stride)
    if upright:
        clear_m = holes_cleared(depth_m)
    else:
        clear_m, stride = np.ascontiguousarray(holes_cleared(np.ascontiguousarray(depth_m.T)).T), stride[::-1]
    box = view_box(clear_m, rays32, matrix, model.depth_max_m, cell_m)
    bins = model.bins
    noise = (model.noise.floor_m, model.noise.share, model.noise.per_m)
    band_m = (model.band.low_m, model.band.high_m)
    mask = heights_seen(
        *(clear_m, rays32, matrix, box, cell_m, model.depth_max_m, band_m, bins, noise),
        *(model.margin_sigmas, stride),
    )
    steps = np.zeros((*mask.shape, bins + 1), dtype=np.int16)
    free_heights(mask, steps, evidence_steps(model.p_miss))
    every = (slice(None, None, model.pixel_stride),) * 2
    cells, heights = _hit_voxels(depth_m[every], rays[every], matrix, model, cell_m)
    if (told_m < 0.0).any():
        standing = ~_among(cells, _cells_taken(told_m, rays, matrix, cell_m))
        cells, heights = cells[standing], heights[standing]
    centres_m = (cells + 0.5) * cell_m - matrix[:2, 3]
    hits = _hits_by_range(model, cell_m)[(np.hypot(*centres_m.T) / cell_m).astype(np.intp)]
    steps[cells[:, 1] - box[0], cells[:, 0] - box[1], heights] = hits
    return Board(steps, box[0], box[1])


def _hit_voxels(
    depth_m: Float32Array, rays: Rays, T_grid_camera: FloatArray, model: DepthModel, cell_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (M, 2) columns and rows, (M,) height bins from 1 above the floor, with enough points."""
    usable = np.where((depth_m >= model.depth_min_m) & (depth_m <= model.depth_max_m), depth_m, 0.0)
    points = back_project(usable, rays)
    # Height error due to noise along the ray.
    lift = np.abs(T_grid_camera[2, :3] @ (points / points[:, 2:]).T) if len(points) else np.zeros(0)
    margin_m = model.margin_sigmas * lift * model.noise.sigma_m(points[:, 2])
    inside = obstacle_points(
        to_frame(points, T_grid_camera),
        model.band,
        margin_m=margin_m,
        radius_m=model.radius_m,
        least_neighbours=model.least_neighbours,
        voxel_m=model.voxel_m,
    )
    cells = np.floor(inside[:, :2] / cell_m).astype(np.int64)
    if not len(cells):
        return cells, np.zeros(0, dtype=np.int64)
    first, last = cells.min(axis=0), cells.max(axis=0)
    place = (cells - first) @ np.array([1, last[0] - first[0] + 1])
    is_dense = (np.bincount(place) >= model.least_points)[place]
    low_m, high_m = model.band.low_m, model.band.high_m
    heights = ((inside[:, 2] - low_m) / (high_m - low_m) * model.bins).astype(np.int64)
    return cells[is_dense], 1 + np.clip(heights[is_dense], 0, model.bins - 1)


def _cells_taken(
    told_m: Float32Array, rays: Rays, T_grid_camera: FloatArray, cell_m: float
) -> NDArray[np.int64]:
    """Return (M, 2) columns and rows of cells with a removed reading."""
    points = to_frame(back_project(np.maximum(-told_m, np.float32(0.0)), rays), T_grid_camera)
    return np.unique(np.floor(points[:, :2] / cell_m).astype(np.int64), axis=0)


def _among(cells: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return (N,) which of (N, 2) cells are among (M, 2) others."""
    merged = np.concatenate([cells, others])
    number = np.unique(merged, axis=0, return_inverse=True)[1].reshape(-1)
    return np.isin(number[: len(cells)], number[len(cells) :])


@lru_cache(maxsize=8)
def _hits_by_range(model: DepthModel, cell_m: float) -> Steps:
    """Return the evidence of a hit by range, up to the corners of the view."""
    return hit_evidence(model.noise, model.p_hit, cell_m, 3.0 * model.depth_max_m + cell_m)


@lru_cache(maxsize=8)
def _rays_of(shape: tuple[int, int], camera: CameraIntrinsics) -> tuple[Rays, Float32Array]:
    """Return the rays of the pixels, in both precisions."""
    rays = pixel_rays(shape, camera)
    return rays, rays.astype(np.float32)
