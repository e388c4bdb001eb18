"""Faults of a drive through a campus, and wheel odometry with occasional gross errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import gtsam
import numpy as np

from slam.measurements import BoolArray, FloatArray, pose2_from_row
from slam.simulation.campus_drive import travelled_m
from slam.simulation.wheel_odometry import WheelModel, wheel_readings

RATE_HZ = 10.0
_BASE_M = 0.45
_KINDS, _SHARES = ("heading", "position", "standstill"), (0.55, 0.25, 0.2)


@dataclass(frozen=True, slots=True)
class CampusFaults:
    """Faults of a drive; the defaults are mostly the noise of lidar and wheels.

    Attributes
    ----------
    gaps
        Number of gaps of the lidar, 5 to 28 s each.
    gross_errors
        Number of sudden errors of the wheels: of the heading (10 to 180 degrees), of the position (0.5 to 3
        m), or an interval (2 to 8 s) that is neither counted nor recorded.
    largest_lag_s
        Maximum delay of the lidar's stamps; the minimum is a third of it. The wheels' clock is correct.
    largest_scale
        Maximum common scale error of the wheels; the minimum is a third of it.
    wheels
        Small errors of the wheels: unequal radii, noise, slip.
    encounters_per_m
        Number of persons walking by per metre.
    """

    gaps: int = 0
    gross_errors: int = 0
    largest_lag_s: float = 0.0
    largest_scale: float = 0.0
    wheels: WheelModel = field(
        default_factory=lambda: WheelModel(RATE_HZ, _BASE_M, 0.0, 0.0, noise=0.001, slips_per_s=0.0)
    )
    encounters_per_m: float = 0.0


CAMPUS_FAULTS = {
    "none": CampusFaults(),
    "usual": CampusFaults(
        gaps=30,
        gross_errors=40,
        largest_lag_s=0.15,
        largest_scale=0.03,
        wheels=WheelModel(RATE_HZ, _BASE_M, 3e-4, 0.01, noise=0.002, slips_per_s=0.005, slip_share=0.1),
        encounters_per_m=0.025,
    ),
}


@dataclass(frozen=True, slots=True)
class GrossError:
    """A gross error of the wheels.

    Attributes
    ----------
    kind
        ``heading``, ``position`` or ``standstill``.
    first, last
        Readings: a jump is between the previous one and this one, a standstill from the first to the last.
    size
        Radians, metres or seconds.
    """

    kind: str
    first: int
    last: int
    size: float


@dataclass(frozen=True, slots=True, eq=False)
class CampusWheels:
    """Wheel odometry of a drive.

    Attributes
    ----------
    poses_xyt
        (N, 3) at each reading, odom frame.
    onward_xyt
        (N, 3) counted motion to the next reading, relative to this one, without jumps.
    is_logged
        (N,) whether the reading is in the log.
    errors
        In time order.
    """

    poses_xyt: FloatArray
    onward_xyt: FloatArray
    is_logged: BoolArray
    errors: tuple[GrossError, ...]

    def at(self, time_s: float) -> gtsam.Pose2:
        """Return ``T_odom_base`` at a time since the start: the previous reading plus the counted motion."""
        index = min(int(time_s * RATE_HZ + 1e-9), len(self.poses_xyt) - 1)
        share = time_s * RATE_HZ - index
        return pose2_from_row(self.poses_xyt[index]) * pose2_from_row(share * self.onward_xyt[index])


def campus_wheels(faults: CampusFaults, true_xyt: FloatArray, rng: np.random.Generator) -> CampusWheels:
    """Simulate the wheel odometry of true poses (N, 3)."""
    scale = 1.0 + rng.choice([-1.0, 1.0]) * faults.largest_scale * rng.uniform(1.0 / 3.0, 1.0)
    rows = wheel_readings(faults.wheels, true_xyt * [scale, scale, 1.0], rng).poses_xyt
    # Complex numbers for the plane: e^(i yaw) rotates.
    position, yaw = rows[:, 0] + 1j * rows[:, 1], np.unwrap(rows[:, 2])
    moved, turned = np.diff(position) * np.exp(-1j * yaw[:-1]), np.diff(yaw)
    jumped, swung = np.zeros_like(moved), np.zeros_like(turned)
    is_logged = np.ones(len(rows), dtype=np.bool_)
    driven_m, errors = travelled_m(true_xyt), []
    for at_m in np.sort(rng.uniform(0.0, driven_m[-1], faults.gross_errors)):
        index = last = int(np.searchsorted(driven_m[1:-1], at_m))
        kind, sign = str(rng.choice(_KINDS, p=_SHARES)), rng.choice([-1.0, 1.0])
        if kind == "heading":
            size = math.radians(rng.uniform(10.0, 180.0))
            swung[index] += sign * size
        elif kind == "position":
            size = rng.uniform(0.5, 3.0)
            jumped[index] += size * np.exp(1j * rng.uniform(-math.pi, math.pi))
        else:
            last = min(index + round(rng.uniform(2.0, 8.0) * RATE_HZ), len(moved) - 1)
            size = (last - index) / RATE_HZ
            moved[index:last] = turned[index:last] = 0.0
            is_logged[index + 1 : last] = False
        errors.append(GrossError(kind, index + 1, last + 1 if last == index else last, size))
    yaw = np.concatenate([[0.0], np.cumsum(turned + swung)])
    position = np.cumsum(np.exp(1j * yaw[:-1]) * (moved + np.exp(1j * turned) * jumped))
    poses_xyt = np.column_stack(
        [np.append(0.0, position.real), np.append(0.0, position.imag), np.angle(np.exp(1j * yaw))]
    )
    onward = np.column_stack([moved.real, moved.imag, turned])
    return CampusWheels(poses_xyt, np.append(onward, np.zeros((1, 3)), axis=0), is_logged, tuple(errors))
