"""Wheels that tell speed without its sign: whatever they roll, they roll ahead."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fusion.estimation import FEWEST, SETTLED
from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.doctor.finding import Finding
from slam.doctor.samples import SPACING_S
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.match_covariance import weak_direction
from slam.matching.planar import between
from slam.matching.scan_points import points_by
from slam.measurements import FloatArray, LaserScan, Measurement


def starts_after_stops(rows: FloatArray, distance_m: float) -> FloatArray:
    """When wheels that never roll back leave a stop, and when they have then gone some way.

    A robot turns round only where it stops. Wheels that ever tell a way back have their sign.

    Parameters
    ----------
    rows
        (N, 4) stamp, x, y, heading.

    Returns
    -------
    (K, 2) stamps, rising; none where the wheels do tell of ways back.
    """
    steps = np.diff(rows[:, 1:3], axis=0)
    headings_rad = rows[:-1, 3]
    ahead_m = steps[:, 0] * np.cos(headings_rad) + steps[:, 1] * np.sin(headings_rad)
    way_m = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    if len(rows) < FEWEST or -ahead_m[ahead_m < 0.0].sum() > max(distance_m, SETTLED * way_m[-1]):
        return np.zeros((0, 2))
    stamps_s = rows[:, 0]
    # By time, not by readings: these may come every millisecond.
    still = way_m - np.interp(stamps_s - SPACING_S, stamps_s, way_m) < distance_m / FEWEST
    leaves = np.nonzero(still[:-1] & ~still[1:])[0]
    gone = np.searchsorted(way_m, way_m[leaves] + distance_m)
    # Who stops again before may have gone both ways.
    alone = gone <= np.append(leaves[1:], len(rows) - 1)
    spans_s = np.column_stack([stamps_s[leaves[alone]], stamps_s[gone[alone]]])
    spans_s = spans_s[np.ptp(spans_s, axis=1) < FEWEST * GAP_S]
    most = 10 * FEWEST  # half a CPU second
    return np.asarray(spans_s[:: -(-len(spans_s) // most) or 1])


def lost_sign(
    log: Iterable[Measurement], wheels: str, lidar: str, rows: FloatArray, config: Config
) -> Finding | None:
    """Wheels that tell a way ahead where the lidar goes back; None where it does not, or tells too little.

    Parameters
    ----------
    log
        The measurements again.
    wheels, lidar
        Names of two sensors that agree otherwise.
    rows
        (N, 4) of the wheels.
    """
    spans_s = starts_after_stops(rows, config.keyframes.distance_m)
    enough = FEWEST // 4  # one scan may be matched wrongly; not so many, all the same way
    if len(spans_s) < enough:
        return None
    ways = [
        way
        for pair in _scans_at(log, lidar, spans_s)
        if (way := _way_ahead_m(*pair, rows, config)) is not None
    ]
    back = sum(way < 0.0 for way in ways)
    # Matches that are wrong say so as often elsewhere, where neither way can be.
    if back - ways.count(0.0) < enough:
        return None
    return Finding(
        wheels,
        "lost sign",
        f"never goes backward, but at {back} of {len(ways)} starts after a stop {lidar} does: "
        "its speed is recorded without a sign",
        "where the robot goes backward, the wheel odometry is wrong and the scans must determine the map",
        sure=True,
        value=back / len(ways),
    )


def _scans_at(
    log: Iterable[Measurement], lidar: str, spans_s: FloatArray
) -> Iterable[tuple[LaserScan, LaserScan]]:
    """The first scans at or after both stamps of each span."""
    asked, begun = 0, None
    for scan in log:
        if not isinstance(scan, LaserScan) or scan.sensor != lidar:
            continue
        while asked < len(spans_s) and begun is None and scan.stamp_s > spans_s[asked, 1]:
            asked += 1
        if asked == len(spans_s):
            return
        if begun is None and scan.stamp_s >= spans_s[asked, 0]:
            begun = scan
        elif begun is not None and scan.stamp_s >= spans_s[asked, 1]:
            yield begun, scan
            begun, asked = None, asked + 1


def _way_ahead_m(first: LaserScan, last: LaserScan, rows: FloatArray, config: Config) -> float | None:
    """How far the robot went ahead between two scans, by them alone; None where they leave it open.

    The wheels' step, and the same step back, are where the search begins; the one that fits better counts, as
    0 where it is neither.
    """
    limits = config.match
    stamps_s = np.array([first.stamp_s, last.stamp_s])
    if not rows[0, 0] <= stamps_s[0] < stamps_s[1] <= rows[-1, 0]:
        return None
    told = np.column_stack([np.interp(stamps_s, rows[:, 0], column) for column in rows[:, 1:].T])
    step = between(told[0], told[1])
    if 2.0 * step[0] < config.keyframes.distance_m:
        return None  # by fewer scans than that takes, both ways fit
    points = [OrientedPoints.from_scan(points_by(config.scan, scan)) for scan in (first, last)]
    local_map = LocalMap.build(points[:1], limits)
    found = [local_map.align(points[1], guess) for guess in (step, step * [-1.0, -1.0, 1.0])]
    best = max(found, key=lambda one: one.fit)
    if best.inlier_share < limits.confident_inlier_share or not best.converged:
        return None
    if weak_direction(best, limits.degenerate_share) is not None:
        return None
    ahead_m = float(best.pose[0])
    return ahead_m if 2.0 * abs(ahead_m) > step[0] else 0.0
