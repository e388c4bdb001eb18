"""By how much a camera's clock is ahead of the robot's, learned from how fast both say that it turns."""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fusion.time_alignment import clock_offset
from slam.measurements import FloatArray
from slam.odometry.wheel_gaps import LONGEST_EXTRAPOLATION_S

# Offsets of up to this are tried: more is no clock, but two logs.
_MOST_S = 0.25
# The offset is estimated from stretches of this length.
_STRETCH_S = 60.0
# A stretch tells an offset where the rates are as alike as this, and the offset as certain as this.
_LEAST_CORRELATION = 0.9
_GREATEST_SIGMA_S = 0.02
# A rate that the robot did not turn with anywhere near, by more than this, is a wrong match.
_SLACK_RAD_S = 0.2
# No estimate is more certain than the stamps themselves; and without one, clocks are taken to agree this
# well.
_JITTER_S = 0.003
_UNKNOWN_S = 0.01
# The offset is estimated when so much is recorded, and anew whenever the run has grown by this factor.
_FIRST_S = 10.0
_GROWTH = 1.25


@dataclass(frozen=True, slots=True)
class CameraClock:
    """A camera's clock against the robot's.

    Attributes
    ----------
    offset_s
        The camera's stamp less the robot's, for the same instant; 0 where it is not known.
    sigma_s
        Standard deviation of the time between two of their stamps once the offset is taken off.
    known
        Whether the motions told the offset.
    """

    offset_s: float = 0.0
    sigma_s: float = _UNKNOWN_S
    known: bool = False


class YawRates:
    """How fast something turned, from its heading now and then: flat columns."""

    def __init__(self) -> None:
        self._stamps = array("d")
        self._rates = array("d")
        self._stamp_s = -np.inf
        self._yaw_rad = 0.0

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_s(self) -> float:
        """Stamp of the newest rate; minus infinity without any."""
        return self._stamps[-1] if self._stamps else -np.inf

    @property
    def oldest_s(self) -> float:
        """Stamp of the oldest rate; minus infinity without any."""
        return self._stamps[0] if self._stamps else -np.inf

    def add(self, stamp_s: float, yaw_rad: float) -> None:
        """Take a heading; a rate belongs to the middle between two of them."""
        step_s = stamp_s - self._stamp_s
        if 0.0 < step_s < LONGEST_EXTRAPOLATION_S:
            turn = np.remainder(yaw_rad - self._yaw_rad + np.pi, 2.0 * np.pi) - np.pi
            self.add_rate(stamp_s - 0.5 * step_s, float(turn) / step_s)
        self._stamp_s, self._yaw_rad = stamp_s, yaw_rad

    def add_rate(self, stamp_s: float, rate_rad_s: float) -> None:
        """Take a rate; one whose stamp does not rise is left out."""
        if stamp_s > self.newest_s:
            self._stamps.append(stamp_s)
            self._rates.append(rate_rad_s)

    def between(self, first_s: float, last_s: float) -> tuple[FloatArray, FloatArray]:
        """(N,) stamps and (N,) rates of a stretch."""
        stamps = np.array(self._stamps)
        inside = (stamps >= first_s) & (stamps <= last_s)
        return stamps[inside], np.array(self._rates)[inside]


class ClockLearner:
    """Collects a camera's yaw rates and says what its clock is."""

    def __init__(self) -> None:
        self.rates = YawRates()
        self.clock = CameraClock()
        self._due_s = _FIRST_S

    def learn(self, robot: YawRates, *, final: bool = False) -> None:
        """Estimate the offset anew where enough has been recorded since the last time."""
        if not len(self.rates) or not len(robot):
            return
        recorded_s = self.rates.newest_s - self.rates.oldest_s
        if not final and recorded_s < self._due_s:
            return
        self._due_s = max(_FIRST_S, _GROWTH * recorded_s)
        found = [offset for stretch in self._stretches() if (offset := self._offset(robot, *stretch))]
        if not found:
            return
        offsets, sigmas = np.array(found).T
        weights = 1.0 / sigmas**2
        offset_s = float(weights @ offsets / weights.sum())
        self.clock = CameraClock(offset_s, float(np.hypot(weights.sum() ** -0.5, _JITTER_S)), known=True)

    def _stretches(self) -> list[tuple[float, float]]:
        """Where to look, evenly over the run."""
        stamps, _ = self.rates.between(-np.inf, np.inf)
        count = max(1, int((stamps[-1] - stamps[0]) / _STRETCH_S))
        edges = np.linspace(stamps[0], stamps[-1], count + 1)
        return list(pairwise(edges.tolist()))

    def _offset(self, robot: YawRates, first_s: float, last_s: float) -> tuple[float, float] | None:
        """Offset and sigma of one stretch; None where it does not tell."""
        robot_s, robot_rate = robot.between(first_s - _MOST_S, last_s + _MOST_S)
        camera_s, camera_rate = self.rates.between(first_s, last_s)
        if robot_s.size < 2:
            return None
        # What the robot turned with at some time within the greatest offset.
        near = np.linspace(-_MOST_S, _MOST_S, 11)
        expected = np.stack([np.interp(camera_s + shift, robot_s, robot_rate) for shift in near])
        low, high = expected.min(axis=0) - _SLACK_RAD_S, expected.max(axis=0) + _SLACK_RAD_S
        right = (camera_rate >= low) & (camera_rate <= high)
        found = clock_offset(robot_s, robot_rate, camera_s[right], camera_rate[right], _MOST_S)
        if found is None or found.correlation < _LEAST_CORRELATION or found.sigma_s > _GREATEST_SIGMA_S:
            return None
        return found.offset_s, found.sigma_s
