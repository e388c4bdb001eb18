"""Panes of glass in a scan: what comes back only where the beam meets it at nearly a right angle.

A lidar sees a pane as a short straight piece around the foot of its normal; aside of it beams are lost or go
through (Foster, Sun, Park and Kuipers 2013, "VisAGGE: Visible angle grid for glass environments", ICRA). What
later passes at a slant says nothing against it: occupancy grids lose glass because they count that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from slam.measurements import BoolArray, FloatArray, LaserScan

_LEAST_RAD, _MOST_RAD = math.radians(4.0), math.radians(13.0)  # angle to the normal at which a pane ends
_LEAST_BEAMS = 8
_STEP_M, _STEP_SHARE = 0.06, 0.01  # between neighbours of one surface: and this share of the range
_FLAT_M = 0.03  # what is round, as a leg or a person, leaves its chord by more
_BEHIND_M, _BESIDE = 0.25, 2  # so many beams beside a pane are lost, or come from farther than this behind it
_ON_M = 0.06  # frame or wall in the plane of a pane
_REACH_M = 1.5  # a pane is followed so far to its frame
_LOST_SHARE = 0.2  # of the beams on the way there; through an open door nearly all come back
_STEEPEST_RAD = 1.2


class Pane(NamedTuple):
    """A piece of a plane that stands upright, in the laser's frame.

    Attributes
    ----------
    bearing_rad, distance_m
        Of the foot of its normal.
    left_m, right_m
        From where to where it reaches along the plane, counted from the foot, counter-clockwise positive.
    """

    bearing_rad: float
    distance_m: float
    left_m: float
    right_m: float

    def points(self, spacing_m: float) -> FloatArray:
        """(N, 2) points on it, in the laser's frame."""
        count = max(2, math.ceil((self.left_m - self.right_m) / spacing_m) + 1)
        along = np.linspace(self.right_m, self.left_m, count)[:, None]
        normal = np.array([math.cos(self.bearing_rad), math.sin(self.bearing_rad)])
        return np.asarray(self.distance_m * normal + along * np.array([-normal[1], normal[0]]))


def find_panes(scan: LaserScan) -> list[Pane]:
    """The panes that a scan meets at a right angle, each followed to its frame where that is in its plane."""
    ranges = np.full(scan.ranges_m.size, np.nan)
    with np.errstate(invalid="ignore"):
        seen = (scan.ranges_m > 0.0) & (scan.ranges_m < scan.range_max_m)
    ranges[seen] = scan.ranges_m[seen]
    bearings = np.linspace(0.0, scan.step_rad * (ranges.size - 1), ranges.size) + scan.start_angle_rad
    if scan.step_rad < 0.0:
        ranges, bearings = ranges[::-1], bearings[::-1]
    with np.errstate(invalid="ignore"):
        one = np.abs(np.diff(ranges)) < _STEP_M + _STEP_SHARE * ranges[:-1]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], one, [False]]).astype(np.int8)))
    first, last = edges[::2], edges[1::2]
    wide = (last - first + 1 >= _LEAST_BEAMS) & (first >= _BESIDE) & (last < ranges.size - _BESIDE)
    first, last = first[wide], last[wide]
    clear = np.ones(first.size, dtype=bool)
    with np.errstate(invalid="ignore"):
        for k in range(1, _BESIDE + 1):
            clear &= ~(ranges[first - k] <= ranges[first] + _BEHIND_M)  # true for nan
            clear &= ~(ranges[last + k] <= ranges[last] + _BEHIND_M)
    found = (_pane(ranges, bearings, slice(a, b + 1)) for a, b in zip(first[clear], last[clear], strict=True))
    return [pane for pane in found if pane is not None]


def _pane(ranges: FloatArray, bearings: FloatArray, part: slice) -> Pane | None:
    """The pane of a run of beams; None where it is not flat, or does not end as glass does."""
    points = ranges[part, None] * np.column_stack([np.cos(bearings[part]), np.sin(bearings[part])])
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][1]
    distance_m = float(middle @ normal)
    if distance_m < 0.0:
        normal, distance_m = -normal, -distance_m
    if np.abs(points @ normal - distance_m).max() > _FLAT_M:
        return None
    foot = math.atan2(normal[1], normal[0])
    angles = (bearings - foot + math.pi) % (2.0 * math.pi) - math.pi
    if not (_LEAST_RAD < -angles[part.start] < _MOST_RAD and _LEAST_RAD < angles[part.stop - 1] < _MOST_RAD):
        return None
    left = _followed(ranges[part.stop - 1 :], angles[part.stop - 1 :], distance_m)
    right = _followed(ranges[part.start :: -1], -angles[part.start :: -1], distance_m)
    return Pane(foot, distance_m, left, -right)


def _followed(ranges: FloatArray, angles: FloatArray, distance_m: float) -> float:
    """How far a pane reaches along its plane, from its last beam on outwards: to the frame, or no farther."""
    within: BoolArray = (angles >= angles[0]) & (angles < _STEEPEST_RAD)
    ends = np.flatnonzero(~within)
    count = int(ends[0]) if ends.size else angles.size
    along = distance_m * np.tan(angles[:count])
    count = int(np.searchsorted(along, along[0] + _REACH_M))
    with np.errstate(invalid="ignore"):
        behind = ranges[1:count] - distance_m / np.cos(angles[1:count])
        met = np.flatnonzero(behind <= _ON_M)
    if not met.size or behind[met[0]] < -_ON_M:
        return float(along[0])
    lost = np.isnan(behind[: met[0]])
    return float(along[met[0] + 1] if lost.sum() >= _LOST_SHARE * lost.size else along[0])
