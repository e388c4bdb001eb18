"""Simulates wheel odometry with slip: the encoders of a differential drive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.measurements import BoolArray, FloatArray

_STANDING_M = 1e-6  # a wheel that travels less within a reading does not turn, so it cannot slip


@dataclass(frozen=True, slots=True)
class WheelModel:
    """A differential drive's encoders.

    Attributes
    ----------
    rate_hz
        Readings per second.
    wheel_base_m
        Distance between the wheels.
    scale_sigma
        Standard deviation of each wheel's scale, drawn once per drive, for unevenly worn tyres. The
        difference between the wheels makes the yaw drift.
    wheel_base_sigma
        Standard deviation of the assumed wheel base, as a share of the true one.
    noise
        Standard deviation of a wheel's reading, metres per square root of a metre.
    slips_per_s
        Rate of slips of a turning wheel.
    slip_duration_s
        Mean duration of a slip.
    slip_share
        Mean excess that a slipping (spinning) wheel reports, as a share of the true travel.
    """

    rate_hz: float = 20.0
    wheel_base_m: float = 0.35
    scale_sigma: float = 0.006
    wheel_base_sigma: float = 0.01
    noise: float = 0.004
    slips_per_s: float = 0.03
    slip_duration_s: float = 0.5
    slip_share: float = 0.3


@dataclass(frozen=True, slots=True)
class WheelReadings:
    """Wheel odometry of a drive, with ground truth.

    Attributes
    ----------
    poses_xyt
        (N, 3) rows of x, y, yaw (wrapped) in the odom frame, from zero.
    twists
        (N, 2) speed and angular rate since the previous reading, from the wheels.
    slipping
        (N, 2) whether the left and the right wheel slipped since the previous reading.
    """

    poses_xyt: FloatArray
    twists: FloatArray
    slipping: BoolArray


def wheel_readings(model: WheelModel, poses_xyt: FloatArray, rng: np.random.Generator) -> WheelReadings:
    """Simulate the wheel odometry of a drive.

    Parameters
    ----------
    poses_xyt
        (N, 3) true poses at the model's rate, map frame, N at least 1.
    rng
        Its numbers depend only on N, not on the drive: equal seeds slip at equal times.
    """
    count = len(poses_xyt) - 1
    scales = 1.0 + model.scale_sigma * rng.standard_normal(2)
    base_m = model.wheel_base_m * (1.0 + model.wheel_base_sigma * float(rng.standard_normal()))
    excess = _slips(model, count, rng)
    noise = model.noise * rng.standard_normal((count, 2))
    travel = wheel_travel(poses_xyt, model.wheel_base_m)
    moving = np.abs(travel) > _STANDING_M
    reported = travel * scales * (1.0 + excess) + noise * np.sqrt(np.abs(travel))
    slipping = np.zeros((count + 1, 2), dtype=np.bool_)
    slipping[1:] = (excess > 0.0) & moving
    twists = np.zeros((count + 1, 2))
    twists[1:, 0] = reported.mean(axis=1) * model.rate_hz
    twists[1:, 1] = (reported[:, 1] - reported[:, 0]) / base_m * model.rate_hz
    return WheelReadings(dead_reckoning(reported, base_m), twists, slipping)


def wheel_travel(poses_xyt: FloatArray, wheel_base_m: float) -> FloatArray:
    """Distance that the left and the right wheel rolled between poses (N, 3), (N - 1, 2) metres."""
    step = np.diff(poses_xyt, axis=0)
    turned = np.arctan2(np.sin(step[:, 2]), np.cos(step[:, 2]))
    middle = poses_xyt[:-1, 2] + 0.5 * turned
    # The chord along the mean heading is shorter than the arc that the wheels rolled.
    ahead = (step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)) / np.sinc(0.5 * turned / np.pi)
    return np.column_stack([ahead - 0.5 * wheel_base_m * turned, ahead + 0.5 * wheel_base_m * turned])


def dead_reckoning(travel_m: FloatArray, wheel_base_m: float) -> FloatArray:
    """Poses from wheel travel (N, 2) as arcs from zero, (N + 1, 3) rows of x, y, yaw (wrapped)."""
    turn = (travel_m[:, 1] - travel_m[:, 0]) / wheel_base_m
    chord = travel_m.mean(axis=1) * np.sinc(0.5 * turn / np.pi)
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    heading = yaw[:-1] + 0.5 * turn
    poses = np.zeros((len(yaw), 3))
    poses[1:, 0] = np.cumsum(chord * np.cos(heading))
    poses[1:, 1] = np.cumsum(chord * np.sin(heading))
    poses[:, 2] = np.arctan2(np.sin(yaw), np.cos(yaw))
    return poses


def _slips(model: WheelModel, count: int, rng: np.random.Generator) -> FloatArray:
    """Excess as a share, (count, 2) for left and right; zero without slip."""
    # Slips start at rate * probability each, drawn for every reading, so that times do not change.
    begins = rng.random(count) < model.slips_per_s / model.rate_hz
    wheel = rng.integers(0, 2, count)
    lengths = np.maximum(1, np.ceil(rng.exponential(model.slip_duration_s, count) * model.rate_hz)).astype(
        int
    )
    shares = model.slip_share * rng.uniform(0.5, 1.5, count)
    excess = np.zeros((count, 2))
    for index in np.flatnonzero(begins):
        excess[index : index + lengths[index], wheel[index]] = shares[index]
    return excess
