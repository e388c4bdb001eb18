"""Finds beam directions and "no return" codes of a laser, for logs that do not contain them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fusion.estimation import FEWEST
from fusion.kernel import ZERO, kernel
from slam.datasets.budget import MOST_BEAMS
from slam.datasets.dataset import RecordFault
from slam.measurements import Float32Array, FloatArray

ZERO_BEAMS = "scan without beams"
NO_VALID_RANGE = "scan without a valid range"
MANY_BEAMS = "scan of more beams than any lidar has"

# A SICK LMS in its 80 m mode codes "no return" and errors as 8183, 8187, 8190 and 8191 cm.
SICK_LARGEST_CODE_FREE_M = 81.83
# Without a stated maximum: above any valid reading of common scanners, below the codes.
DEFAULT_NO_RETURN_M = 80.0
_CODE_TOLERANCE_M = 1e-6
_UNITS_IN_A_M = (100.0, 1000.0)  # centimetres, millimetres
# On a wall, with quantised ranges, the shortest range has 1 + sqrt(2) times as many beams as the next.
ALIKE = FEWEST // 4

_DEFAULT_FOV_DEG = 180.0
# Beam counts that imply a field of view: SICK LMS 2xx in its 100 degree mode, 270 degree scanners.
_FOV_BY_BEAM_COUNT_DEG = {101: 100.0, 201: 100.0, 401: 100.0, 541: 270.0, 811: 270.0, 1081: 270.0}


@dataclass(frozen=True, slots=True)
class BeamLayout:
    """Bearings of a fan of beams, counter-clockwise, symmetric about the laser's x axis.

    Attributes
    ----------
    start_rad, step_rad
        Bearing of beam 0 and the increment.
    contradiction
        Whether the stated field of view or resolution did not fit the beam count and was ignored.
    """

    start_rad: float
    step_rad: float
    contradiction: bool = False


def beam_layout(beam_count: int, fov_rad: float | None = None, step_rad: float | None = None) -> BeamLayout:
    """Bearings for a scan line that gives only ranges.

    The convention of the logs, by the beam count:

    - odd (181, 361): both edge beams exist, -fov/2 to +fov/2, step = fov / (count - 1);
    - even (180, 360): the last edge beam is missing, beam 0 at -fov/2, step = fov / count.

    The field of view is the stated one; else it follows from the stated step; else from the beam
    count (100 degrees for 101, 201, 401; 270 for 541, 811, 1081; 180 for all others). When both are stated,
    the edge beam exists if fov / step + 1 is the count and is missing if fov / step is the count, whatever
    its parity. If neither holds, both are ignored: the beam count has priority.

    Parameters
    ----------
    beam_count
        1 or more. A single beam points forward.
    fov_rad, step_rad
        As in the log; None, zero, negative, more than a full turn or not finite: not stated.

    Returns
    -------
    BeamLayout
        ``contradiction`` is whether a stated value was ignored.
    """
    fov = fov_rad if _is_angle(fov_rad) else None
    step = step_rad if _is_angle(step_rad) else None
    is_odd = beam_count % 2
    if beam_count == 1:
        return BeamLayout(0.0, fov or math.radians(_DEFAULT_FOV_DEG))
    if fov is not None and step is not None:
        intervals = round(fov / step)
        if abs(fov / step - intervals) < 0.05 and intervals in (beam_count - 1, beam_count):
            return BeamLayout(-0.5 * fov, fov / intervals)
        return _spread(beam_count, _default_fov_rad(beam_count), contradiction=True)
    if step is not None:
        fov = step * (beam_count - is_odd)
        if fov > 2.0 * math.pi + step:
            return _spread(beam_count, _default_fov_rad(beam_count), contradiction=True)
    return _spread(beam_count, fov if fov is not None else _default_fov_rad(beam_count))


def _spread(beam_count: int, fov_rad: float, *, contradiction: bool = False) -> BeamLayout:
    """Distribute the beams over a field of view, by the parity of their count."""
    return BeamLayout(-0.5 * fov_rad, fov_rad / (beam_count - beam_count % 2), contradiction)


def _default_fov_rad(beam_count: int) -> float:
    """The field of view that a beam count implies."""
    return math.radians(_FOV_BY_BEAM_COUNT_DEG.get(beam_count, _DEFAULT_FOV_DEG))


def _is_angle(angle_rad: float | None) -> bool:
    """Whether a stated angle is possible."""
    return angle_rad is not None and 0.0 < angle_rad <= 2.0 * math.pi + 1e-6


@dataclass(slots=True)
class RepeatedRange:
    """Counts how many beams repeat a sensor's longest range bit-identically; and the shortest.

    Codes repeat like this (8.183 m of a SICK). A different longest range counts `ALIKE` times against it.
    """

    longest_m: float = 0.0
    beams: int = 0
    shortest_m: float = 0.0

    def take(self, longest_m: float, beams: int) -> bool:
        """Add a scan's longest range with its number of beams; returns whether the repeated one is a code."""
        if beams > 1:
            self.beams += beams if longest_m == self.longest_m else -ALIKE * beams
        if self.beams < 0:
            self.longest_m, self.beams = longest_m, beams
        return self.beams >= FEWEST


