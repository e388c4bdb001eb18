"""Finds lidar beams that always hit the robot itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.estimation import FEWEST
from slam.config import Config
from slam.doctor.finding import Finding
from slam.measurements import BoolArray, Float32Array, LaserScan


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
