"""The floor where a lidar that tilts sees it: a straight line ahead that goes wherever the robot goes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fusion.estimation import FEWEST
from slam.config import Config
from slam.doctor.finding import Finding
from slam.doctor.scan_motion import ScanMotion
from slam.measurements import FloatArray, LaserScan


def floor_findings(
    name: str, stretches: Sequence[Sequence[LaserScan]], tracked: Sequence[ScanMotion], config: Config
) -> list[Finding]:
    """What is said of a lidar that sees the floor; nothing where it sees none, or hardly turns.

    While a robot turns, walls turn with what it sees. A line that stays, on both sides of its middle, and
    behind which nothing ever is, is the floor.
    """
    turned = [one for one in tracked if np.ptp(np.unwrap(one.poses[:, 2])) > config.keyframes.angle_rad]
    known = {scan.stamp_s: scan for scans in stretches for scan in scans}
    scans = [known[stamp_s] for one in turned for stamp_s in one.stamps_s.tolist()]
    scans = [scan for scan in scans if scan.ranges_m.size == scans[0].ranges_m.size]
    if len(scans) < FEWEST:
        return []
    table = np.array([np.where(np.isfinite(scan.ranges_m), scan.ranges_m, 0.0) for scan in scans])
    middles_rad = np.linspace(-math.pi, math.pi, 6 * FEWEST, endpoint=False).tolist()
    angles = scans[0].bearings_rad()
    lines = [_line(table, np.angle(np.exp(1j * (angles - one)))) for one in middles_rad]
    (share, at_m), middle_rad = max(zip(lines, middles_rad, strict=True))
    # As far as the lidar reaches it sees no line, but an arc.
    reach_m = float(np.quantile(table[table > 0.0], 1.0 - FEWEST**-2)) if table.any() else 0.0
    if share <= 2.0 / FEWEST or at_m > math.cos(math.pi / 4) * reach_m:
        return []
    line = {"from_m": round((1.0 - 2.0 / FEWEST) * at_m, 2), "bearing_deg": round(math.degrees(middle_rad))}
    text = (
        f"tilts and sees the floor, {at_m:.1f} m away at {line['bearing_deg']} degrees: wherever the robot "
        "turns, a straight line, and nothing behind"
    )
    effect = "it is drawn as walls and bends the way"
    remedy = {"lidars": {name: {"floor": line}}}
    return [Finding(name, "floor", text, effect, (remedy,), sure=True, value=at_m)]


def _line(ranges_m: FloatArray, aside_rad: FloatArray) -> tuple[float, float]:
    """The share of scans (S, N) that see a line across a bearing on both sides, and how far away it is.

    The share is 0 where things are seen behind.
    """
    near = np.abs(aside_rad) < math.pi / 4
    ahead_m, left = ranges_m[:, near] * np.cos(aside_rad[near]), aside_rad[near] > 0.0
    if min(np.count_nonzero(left), np.count_nonzero(~left)) < FEWEST:
        return 0.0, 0.0
    last = ahead_m.shape[1] - ahead_m.shape[1] // FEWEST
    farthest = np.partition(ahead_m, last, axis=1)[:, last]
    at_m = float(np.quantile(farthest, 1.0 - 2.0 / FEWEST))
    if at_m == 0.0 or np.mean(farthest > (1.0 + 2.0 / FEWEST) * at_m) >= 1.0 / FEWEST:
        return 0.0, at_m
    on_line = np.abs(ahead_m - at_m) < at_m / FEWEST
    # Where scans are cut off, nothing is seen more often.
    sides = [(on_line[:, one], ahead_m[:, one] == 0.0) for one in (left, ~left)]
    seen = [np.count_nonzero(on, axis=1) > np.maximum(FEWEST // 4, np.sum(no, axis=1)) for on, no in sides]
    return float(min(one.mean() for one in seen)), at_m
