"""Ring of a 3D lidar nearest to the horizon as a 2D scan: the curve of Xu2024, to compare with a camera's."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np

from slam.config.clouds import CloudMapConfig
from slam.mapping.band_scan import LEVEL_SHARE
from slam.measurements import Float32Array, FloatArray, LaserScan

_RING = "horizon of the 3D lidar"
# Elevations within one bin are one ring.
_BIN_RAD = math.radians(0.25)
# A ring farther from the horizon does not stay at the height of the lidar.
_STEEPEST_RAD = math.radians(5.0)


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
