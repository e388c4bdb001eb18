"""Estimate the clock offset of a sensor from the rotation that it and the robot measure."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import special

from fusion.estimation import CONFIDENCE, FEWEST, half_interval
from fusion.time_alignment import GAP_S, clock_offset, turns_between
from slam.matching.planar import wrap
from slam.measurements import FloatArray

# Largest offset tried: a larger one means two different logs.
_MOST_S = 0.25
# The offset is estimated from stretches of this length.
_STRETCH_S = 60.0
# Least correlation of rotations for an offset from a stretch; required sigma of all together.
_LEAST_CORRELATION = 0.9
_GREATEST_SIGMA_S = 0.02
# A rate that differs by more than this from all rates of the robot nearby is a wrong match.
_SLACK_RAD_S = 0.2
# No estimate is more certain than the stamps; without an estimate, clocks are assumed to agree this well.
_JITTER_S = 0.003
_UNKNOWN_S = 0.01
# The offset is estimated after so much data, and again whenever the run has grown by this factor.
_FIRST_S = 10.0
_GROWTH = 1.25


@dataclass(frozen=True, slots=True)
class SensorClock:
    """A sensor's clock against the robot's.

    Attributes
    ----------
    offset_s
        The sensor's stamp minus the robot's, for the same instant; 0 if unknown.
    sigma_s
        Standard deviation of the time between two of their stamps after correction.
    stretches
        Number of stretches of the run that determined the offset.
    """

    offset_s: float = 0.0
    sigma_s: float = _UNKNOWN_S
    stretches: int = 0

    @property
    def known(self) -> bool:
        """Return whether the motions determined the offset."""
        return self.stretches > 0

    @property
    def significant_s(self) -> float:
        """Return the offset; 0 if its interval contains 0 (Student's t, for few stretches)."""
        if self.stretches < 2:
            return 0.0
        limit_s = float(special.stdtrit(self.stretches - 1, 0.5 + 0.5 * CONFIDENCE)) * self.sigma_s
        return self.offset_s if abs(self.offset_s) > limit_s else 0.0

    def note(self, name: str, other: str) -> str:
        """Return a note for the user."""
        half_ms = 1e3 * half_interval(self.sigma_s)
        clock = f"{name}: its clock is {1e3 * self.offset_s:+.0f} +- {half_ms:.0f} ms (95 %)"
        return f"{clock} against the {other}'s"


class Turns:
    """Rotations from one stamp to the next, in columns."""

    def __init__(self) -> None:
        self._spans = array("d")
        self._turns = array("d")
        self._stamp_s = -np.inf
        self._yaw_rad = 0.0

    def __len__(self) -> int:
        return len(self._turns)

    @property
    def newest_s(self) -> float:
        """Return the end of the newest rotation; minus infinity without any."""
        return self._spans[-1] if self._spans else -np.inf

    @property
    def oldest_s(self) -> float:
        """Return the start of the oldest rotation; minus infinity without any."""
        return self._spans[0] if self._spans else -np.inf

    def add(self, stamp_s: float, yaw_rad: float) -> None:
        """Add a heading; ignore one whose stamp does not increase."""
        if stamp_s <= self._stamp_s:
            return
        if math.isfinite(self._stamp_s):
            self.add_turn(self._stamp_s, stamp_s, wrap(yaw_rad - self._yaw_rad))
        self._stamp_s, self._yaw_rad = stamp_s, yaw_rad

    def add_turn(self, begun_s: float, ended_s: float, turn_rad: float) -> None:
        """Add a rotation; ignore one whose stamps do not increase, or that overlaps the last one."""
        if self.newest_s <= begun_s < ended_s:
            self._spans.extend((begun_s, ended_s))
            self._turns.append(turn_rad)

    def between(self, first_s: float, last_s: float) -> tuple[FloatArray, FloatArray]:
        """Return (N, 2) stamps and (N,) rotations of a stretch."""
        spans = np.array(self._spans).reshape(-1, 2)
        inside = (spans[:, 0] >= first_s) & (spans[:, 1] <= last_s)
        return spans[inside], np.array(self._turns)[inside]


class ClockLearner:
    """Collects the rotations of a sensor and estimates its clock offset."""

    def __init__(self) -> None:
        self.turns = Turns()
        self.clock = SensorClock()
        self._due_s = _FIRST_S

    def learn(self, robot: Turns, *, final: bool = False) -> None:
        """Estimate the offset again if there are enough new data."""
        if not len(self.turns) or not len(robot):
            return
        recorded_s = self.turns.newest_s - self.turns.oldest_s
        if not final and recorded_s < self._due_s:
            return
        self._due_s = max(_FIRST_S, _GROWTH * recorded_s)
        estimates = [
            offset for stretch in self._stretches(len(robot)) if (offset := self._offset(robot, *stretch))
        ]
        self.clock = SensorClock()
        if not estimates:
            return
        offsets, sigmas = np.array(estimates).T
        weights = 1.0 / sigmas**2
        offset_s = float(weights @ offsets / weights.sum())
        # If stretches differ by more than their sigmas, all of them are less certain.
        scatter = float(weights @ (offsets - offset_s) ** 2) / max(1, len(estimates) - 1)
        sigma_s = math.sqrt(max(1.0, scatter) / weights.sum())
        if sigma_s < _GREATEST_SIGMA_S:
            self.clock = SensorClock(offset_s, math.hypot(sigma_s, _JITTER_S), len(estimates))

    def _stretches(self, turns: int) -> list[tuple[float, float]]:
        """Choose stretches evenly over a run of so many rotations, each with enough to compare."""
        first_s, last_s = self.turns.oldest_s, self.turns.newest_s
        count = max(1, min(int((last_s - first_s) / _STRETCH_S), 2 * turns // (3 * FEWEST)))
        return list(pairwise(np.linspace(first_s, last_s, count + 1).tolist()))

    def _offset(self, robot: Turns, first_s: float, last_s: float) -> tuple[float, float] | None:
        """Return offset and sigma of one stretch; None if it does not determine them."""
        spans, turned = robot.between(first_s, last_s)
        own_spans, own_turned = self.turns.between(first_s - 2.0 * _MOST_S, last_s + 2.0 * _MOST_S)
        if not turned.size or not own_turned.size:
            return None
        right = _plausible(own_spans, own_turned, spans, turned)
        if not right.any():
            return None
        # A wrong match, or a jump of the wheels: the data before and after remain valid.
        middles, lasted_s = own_spans.mean(axis=1), own_spans[:, 1] - own_spans[:, 0]
        smooth = np.interp(middles, middles[right], (own_turned / lasted_s)[right])
        own_turned = np.where(right, own_turned, smooth * lasted_s)
        right = _plausible(spans, turned, own_spans, own_turned)
        offset = clock_offset(spans[right], turned[right], own_spans, own_turned, _MOST_S)
        if offset is None or offset.correlation < _LEAST_CORRELATION:
            return None
        return offset.offset_s, offset.sigma_s


def _plausible(
    spans_s: FloatArray, turned: FloatArray, other_s: FloatArray, other_turned: FloatArray
) -> NDArray[np.bool_]:
    """Return (N,) whether another sensor has measured a similar rotation within the largest offset."""
    trial_s = np.linspace(-_MOST_S, _MOST_S, 11)
    expected = turns_between(other_s, other_turned, spans_s + trial_s[:, None, None])
    there = np.clip(np.searchsorted(other_s[:, 1], spans_s.mean(axis=1)), 0, len(other_s) - 1)
    coarsest_s = np.maximum(spans_s[:, 1] - spans_s[:, 0], (other_s[:, 1] - other_s[:, 0])[there])
    slack = _SLACK_RAD_S * np.minimum(coarsest_s, GAP_S)
    return np.asarray((turned >= expected.min(axis=0) - slack) & (turned <= expected.max(axis=0) + slack))
