"""Converts Imu messages to IMU readings."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from fusion.time_alignment import GAP_S
from slam.datasets.bags.decoding import stamp_of
from slam.datasets.bags.topics import shared
from slam.datasets.dataset import RecordFault
from slam.datasets.imu_files import ForceUnit
from slam.datasets.wheels_between import WHEELS_KEPT
from slam.measurements import FloatArray, ImuReading, Measurement

NOT_BOTH = "IMU message without angular rate or acceleration"
NO_HALF = "IMU message without the quantity that its topic provides"
NO_VALUES = "its first message has neither angular rates nor accelerations"


def quantities_in(message: Any) -> tuple[bool, bool]:
    """Whether a message contains angular rates, and whether it contains accelerations.

    A missing quantity is zero on every axis, or its covariance starts with -1 (sensor_msgs).
    """
    rates = message.angular_velocity_covariance[0] != -1.0 and _vector(message.angular_velocity).any()
    forces = message.linear_acceleration_covariance[0] != -1.0 and _vector(message.linear_acceleration).any()
    return bool(rates), bool(forces)


def paired_halves(topics: Iterable[str], quantities: Mapping[str, tuple[bool, bool]]) -> dict[str, str]:
    """For each topic with only angular rates, the topic of the accelerations; empty if there is none.

    A gyroscope may read zero at first; an accelerometer never does.
    """
    known = {topic: quantities[topic] for topic in topics if topic in quantities}
    unpaired = [topic for topic, (rates, forces) in known.items() if forces and not rates]
    pairs = {}
    for topic in (topic for topic, (_, forces) in known.items() if not forces):
        pairs[topic] = max(unpaired, key=lambda other: len(shared(other, topic)), default="")
        unpaired = [other for other in unpaired if other != pairs[topic]]
    return pairs


def _vector(vector: Any) -> FloatArray:
    """(3,) vector of a message."""
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)


@dataclass(slots=True)
class ImuReader:
    """Reads one topic.

    Attributes
    ----------
    T_base_imu
        Its pose on the robot; None if tf does not contain it.
    gyro_alone
        Whether it has no accelerations.
    """

    topic: str
    T_base_imu: gtsam.Pose3 | None
    unit: ForceUnit = field(default_factory=ForceUnit)
    gyro_alone: bool = False

    def notes(self) -> list[str]:
        """Notes for the user."""
        return [f"{self.topic}: {self.unit.choice}"] if self.unit.choice else []

    def read(self, message: Any) -> ImuReading:
        """A reading.

        Raises
        ------
        RecordFault
            A number is not finite, or a quantity is missing, see `quantities_in`.
        """
        gyro, force = _vector(message.angular_velocity), _vector(message.linear_acceleration)
        forces = message.linear_acceleration_covariance[0] != -1.0 and force.any()
        known = message.angular_velocity_covariance[0] != -1.0 and (forces or self.gyro_alone)
        if not known or not np.isfinite([gyro, force]).all():
            raise RecordFault(NOT_BOTH, f"{gyro}, {force}")
        force = np.zeros(3) if self.gyro_alone else self.unit.m_s2(force)
        return ImuReading(stamp_of(message.header), gyro, force, self.T_base_imu, self.topic)


@dataclass(slots=True)
class JoinedImu:
    """One IMU on two topics, as cameras publish it: accelerations interpolated at the gyroscope's stamps.

    The RealSense driver does the same with ``unite_imu_method`` ``linear_interpolation``.

    Attributes
    ----------
    topic, forces_topic
        Topic of the angular rates, which names the sensor, and topic of the accelerations.
    T_base_imu
        Pose of the gyroscope; None if tf does not contain it.
    """

    topic: str
    forces_topic: str
    T_base_imu: gtsam.Pose3 | None
    unit: ForceUnit = field(default_factory=ForceUnit)
    # Limits the queue, whatever the stamps are.
    _rates: deque[tuple[float, FloatArray]] = field(default_factory=lambda: deque(maxlen=WHEELS_KEPT))
    _forces: deque[tuple[float, FloatArray]] = field(default_factory=lambda: deque(maxlen=WHEELS_KEPT))
    _unpaired: int = 0

    def restart(self) -> None:
        """Clear the queue of an earlier pass."""
        self._rates.clear()
        self._forces.clear()
        self._unpaired = 0

    def notes(self) -> list[str]:
        """Notes for the user."""
        alone = self._unpaired + len(self._rates)
        unpaired = f"; {alone} angular rates without accelerations around them are ignored" if alone else ""
        text = f"joined with {self.forces_topic}, accelerations between its stamps by interpolation{unpaired}"
        return [f"{self.topic}: {note}" for note in (text, self.unit.choice) if note]

    def read_rates(self, message: Any) -> list[Measurement]:
        """The readings that a gyroscope message completes; RecordFault if it is damaged."""
        gyro = _vector(message.angular_velocity)
        if not np.isfinite(gyro).all():
            raise RecordFault(NO_HALF, f"{gyro}")
        stamp_s = stamp_of(message.header)
        self._unpaired += len(self._rates) == self._rates.maxlen
        self._rates.append((stamp_s, gyro))
        return self._complete()

    def read_forces(self, message: Any) -> list[Measurement]:
        """The readings that an accelerometer message completes; RecordFault if it is damaged."""
        force, stamp_s = _vector(message.linear_acceleration), stamp_of(message.header)
        if not np.isfinite(force).all() or not force.any():
            raise RecordFault(NO_HALF, f"{force}")
        if self._forces and stamp_s <= self._forces[-1][0]:
            self._forces.clear()
        self._forces.append((stamp_s, self.unit.m_s2(force)))
        while stamp_s - self._forces[0][0] > GAP_S:
            self._forces.popleft()
        return self._complete()

    def _complete(self) -> list[Measurement]:
        """Readings at gyroscope stamps between two accelerations; gyroscope messages without are counted."""
        readings: list[Measurement] = []
        while self._rates and (self._forces or abs(self._rates[-1][0] - self._rates[0][0]) > GAP_S):
            stamp_s, gyro = self._rates[0]
            if self._forces and self._forces[-1][0] < stamp_s <= self._forces[-1][0] + GAP_S:
                break
            self._rates.popleft()
            force = self._force_at(stamp_s)
            if force is None:
                self._unpaired += 1
            else:
                readings.append(ImuReading(stamp_s, gyro, force, self.T_base_imu, self.topic))
        return readings

    def _force_at(self, stamp_s: float) -> FloatArray | None:
        """(3,) acceleration, interpolated between neighbours; None if there are none."""
        if self._forces and self._forces[-1][0] == stamp_s:
            return self._forces[-1][1]
        if not self._forces or stamp_s < self._forces[0][0]:
            return None
        for (late_s, late), (early_s, early) in pairwise(reversed(self._forces)):
            if early_s <= stamp_s <= late_s:
                return early + (stamp_s - early_s) / (late_s - early_s) * (late - early)
        return None
