"""Finds lidar beams that always hit the robot itself, and how far it reaches around a 3D lidar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.estimation import FEWEST
from slam.config import Config
from slam.doctor.finding import Finding
from slam.doctor.floor import LEVER_M, floor_below_m
from slam.matching.cloud_points import SLICES
from slam.measurements import BoolArray, Float32Array, FloatArray, LaserScan


def blocked_beams(stretches: Sequence[Sequence[LaserScan]], config: Config) -> BoolArray | None:
    """(N,) beams with the same range wherever the robot is; None if not determined.

    A beam is blocked if its range is equal (to half a cell of the matcher) in nearly all scans of different
    places, and larger than the range that the matcher excludes as the robot itself.
    """
    ends = [scan for scans in stretches for scan in scans[:: FEWEST // 4]]  # half a second apart
    count = int(np.median([scan.ranges_m.size for scan in ends])) if ends else 0
    same_m = 0.5 * config.match.cell_m
    kept = list[Float32Array]()
    for scan in ends:
        ranges = scan.ranges_m
        if ranges.size != count or not np.isfinite(ranges).any():
            continue
        # Another place: some beams differ by far.
        if not kept or _far_apart(ranges, kept[-1], 2.0 * config.match.cell_m):
            kept.append(ranges)
    if len(kept) < FEWEST:
        return None
    table = np.array(kept)
    table[~np.isfinite(table)] = np.nan
    valid_share = np.isfinite(table).mean(axis=0)
    middle = np.zeros(count)
    middle[valid_share > 0.0] = np.nanmedian(table[:, valid_share > 0.0], axis=0)
    with np.errstate(invalid="ignore"):
        differ = (~(np.abs(table - middle) < same_m)).mean(axis=0)
    # Allows for people and sunlight.
    return np.asarray((differ < 1.0 / FEWEST) & (middle > config.scan.range_min_m))


def body_reach_m(clouds: Sequence[Float32Array], up: FloatArray, config: Config) -> float:
    """Range of the farthest points of the robot itself around a 3D lidar; 0 if it sees none.

    As for `blocked_beams`, their ranges are equal wherever the robot is. Those of floor and ceiling are, too,
    and along a straight path those of walls: so points beyond two metres do not count, nor few directions.
    ``clouds`` (N, 3), half a second apart, and the upward direction ``up`` (3,) are in the lidar's frame.
    """
    kept, same_m = list[Float32Array](), 0.5 * config.match.cell_m
    near = [float(np.mean(np.sum(points**2, axis=1) < 2.0**2)) for points in clouds if len(points)]
    if not near or FEWEST * float(np.median(near)) < 1.0:
        return 0.0
    for points in clouds:
        ranges_m = _by_direction(points)
        if not kept or _far_apart(ranges_m, kept[-1], 2.0 * config.match.cell_m):
            kept.append(ranges_m)
    if len(kept) < FEWEST:
        return 0.0
    table = np.array(kept)
    bins = np.flatnonzero(np.isfinite(table).mean(axis=0) > 1.0 - 1.0 / FEWEST)
    middle = np.nanmedian(table[:, bins], axis=0)
    same = (np.abs(table[:, bins] - middle) < same_m).mean(axis=0) > 1.0 - 1.0 / FEWEST
    elevation, bearing = ((np.array(np.divmod(bins, SLICES)) + 0.5) / SLICES - 0.5) * [[math.pi], [math.tau]]
    level = np.cos(elevation)
    ways = np.column_stack([level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation)])
    whole: FloatArray = np.concatenate(clouds).astype(np.float64)
    for side in (up, -up):
        far_m = floor_below_m(whole, side) or math.inf
        same &= -middle * (ways @ side) < far_m - LEVER_M
    same &= (middle > config.cloud_odometry.range_min_m) & (middle < 2.0)
    return float(middle[same].max()) + same_m if FEWEST * same.sum() > len(same) else 0.0


def body_finding(name: str, reach_m: float) -> Finding:
    """The finding about the robot's own body around a 3D lidar."""
    reach_m = round(reach_m, 2)
    return Finding(
        name,
        "own body",
        f"it sees the robot itself up to {reach_m} m around it",
        "parts that move with the robot bias the matching and are drawn as walls",
        ({"lidars_3d": {name: {"range_min_m": reach_m}}},),
        sure=True,
        value=reach_m,
    )


def _by_direction(points: Float32Array) -> Float32Array:
    """Median range by elevation and bearing, in `SLICES` of both (B,); NaN without a point."""
    ranges_m = np.linalg.norm(points, axis=1)
    points, ranges_m = points[ranges_m > 0.0], ranges_m[ranges_m > 0.0]
    up = np.arcsin(np.clip(points[:, 2] / ranges_m, -1.0, 1.0)) / math.pi
    around = np.arctan2(points[:, 1], points[:, 0]) / math.tau
    rows = np.minimum((np.column_stack([up, around]) + 0.5) * SLICES, SLICES - 1).astype(np.int64)
    numbers = rows @ [SLICES, 1]
    order = np.lexsort((ranges_m, numbers))
    found, begins, counts = np.unique(numbers[order], return_index=True, return_counts=True)
    table = np.full(SLICES * SLICES, np.nan, np.float32)
    table[found] = ranges_m[order][begins + counts // 2]
    return table


def without(scan: LaserScan, blocked: BoolArray) -> LaserScan:
    """A scan without its blocked beams."""
    if scan.ranges_m.size != blocked.size:
        return scan
    return replace(scan, ranges_m=np.where(blocked, np.float32(np.nan), scan.ranges_m))


def blocked_finding(name: str, blocked: BoolArray) -> Finding | None:
    """The finding about blocked beams; None without any."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], blocked, [False]]).astype(np.int8)))
    runs = [(int(first), int(last) - 1) for first, last in edges.reshape(-1, 2)]
    if not runs:
        return None
    beams = ", ".join(f"{first} to {last}" for first, last in runs)
    return Finding(
        name,
        "blocked beams",
        f"{int(blocked.sum())} of {blocked.size} beams always see the robot itself: {beams}",
        "parts that move with the robot bias the matching and are drawn as walls",
        ({"lidars": {name: {"blocked_beams": [list(run) for run in runs]}}},),
        sure=True,
        value=float(blocked.mean()),
    )


def _far_apart(a: Float32Array, b: Float32Array, least_m: float) -> bool:
    """Whether a tenth of the beams with returns in both differ by more than ``least_m``."""
    both = np.isfinite(a) & np.isfinite(b)
    return bool(10 * np.count_nonzero(np.abs(a[both] - b[both]) > least_m) > np.count_nonzero(both))
