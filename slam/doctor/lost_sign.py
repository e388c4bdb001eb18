"""Detects wheel odometry that lost the sign of the speed and always rolls forward."""

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
    """Times (K, 2) at which wheels that never roll back leave a stop, and have then moved some distance.

    A robot reverses direction only at a stop. Wheels that ever report backward motion have their sign.
    ``rows`` (N, 4) are stamp, x, y, heading.
    """
    steps = np.diff(rows[:, 1:3], axis=0)
    headings_rad = rows[:-1, 3]
    ahead_m = steps[:, 0] * np.cos(headings_rad) + steps[:, 1] * np.sin(headings_rad)
    path_m = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    if len(rows) < FEWEST or -ahead_m[ahead_m < 0.0].sum() > max(distance_m, SETTLED * path_m[-1]):
        return np.zeros((0, 2))
    stamps_s = rows[:, 0]
    # By time, not by readings, which may come every millisecond.
    still = path_m - np.interp(stamps_s - SPACING_S, stamps_s, path_m) < distance_m / FEWEST
    leaves = np.nonzero(still[:-1] & ~still[1:])[0]
    arrived = np.searchsorted(path_m, path_m[leaves] + distance_m)
    # A robot that stops again earlier may have moved in both directions.
    alone = arrived <= np.append(leaves[1:], len(rows) - 1)
    spans_s = np.column_stack([stamps_s[leaves[alone]], stamps_s[arrived[alone]]])
    spans_s = spans_s[np.ptp(spans_s, axis=1) < FEWEST * GAP_S]
    most = 10 * FEWEST  # 0.5 s of CPU time
    return np.asarray(spans_s[:: -(-len(spans_s) // most) or 1])


def lost_sign(
    log: Iterable[Measurement], wheels: str, lidar: str, rows: FloatArray, config: Config
) -> Finding | None:
    """Wheels that report forward motion while the lidar moves back; None if not, or with too few data.

    The sensors agree in everything else; ``rows`` as for `starts_after_stops`.
    """
    spans_s = starts_after_stops(rows, config.keyframes.distance_m)
    enough = FEWEST // 4  # one scan may be matched wrongly, but not so many with the same sign
    if len(spans_s) < enough:
        return None
    ways = [
        way for pair in _scans_at(log, lidar, spans_s) if (way := _forward_m(*pair, rows, config)) is not None
    ]
    back = sum(way < 0.0 for way in ways)
    # Wrong matches are as frequent elsewhere, where neither direction is possible.
    if back - ways.count(0.0) < enough:
        return None
    return Finding(
        wheels,
        "lost sign",
        f"never goes backward, but by {lidar} the robot does at {back} of {len(ways)} starts after a stop: "
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


def _forward_m(first: LaserScan, last: LaserScan, rows: FloatArray, config: Config) -> float | None:
    """Forward motion of the robot between two scans, from the scans alone; None if not determined.

    The search starts at the wheels' step and at the same step back; the better fit is used, or else 0.
    """
    limits = config.match
    stamps_s = np.array([first.stamp_s, last.stamp_s])
    if not rows[0, 0] <= stamps_s[0] < stamps_s[1] <= rows[-1, 0]:
        return None
    ends = np.column_stack([np.interp(stamps_s, rows[:, 0], column) for column in rows[:, 1:].T])
    step = between(ends[0], ends[1])
    if 2.0 * step[0] < config.keyframes.distance_m:
        return None  # with too few scans, both directions fit
    points = [OrientedPoints.from_scan(points_by(config.scan, scan)) for scan in (first, last)]
    local_map = LocalMap.build(points[:1], limits)
    matches = [local_map.align(points[1], guess) for guess in (step, step * [-1.0, -1.0, 1.0])]
    best = max(matches, key=lambda match: match.fit)
    if best.inlier_share < limits.confident_inlier_share or not best.converged:
        return None
    if weak_direction(best, limits.degenerate_share) is not None:
        return None
    ahead_m = float(best.pose[0])
    return ahead_m if 2.0 * abs(ahead_m) > step[0] else 0.0
