"""A corridor: what the match leaves open is known no better than dead reckoning knows it."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest

from slam.config.localization import LocalizationConfig
from slam.estimates import MotionEstimate
from slam.localization.machine import StateMachine
from slam.localization.output import LocalizerOutput, State
from slam.localization.poses import Measured
from slam.localization.sensor import Keyframe, Observation
from slam.measurements import Pose

STEP = Measured(gtsam.Pose2(0.2, 0.0, 0.0), np.diag([0.05, 0.01, 0.01]) ** 2)


class Corridor:
    """Every alignment but the first stays at its guess along x, and knows y and yaw."""

    search_every_m, weighs_back, least_keyframes = 1.0, 100, 1

    def __init__(self) -> None:
        self.pose = gtsam.Pose2()
        self.nats = 9.0
        self.gap_sigma_m = 0.0

    def observe(self, measurement: float, known: Pose | None) -> Observation[int]:
        self.pose = self.pose.compose(STEP.pose)
        moved = Measured(STEP.pose, STEP.covariance + np.diag([self.gap_sigma_m**2, 0.0, 0.0]))
        return Observation(measurement, 1, self.pose, moved, restarted=False)

    def sees_new(self, view: int, before: Pose | None, pose: Pose) -> bool:
        return True

    def novel(self, view: int, pose: Pose, before: Sequence[Keyframe[None]] | None) -> None:
        return None

    def align(self, view: int, guess: Pose) -> MotionEstimate:
        begins = guess.x() < 0.3
        covariance = np.diag([0.1 if begins else 0.5, 0.01, 0.002]) ** 2
        weak = np.array([0.0 if begins else 1.0, 0.0, 0.0])
        return MotionEstimate(guess, covariance, 1.0, 1.0, 0.01, True, not begins, weak)

    def weigh(self, pose: Pose, novel: None, motion: MotionEstimate | None) -> float:
        return self.nats

    def propose(self, view: int, keyframes: Sequence[Keyframe[None]], within: Measured | None) -> list[Pose]:
        """The one place at first, and then all along the corridor."""
        aside_m = [0.0] if within is None else np.arange(-1.55, 1.6, 0.31).tolist()
        return [self.pose.compose(gtsam.Pose2(x_m, 0.0, 0.0)) for x_m in aside_m]


def outputs(count: int) -> list[LocalizerOutput]:
    machine = StateMachine(Corridor(), LocalizationConfig())
    found = [machine.add(0.1 * n) for n in range(count)]
    return [output for output in found if output is not None]


def test_along_a_corridor_the_sigma_grows_as_that_of_the_wheels() -> None:
    begun, *_, ended = outputs(31)
    assert begun.state is State.TRACKING and ended.state is State.TRACKING
    assert begun.covariance is not None and ended.covariance is not None
    grown = ended.covariance[0, 0] - begun.covariance[0, 0]
    assert grown == pytest.approx(30 * STEP.covariance[0, 0], rel=0.05)
    assert np.sqrt(ended.covariance[1, 1]) < 0.03


def test_in_the_end_the_position_is_not_known() -> None:
    *_, ended = outputs(300)
    assert ended.state is State.LOST and ended.covariance is not None
    assert np.sqrt(ended.covariance[0, 0]) > 0.5


def test_a_contradicted_pose_is_reported_as_nothing_known() -> None:
    sensor = Corridor()
    machine = StateMachine(sensor, LocalizationConfig())
    for n in range(10):
        machine.add(0.5 * n)
    sensor.nats = -9.0
    for n in range(10, 30):
        output = machine.add(0.5 * n)
        assert output is not None and output.covariance is not None
        assert output.state is State.LOST and np.sqrt(output.covariance[0, 0]) > 10.0


def test_past_a_gap_it_is_lost_and_known_within_the_gap() -> None:
    """No alignment along the corridor is believed there; and dead reckoning goes on."""
    sensor = Corridor()
    machine = StateMachine(sensor, LocalizationConfig())
    for n in range(10):
        machine.add(0.5 * n)
    sensor.gap_sigma_m = 2.0
    output = machine.add(20.0)
    assert output is not None and output.pose is not None and output.covariance is not None
    assert output.state is State.LOST and 2.0 < np.sqrt(output.covariance[0, 0]) < 3.0
    assert output.pose.x() == pytest.approx(sensor.pose.x())
