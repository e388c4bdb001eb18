"""Wheel odometry at the steps of a lidar, under different assumptions about its errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.estimation import FEWEST, SETTLED, gate
from fusion.time_alignment import GAP_S, ClockOffset, clock_offset
from slam.doctor.relation import ComplexArray, Linear, Relation, fit_linear, relate
from slam.doctor.scan_motion import ScanMotion, Steps
from slam.measurements import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Reading:
    """One interpretation of the written wheel odometry.

    Attributes
    ----------
    heading_scale
        Factor of the written heading.
    flipped
        Whether one of the written axes has the wrong sign.
    """

    heading_scale: float = 1.0
    flipped: bool = False


@dataclass(frozen=True, slots=True)
class WheelSteps:
    """Wheel odometry at both ends of a lidar's steps, (K,) each.

    Attributes
    ----------
    places
        (K, 2) written positions as complex numbers, at start and end.
    headings_rad
        (K, 2) written headings, unwrapped.
    """

    lidar: ComplexArray
    lidar_turns_rad: FloatArray
    stretch: FloatArray
    places: ComplexArray
    headings_rad: FloatArray

    @classmethod
    def of(cls, steps: Steps, rows: FloatArray, ahead_s: float) -> WheelSteps:
        """The steps with both ends in the wheels' readings (N, 4), whose clock is ahead by ``ahead_s``."""
        sensor_s = steps.spans_s + ahead_s
        after = np.clip(np.searchsorted(rows[:, 0], sensor_s), 1, len(rows) - 1)
        covered = (rows[after, 0] - rows[after - 1, 0] < 2.0 * GAP_S) & (sensor_s >= rows[0, 0])
        covered &= sensor_s <= rows[-1, 0]
        use = covered.all(axis=1)
        x, y, heading = (np.interp(sensor_s[use], rows[:, 0], column) for column in rows[:, 1:].T)
        motions = steps.motions[use]
        return cls(motions[:, 0] + 1j * motions[:, 1], motions[:, 2], steps.stretch[use], x + 1j * y, heading)

    def __len__(self) -> int:
        return len(self.lidar)

    @property
    def turns_rad(self) -> FloatArray:
        """(K,) written rotations."""
        return np.asarray(self.headings_rad[:, 1] - self.headings_rad[:, 0])

    def steps(self, reading: Reading) -> ComplexArray:
        """(K,) steps in the robot's own frame."""
        places = self.places.conj() if reading.flipped else self.places
        return np.asarray(
            (places[:, 1] - places[:, 0]) * np.exp(-1j * reading.heading_scale * self.headings_rad[:, 0])
        )

    def turn_scale(self) -> Linear | None:
        """Factor from written rotations to the lidar's; None for too few."""
        return fit_linear(self.turns_rad[:, None], self.lidar_turns_rad, self.stretch)

    def related(self, reading: Reading) -> Relation | None:
        """The relation under an interpretation; None if not determined."""
        return relate(self.lidar, self.lidar_turns_rad, self.steps(reading), self.stretch)

    def misfits(self, reading: Reading, found: Relation) -> FloatArray:
        """(K,) residual of each step, metres."""
        swing = np.exp(1j * self.lidar_turns_rad) - 1.0
        return np.abs(self.lidar - found.alpha * self.steps(reading) - found.beta * swing)

    def best(self, readings: list[Reading]) -> tuple[Reading, Relation] | None:
        """The interpretation that most steps agree with; the first, unless another is clearly better."""
        found = [(one, relation) for one in readings if (relation := self.related(one)) is not None]
        if not found:
            return None
        misfits = np.array([self.misfits(*pair) for pair in found])
        sigma_m = max(min(relation.sigma_m for _, relation in found), SETTLED)
        agree: BoolArray = misfits**2 < gate(2) * sigma_m**2
        best = int(np.argmax(agree.sum(axis=1)))
        alone = int((agree[best] & ~agree[0]).sum()), int((agree[0] & ~agree[best]).sum())
        # If both were equally good, steps that only one explains would be divided like coin tosses.
        beyond = alone[0] - alone[1] > np.sqrt(gate() * max(sum(alone), 1)) and alone[0] >= FEWEST // 2
        return found[best] if beyond else found[0]


def clock_of(tracked: list[ScanMotion], rows: FloatArray, sign: float) -> ClockOffset | None:
    """How far the wheels' clock is ahead of the lidar's; None if the rotations do not determine it."""
    spans = np.concatenate(
        [np.column_stack([one.stamps_s[:-1], one.stamps_s[1:]]) for one in tracked] or [np.zeros((0, 2))]
    )
    turned = np.concatenate([np.diff(np.unwrap(one.poses[:, 2])) for one in tracked] or [np.zeros(0)])
    wheel_spans = np.column_stack([rows[:-1, 0], rows[1:, 0]])
    return clock_offset(spans, turned, wheel_spans, sign * np.diff(rows[:, 3]), most_s=2.0)
