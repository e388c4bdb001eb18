"""Gyroscope beside a 2D lidar: rotation of a robot on a floor from its rates about the vertical axis.

The rotation is ``w - b t - s w``: w is the rates integrated over the time t, b the bias, and s the scale
error. A Kalman filter estimates b and s from the rotations of matched scans. The accelerometer gives the
vertical axis, so the mounting need not be known.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from fusion.estimation import FEWEST, gate, half_interval
from fusion.time_alignment import GAP_S
from slam.matching.planar import wrap
from slam.measurements import FloatArray, ImuReading
from slam.odometry.clock_learner import ClockLearner, Turns
from slam.odometry.imu_readings import GYRO_UNKNOWN, GYRO_WALK, ImuReadings


@dataclass(frozen=True, slots=True)
class GyroMoment:
    """Rotation of a gyroscope up to a stamp.

    Attributes
    ----------
    stamp_s
        Stamp by its own clock.
    turned_rad
        Integral of its rates about the vertical.
    rate_rad_s
        Rate at that time.
    piece
        Moments of the same piece have no gap between them.
    """

    stamp_s: float
    turned_rad: float
    rate_rad_s: float
    piece: int


class YawGyro:
    """The rotation of one IMU about the vertical, with its uncertainty."""

    def __init__(self) -> None:
        self.sensor = ""
        self._readings = ImuReadings()
        self._clocks = ClockLearner()
        self._ahead_s = 0.0
        self._force = np.zeros(3)
        # Recent readings, the newest last.
        self._recent: deque[GyroMoment] = deque()
        # Start of the comparison with the lidar, its heading and variance.
        self._begun: tuple[GyroMoment, float, float] | None = None
        self._known, self._spread = np.zeros(2), GYRO_UNKNOWN**2
        self._compared_s, self._doubt = 0.0, 1.0

    def add(self, reading: ImuReading) -> None:
        """Add the next reading; ignore one that is not later than the previous one."""
        begun, self.sensor = self._recent[-1] if self._recent else None, reading.sensor
        if begun is not None and reading.stamp_s <= begun.stamp_s:
            return
        self._readings.add(reading)
        self._force += reading.specific_force_m_s2
        rate_rad_s, turned_rad, piece = float(reading.gyro_rad_s @ self._up()), 0.0, 0
        if begun is not None:
            passed_s = reading.stamp_s - begun.stamp_s
            turn_rad = 0.5 * passed_s * (rate_rad_s + begun.rate_rad_s)
            self._clocks.turns.add_turn(begun.stamp_s, reading.stamp_s, turn_rad)
            turned_rad, piece = begun.turned_rad + turn_rad, begun.piece + self._readings.is_gap(passed_s)
        self._recent.append(GyroMoment(reading.stamp_s, turned_rad, rate_rad_s, piece))
        while reading.stamp_s - self._recent[0].stamp_s > 2.0 * GAP_S:
            self._recent.popleft()

    @property
    def unfit(self) -> bool:
        """Return whether it contradicts matches repeatedly: a wrong sign, axis or unit."""
        return self._doubt > gate()

    def moment(self, stamp_s: float) -> GyroMoment | None:
        """Return its rotation at a stamp of the lidar's clock; None if unknown."""
        at_s = stamp_s + self._ahead_s
        before = next((moment for moment in reversed(self._recent) if moment.stamp_s <= at_s), None)
        if before is None or self._readings.is_gap(at_s - before.stamp_s):
            return None
        turned_rad = before.turned_rad + (at_s - before.stamp_s) * before.rate_rad_s
        return replace(before, stamp_s=at_s, turned_rad=turned_rad)

    def turn(
        self, begun: GyroMoment | None, ended: GyroMoment | None, *, chained: bool = False
    ) -> tuple[float, float] | None:
        """Return the rotation between two moments and its variance; None if it is unfit or unknown.

        It is unknown if readings are missing, or if a scan arrives after later stamps.

        Parameters
        ----------
        chained
            Whether it is one of many consecutive ones with errors treated as independent: their bias stays
            the same until it has drifted by its uncertainty.
        """
        if begun is None or ended is None or begun.piece != ended.piece or self.unfit:
            return None
        if begun.stamp_s >= ended.stamp_s:
            return None
        span = _span_of(begun, ended)
        variance = self._noise(begun, ended) + float(span @ self._spread @ span)
        if chained:
            shared_s = min(self._spread[0, 0] / GYRO_WALK**2, self._compared_s)
            variance += float(self._spread[0, 0] * span[0]) * max(shared_s - span[0], 0.0)
        return float(span[1] - self._known @ span), self._doubt * variance

    def learn(self, moment: GyroMoment | None, heading_rad: float, variance: float) -> None:
        """Compare with the heading of a matched scan, from time to time."""
        begun, self._begun = self._begun, None if moment is None else (moment, heading_rad, variance)
        if begun is None or moment is None or begun[0].piece != moment.piece:
            return
        span = _span_of(begun[0], moment)
        if span[0] < FEWEST * GAP_S:
            self._begun = begun
            return
        self._compared_s += float(span[0])
        self._spread = self._spread + np.diag([GYRO_WALK**2 * span[0], 0.0])
        error_rad = wrap(float(span[1] - self._known @ span) - (heading_rad - begun[1]))
        expected = float(span @ self._spread @ span) + self._noise(begun[0], moment) + begun[2] + variance
        squares = error_rad**2 / expected
        # A match may be wrong: outliers have less weight. If they repeat, it is not the match.
        self._doubt = max(1.0, 0.5 * (self._doubt + min(squares, self._doubt * gate())))
        gain = self._spread @ span / (expected * max(1.0, squares / gate()))
        self._known = self._known + gain * error_rad
        self._spread = self._spread - np.outer(gain, span @ self._spread)

    def learn_clock(self, lidar: Turns, *, final: bool = False) -> None:
        """Estimate the clock offset again if due."""
        self._clocks.learn(lidar, final=final)
        if self._clocks.clock.significant_s != self._ahead_s:
            self._ahead_s = self._clocks.clock.significant_s
            # Values read with another clock offset are not compared with later ones.
            self._recent = deque(replace(moment, piece=moment.piece + 1) for moment in self._recent)

    def notes(self) -> list[str]:
        """What a person should know of it."""
        if not self._compared_s:
            return []
        bias, share = zip(self._known.tolist(), np.sqrt(np.diag(self._spread)).tolist(), strict=True)
        wanders = math.degrees(half_interval(bias[1]))
        known = (
            f"{self.sensor}: its gyroscope is {math.degrees(bias[0]):+.3f} +- {wanders:.3f} degrees/s off, "
            f"its rotation {share[0]:+.1%} +- {half_interval(share[1]):.1%} too large (95 %)"
        )
        clock = self._clocks.clock
        return [known, *([clock.note(self.sensor, "lidar")] if clock.known else [])]

    def _up(self) -> FloatArray:
        """Return (3,) the up direction, IMU frame, from the mean force, or else from the mounting."""
        up = self._force
        if not up.any():
            up = np.asarray(self._readings.T_base_imu.rotation().unrotate(np.array([0.0, 0.0, 1.0])))
        return np.asarray(up / np.linalg.norm(up))

    def _noise(self, begun: GyroMoment, ended: GyroMoment) -> float:
        """Return the variance of a rotation from the rate noise, and from the clock if the rate changes."""
        passed_s, faster = ended.stamp_s - begun.stamp_s, ended.rate_rad_s - begun.rate_rad_s
        return self._readings.gyro_density**2 * passed_s + (self._clocks.clock.sigma_s * faster) ** 2


def _span_of(begun: GyroMoment, ended: GyroMoment) -> FloatArray:
    """Return (2,) time and rotation between two moments."""
    return np.array([ended.stamp_s - begun.stamp_s, ended.turned_rad - begun.turned_rad])
