"""Detects the floor in scans of a tilted lidar: a straight line ahead that moves with the robot."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fusion.estimation import FEWEST
from slam.config import Config
from slam.doctor.finding import Finding
from slam.doctor.scan_motion import ScanMotion
from slam.measurements import BoolArray, FloatArray, LaserScan


def floor_findings(
    name: str, stretches: Sequence[Sequence[LaserScan]], tracked: Sequence[ScanMotion], config: Config
) -> list[Finding]:
    """Findings about a lidar that sees the floor; none if it does not see it, or hardly turns.

    While a robot turns, walls rotate in its view. A line that stays through two rotations, on both sides of
    its middle, with nothing behind it, is the floor.
    """
    known = {scan.stamp_s: scan for scans in stretches for scan in scans}
    scans, turns, headings = list[LaserScan](), list[int](), list[float]()
    for turn, one in enumerate(tracked):
        if np.ptp(np.unwrap(one.poses[:, 2])) > config.keyframes.angle_rad:
            scans += [known[stamp_s] for stamp_s in one.stamps_s.tolist()]
            turns += [turn] * len(one.poses)
            headings += np.unwrap(one.poses[:, 2]).tolist()
    if len(scans) < FEWEST or len({scan.ranges_m.size for scan in scans}) > 1:
        return []
    table = np.array([np.where(np.isfinite(scan.ranges_m), scan.ranges_m, 0.0) for scan in scans])
    # At its maximum range, the lidar sees an arc, not a line.
    most_m = math.cos(math.pi / 4) * float(np.quantile(table, 1.0 - FEWEST**-2))
    angles, rows = scans[0].bearings_rad(), np.array([turns, headings])

    def through(seen: BoolArray) -> tuple[int, float]:
        """Number of turns, and their total angle."""
        spans = [np.ptp(rows[1, seen & (rows[0] == turn)]) for turn in np.unique(rows[0, seen])]
        return sum(span > config.keyframes.angle_rad for span in spans), float(sum(spans))

    middles_rad = np.linspace(-math.pi, math.pi, 6 * FEWEST, endpoint=False).tolist()
    lines = [_line(table, np.angle(np.exp(1j * (angles - one))), most_m) for one in middles_rad]
    (count, _), at_m, middle_rad = max(
        (through(seen), at_m, one) for (at_m, seen), one in zip(lines, middles_rad, strict=True)
    )
    if count < 2:
        return []
    line = {"from_m": round((1.0 - 2.0 / FEWEST) * at_m, 2), "bearing_deg": round(math.degrees(middle_rad))}
    text = (
        f"tilts and sees the floor, {at_m:.1f} m away at {line['bearing_deg']} degrees: wherever the robot "
        "turns, a straight line, and nothing behind"
    )
    effect = "it is drawn as walls and distorts the trajectory"
    remedy = {"lidars": {name: {"floor": line}}}
    return [Finding(name, "floor", text, effect, (remedy,), sure=True, value=at_m)]


def _line(ranges_m: FloatArray, aside_rad: FloatArray, most_m: float) -> tuple[float, BoolArray]:
    """Distance of the farthest line perpendicular to a bearing; and which scans (S, N) see it, on both sides.

    None do if something is behind it, or if it is farther than ``most_m``.
    """
    none, near = np.zeros(len(ranges_m), np.bool_), np.abs(aside_rad) < math.pi / 4
    ahead_m, left = ranges_m[:, near] * np.cos(aside_rad[near]), aside_rad[near] > 0.0
    if min(np.count_nonzero(left), np.count_nonzero(~left)) < FEWEST:
        return 0.0, none
    last = ahead_m.shape[1] - ahead_m.shape[1] // FEWEST
    farthest = np.partition(ahead_m, last, axis=1)[:, last]
    at_m = float(np.quantile(farthest, 1.0 - 2.0 / FEWEST))
    if at_m > most_m or np.mean(farthest > (1.0 + 2.0 / FEWEST) * at_m) >= 1.0 / FEWEST:
        return at_m, none
    on_line = np.abs(ahead_m - at_m) < at_m / FEWEST
    # Beams without return (0) must be fewer, otherwise the line is the maximum range.
    sides = [(on_line[:, one], ahead_m[:, one] == 0.0) for one in (left, ~left)]
    seen = [np.count_nonzero(on, axis=1) > np.maximum(FEWEST // 4, np.sum(no, axis=1)) for on, no in sides]
    return at_m, seen[0] & seen[1]
