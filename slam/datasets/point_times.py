"""Finds times and intensities of points in a cloud, for all names and units of drivers."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from slam.datasets.dataset import WARNING
from slam.datasets.stamped_files import UNITS_S
from slam.measurements import Float32Array, FloatArray

# By the names of all known drivers: t, ts, time, timestamp, offset_time, gps_time and others.
_TIME = re.compile(r"ts?|.*(time|stamp).*", re.IGNORECASE)
# Drivers, PCL, CloudCompare; a reflectivity is an intensity corrected for range.
_INTENSITIES = "intensity", "intensities", "i", "scalar_intensity", "reflectivity", "reflectance", "remission"
# Every revolution takes longer than the first and less than the second; their ratio is that of two units.
_SHORTEST_TURN_S, LONGEST_TURN_S = 0.002, 2.0
_SAME_CLOCK_S = 1.0


class PointTimes:
    """Point times of one lidar; the first cloud of a full revolution defines field and unit for all.

    Parameters
    ----------
    stamped
        Whether clouds have stamps; otherwise the first point's time is that of the cloud.

    Attributes
    ----------
    choice
        Field and unit as text; empty before the first cloud.
    """

    def __init__(self, stamped: bool = True) -> None:
        self.choice = ""
        self._stamped = stamped
        self._field = ""
        self._unit_s = 0.0
        self._interpolated = False

    def notes(self, sensor: str) -> list[str]:
        """Notes for the user about the lidar with this name."""
        zero = f"{WARNING}{sensor}: many points have no time; it is interpolated from their neighbours"
        return [f"{sensor}: {self.choice}"] * bool(self.choice) + [zero] * self._interpolated

    def of(
        self, names: Iterable[str], column: Callable[[str], NDArray[Any]], stamp_s: float
    ) -> FloatArray | None:
        """Point times in s after the stamp of a cloud, (N,); None if the cloud does not contain them.

        Parameters
        ----------
        column
            The values of a field, (N,).
        """
        names = list(names)
        if not self._field:
            self._choose(names, column)
        if self._field not in names:
            return None
        with np.errstate(invalid="ignore", over="ignore"):
            times_s: FloatArray = column(self._field).astype(np.float64) * self._unit_s
        timed = np.flatnonzero(times_s)
        if FEWEST < 4 * timed.size < 3 * times_s.size:  # a quarter is not at the stamp itself
            times_s = np.interp(np.arange(times_s.size), timed, times_s[timed])
            self._interpolated = True
        if not times_s.size or not np.isfinite(times_s).all() or np.ptp(times_s) > LONGEST_TURN_S:
            return None
        first_s = float(times_s.min())
        if not self._stamped:
            return times_s - first_s
        if abs(first_s) <= LONGEST_TURN_S:
            return times_s
        # If the clock is not that of the stamp, only differences are meaningful.
        return times_s - (stamp_s if abs(first_s - stamp_s) < _SAME_CLOCK_S else first_s)

    def _choose(self, names: Iterable[str], column: Callable[[str], NDArray[Any]]) -> None:
        """Find the time field, and its unit from the possible durations of a revolution."""
        self.choice = "points without times"
        for name in sorted(filter(_TIME.fullmatch, names), key=len):
            values = column(name)
            kind, values = values.dtype, values.astype(np.float64)
            span = float(np.ptp(values)) if values.size and np.isfinite(values).all() else 0.0
            self.choice = f"times of points in field {name} span {span:g}, which is no revolution: not used"
            for unit, unit_s in UNITS_S.items():
                if _SHORTEST_TURN_S < span * unit_s <= LONGEST_TURN_S:
                    self._field, self._unit_s = name, unit_s
                    absolute = abs(float(values.min()) * unit_s) > LONGEST_TURN_S
                    after = "by a clock" if absolute else "after the stamp of the cloud"
                    self.choice = f"times of points from field {name} ({kind}), {unit} {after}"
                    return


def intensities_of(names: Iterable[str], column: Callable[[str], NDArray[Any]]) -> Float32Array | None:
    """Return (N,) in the sensor's own steps; None if the cloud has none, or only zeros.

    Parameters
    ----------
    column
        The values of a field, (N,).
    """
    own = {name.lower(): name for name in names}
    name_found = next((own[name] for name in _INTENSITIES if name in own), None)
    values = np.zeros(0) if name_found is None else column(name_found)
    with np.errstate(invalid="ignore", over="ignore"):
        return values.astype(np.float32) if values.any() else None