def classify_ranges(
    ranges_m: FloatArray, limit_m: float, repeated: RepeatedRange
) -> tuple[Float32Array, float]:
    """Ranges as `slam.measurements.LaserScan` requires, (N,), and the limit that means no return.

    At or above the limit: ``inf``, no return. Zero, negative or NaN: ``nan``, invalid. If less than half of
    the readings are below the limit, and many different ones above, the limit has another unit and is raised,
    because there are only few "no return" codes. The ranges then show whose unit is wrong. The longest range
    is such a code, stated or not, if it is bit-identical for more beams than on any wall, here or in earlier
    scans of the sensor; the shortest such range is invalid.

    Raises
    ------
    RecordFault
        There are more beams than any lidar has.
    """
    if ranges_m.size > MOST_BEAMS:
        raise RecordFault(MANY_BEAMS, f"{ranges_m.size}, at most {MOST_BEAMS}")
    classified = np.empty(ranges_m.size, np.float32)
    # A stated 81.83 and a written 81.83 must match, whatever their last bit.
    above_count, returns, *ends = _classify(ranges_m, limit_m - _CODE_TOLERANCE_M, classified)
    if 2 * above_count > returns:
        above = ranges_m[np.isfinite(ranges_m) & (classified == math.inf)]
        if np.unique(above).size >= FEWEST:
            limit_m *= next((by for by in _UNITS_IN_A_M if above.max() <= limit_m * by), _UNITS_IN_A_M[-1])
            ends = _classify(ranges_m, limit_m - _CODE_TOLERANCE_M, classified)[2:]
    most_m, most_count, least_m, least_count = ends
    if least_count >= FEWEST and repeated.shortest_m == least_m:
        others = np.unique(ranges_m[(ranges_m > least_m) & np.isfinite(classified)], return_counts=True)[1]
        classified[(ranges_m == least_m) & (least_count > ALIKE * max(others, default=0))] = math.nan
    repeated.shortest_m = least_m
    code_m = repeated.longest_m if repeated.take(most_m, most_count) else math.inf
    # Error codes may be above it, but there are few.
    if code_m <= most_m and 2 * np.count_nonzero(ranges_m == code_m) > np.count_nonzero(ranges_m >= code_m):
        limit_m = code_m
        classified[ranges_m >= limit_m] = math.inf
    return classified, limit_m


@kernel
def _classify(ranges_m, limit_m, classified):  # type: ignore[no-untyped-def]
    """Write the result of `classify_ranges`; return counts (beyond, all), extremes and their counts."""
    above_count, returns, most_count, least_count = ZERO, ZERO, ZERO, ZERO
    most_m, least_m = 0.0, math.inf
    for i in range(ranges_m.size):
        range_m = ranges_m[i]
        classified[i] = math.inf if range_m >= limit_m else range_m if range_m > 0.0 else math.nan
        above_count += limit_m <= range_m < math.inf
        returns += 0.0 < range_m < math.inf
        if 0.0 < range_m < limit_m:
            most_count = most_count + 1 if range_m == most_m else most_count if range_m < most_m else 1
            least_count = least_count + 1 if range_m == least_m else least_count if range_m > least_m else 1
            most_m = max(most_m, range_m)
            least_m = min(least_m, range_m)
    return above_count, returns, most_m, most_count, least_m, least_count
