"""Tiny planar worlds with a known truth: rooms and corridors, and the sweeps that a lidar takes in them."""

from __future__ import annotations

import math

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from slam.matching.planar import transform_points
from slam.matching.scan_points import ScanPoints, extract_points
from slam.measurements import FloatArray, LaserScan
from slam.simulation.floor_plan import cast_rays

RANGE_MAX_M = 30.0


def clearance_m(segments: FloatArray, points_m: FloatArray) -> FloatArray:
    """Distance from every point (N, 2) to the nearest segment x1, y1, x2, y2, (N,)."""
    start, edge = segments[:, :2], segments[:, 2:] - segments[:, :2]
    offset = points_m[:, None, :] - start
    share = np.clip((offset * edge).sum(axis=2) / (edge * edge).sum(axis=1), 0.0, 1.0)
    nearest = offset - share[:, :, None] * edge
    return np.asarray(np.hypot(nearest[..., 0], nearest[..., 1]).min(axis=1))


def box(west: float, south: float, east: float, north: float) -> FloatArray:
    """Four walls, (4, 4) rows of x1, y1, x2, y2."""
    return np.array(
        [
            [west, south, east, south],
            [east, south, east, north],
            [east, north, west, north],
            [west, north, west, south],
        ]
    )


def room() -> FloatArray:
    """A square room of 6 m around the origin, with two cupboards that distinguish its four corners."""
    return np.concatenate([box(-3, -3, 3, 3), box(2.2, -3, 3, -1.5), box(-1.0, 2.5, 0.5, 3)])


def corridor(half_length_m: float = 200.0) -> FloatArray:
    """Two parallel walls 2 m apart along x, too long for the lidar to see an end."""
    return np.array([[-half_length_m, y, half_length_m, y] for y in (-1.0, 1.0)])


def moved(segments: FloatArray, pose: ArrayLike) -> FloatArray:
    """The same world in another frame: ``pose`` (3,) maps its coordinates there."""
    row = np.asarray(pose, dtype=np.float64)
    return transform_points(segments.reshape(-1, 2), row).reshape(-1, 4)


def sweep(
    segments: FloatArray,
    pose: ArrayLike,
    *,
    beams: int = 361,
    fov_rad: float = 2.0 * math.pi,
    sigma_m: float = 0.0,
    seed: int | np.random.Generator = 0,
    mount: gtsam.Pose2 | None = None,
    stamp_s: float = 0.0,
) -> LaserScan:
    """A sweep from a base pose (3,), its bearings centred on the laser's x axis; beyond 30 m no return."""
    mount = mount or gtsam.Pose2()
    laser = gtsam.Pose2(*np.asarray(pose, dtype=np.float64)).compose(mount)
    start, step = -0.5 * fov_rad, fov_rad / max(beams - 1, 1)
    bearings = start + step * np.arange(beams)
    ranges = cast_rays(segments, laser.translation(), laser.theta() + bearings)
    ranges = ranges + sigma_m * np.random.default_rng(seed).standard_normal(beams)
    ranges[~(ranges < RANGE_MAX_M)] = np.inf
    return LaserScan(stamp_s, ranges.astype(np.float32), start, step, RANGE_MAX_M, mount)


def points_of(scan: LaserScan) -> ScanPoints:
    """The points of a sweep with the default limits."""
    return extract_points(scan, 0.1, 40.0, 4)


def points_at(segments: FloatArray, pose: ArrayLike, **options: object) -> ScanPoints:
    """The points that a sweep from a base pose gives."""
    return points_of(sweep(segments, pose, **options))  # type: ignore[arg-type]
