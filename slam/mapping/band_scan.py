"""2D scans cut from the clouds of a 3D lidar: the height band of the robot, and the horizon.

Band: the nearest obstacle at each bearing for navigation, Yang2021 Eq. (16)-(18), from the step that the
robot can drive over to the height of the robot. Horizon: the ring nearest to it, the curve of Xu2024, to
compare with a camera's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import islice

import gtsam
import numpy as np

from fusion.estimation import FEWEST, SETTLED, gate
from fusion.height_band import HeightBand
from slam.config.clouds import CloudMapConfig
from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import Float32Array, FloatArray, LaserScan

_LEVEL_COS = 0.97
# A level needs this share of the points of the fullest; fewer points are noise or reflections.
LEVEL_SHARE = 0.2
_CELL_M = 0.05

_RING = "horizon of the 3D lidar"
# Elevations within one bin are one ring.
_BIN_RAD = math.radians(0.25)
# A ring farther from the horizon does not stay at the height of the lidar.
_STEEPEST_RAD = math.radians(5.0)


def band_scan(
    points: FloatArray,
    stamp_s: float,
    T_base_lidar: gtsam.Pose3,
    band: HeightBand,
    ground_m: float | FloatArray,
    config: CloudMapConfig,
    *,
    clears: bool = False,
) -> LaserScan:
    """Return the scan of a virtual 2D lidar that hits every obstacle.

    Parameters
    ----------
    points
        (N, 3), base frame.
    T_base_lidar
        Origin of the rays.
    ground_m
        Height of the ground in the base frame; one for all points or (N,).
    clears
        Whether visible ground counts as free.

    Returns
    -------
    A bearing without obstacle is no reading, since its free range is unknown; if ground clears it, it is
    minus the distance of the farthest ground: free up to there, without an obstacle.
    """
    origin = T_base_lidar.translation()
    x, y = points[:, 0] - origin[0], points[:, 1] - origin[1]
    distance = np.sqrt(x * x + y * y)
    (in_range,) = np.nonzero(distance < config.plan_range_m)
    x, y, distance, over_m = x[in_range], y[in_range], distance[in_range], (points[:, 2] - ground_m)[in_range]
    # Heights within so many sigmas are noise, or thousands of floor points would be obstacles.
    margin_m = math.sqrt(gate()) * config.ground_share * (2.0 + distance)
    stops = band.holds(over_m, margin_m)
    step_rad = 2.0 * math.pi / config.bearings
    bearing = np.floor((np.arctan2(y, x) + math.pi) / step_rad).astype(np.int64)
    bearing = np.minimum(bearing, config.bearings - 1)
    ranges = np.full(config.bearings, np.nan, dtype=np.float32)
    if clears:
        ground = np.abs(over_m) <= band.low_m + margin_m
        np.fmin.at(ranges, bearing[ground], -distance[ground].astype(np.float32))
    bearing, distance = bearing[stops], distance[stops]
    order = np.lexsort((distance, bearing))
    bearing, distance = bearing[order], distance[order]
    if len(bearing):
        # A single point is no obstacle: the n-th of a bearing must be within a cell of it.
        after = np.arange(len(bearing)) + config.least_points - 1
        within = after < len(bearing)
        after = np.minimum(after, len(bearing) - 1)
        firm = within & (bearing[after] == bearing) & (distance[after] - distance <= 2.0 * _CELL_M)
        bins, first = np.unique(bearing[firm], return_index=True)
        ranges[bins] = distance[firm][first]
    mounting = gtsam.Pose2(float(origin[0]), float(origin[1]), 0.0)
    start = -math.pi + 0.5 * step_rad
    return LaserScan(stamp_s, ranges, start, step_rad, config.plan_range_m, mounting, "band of the 3D lidar")


@dataclass(frozen=True, slots=True)
class Ground:
    """The ground under a robot.

    Attributes
    ----------
    height_m
        Height in the base frame.
    by_mounting
        Whether the base is on it, by the lidar's mounting; else it was seen.
    """

    height_m: float
    by_mounting: bool


def ground_of(
    clouds: Iterable[FloatArray], T_base_lidar: gtsam.Pose3, voxel_m: float, thickness_m: float
) -> Ground | None:
    """Return the ground as seen, or at the base if the mounting of the lidar agrees with that.

    Parameters
    ----------
    clouds
        (N, 3) points of all keyframes, base frame; the first ones are used.
    voxel_m, thickness_m
        As of `ground_height`.

    Returns
    -------
    None if it is not seen, and the mounting does not give it.
    """
    first = islice(clouds, FEWEST)
    seen_m = ground_height(first, float(T_base_lidar.z()), voxel_m, thickness_m)
    mounted = not T_base_lidar.equals(gtsam.Pose3(), SETTLED)
    if mounted and (seen_m is None or abs(seen_m) < 2.0 * _CELL_M):
        return Ground(0.0, by_mounting=True)
    return None if seen_m is None else Ground(seen_m, by_mounting=False)


def ground_height(
    clouds: Iterable[FloatArray], lidar_m: float, voxel_m: float, thickness_m: float
) -> float | None:
    """Return the ground height in the base frame: the lowest large level surface below the lidar.

    Parameters
    ----------
    clouds
        Points (N, 3) of some keyframes, each in its base frame.
    lidar_m
        Height of the lidar in that frame.
    voxel_m, thickness_m
        Of the planes, see `slam.matching.plane_voxels.PlaneVoxels`.

    Returns
    -------
    None if no level surface is seen.
    """
    heights = []
    for points in clouds:
        planes = PlaneVoxels.build(points, voxel_m, thickness_m)
        pairs = planes.pairs(points)
        level = (np.abs(pairs.normals[:, 2]) > _LEVEL_COS) & (points[pairs.found][:, 2] < lidar_m)
        heights.append(points[pairs.found][level, 2])
    below = np.concatenate(heights) if heights else np.zeros(0)
    if not len(below):
        return None
    bins = np.floor(below / _CELL_M).astype(np.int64)
    bin_numbers, counts = np.unique(bins, return_counts=True)
    lowest = int(bin_numbers[np.flatnonzero(counts >= LEVEL_SHARE * counts.max())[0]])
    in_peak = np.abs(below - (lowest + 0.5) * _CELL_M) <= 1.5 * _CELL_M
    return float(np.median(below[in_peak]))


def horizon_scan(
    points: FloatArray, stamp_s: float, T_base_lidar: gtsam.Pose3, config: CloudMapConfig
) -> LaserScan | None:
    """Return the ranges of the ring, at the bearings of `slam.mapping.band_scan.band_scan`.

    Parameters
    ----------
    points
        (N, 3), base frame.
    T_base_lidar
        Origin of the rays; ranges are horizontal from there.

    Returns
    -------
    None if no ring is near the horizon.
    """
    rays = points - T_base_lidar.translation()
    level = np.hypot(rays[:, 0], rays[:, 1])
    elevation = np.arctan2(rays @ T_base_lidar.rotation().matrix()[:, 2], level)
    bins = np.rint(elevation / _BIN_RAD).astype(np.int64)
    is_level = np.abs(elevation) <= _STEEPEST_RAD
    if not is_level.any():
        return None
    bin_numbers, counts = np.unique(bins[is_level], return_counts=True)
    rings = bin_numbers[counts >= LEVEL_SHARE * counts.max()]
    ring = int(rings[np.argmin(np.abs(rings))])
    on_ring = np.abs(elevation - ring * _BIN_RAD) <= _BIN_RAD
    step_rad = 2.0 * math.pi / config.bearings
    bearing = ((np.arctan2(rays[on_ring, 1], rays[on_ring, 0]) + math.pi) / step_rad).astype(np.int64)
    ranges: Float32Array = np.full(config.bearings, np.inf, dtype=np.float32)
    np.minimum.at(ranges, np.minimum(bearing, config.bearings - 1), level[on_ring].astype(np.float32))
    mounting = gtsam.Pose2(float(T_base_lidar.x()), float(T_base_lidar.y()), 0.0)
    start = -math.pi + 0.5 * step_rad
    return LaserScan(stamp_s, ranges, start, step_rad, config.plan_range_m, mounting, _RING)


def with_repairs(plan: LaserScan, measured: LaserScan, repaired: LaserScan) -> LaserScan:
    """Return the 2D scan of the height band, with nearer obstacles that the repair of the ring found.

    The three share their bearings.
    """
    touched = (repaired.ranges_m != measured.ranges_m) & np.isfinite(repaired.ranges_m)
    touched &= (repaired.ranges_m > 0.0) & (repaired.ranges_m < plan.range_max_m)
    nearer = touched & ~(plan.ranges_m <= repaired.ranges_m)
    return replace(plan, ranges_m=np.where(nearer, repaired.ranges_m, plan.ranges_m).astype(np.float32))
