"""A camera's clock learned from how fast both sensors say that the robot turns."""

import numpy as np
import pytest

from slam.measurements import FloatArray
from slam.odometry.clock_learner import ClockLearner, Turns


def heading(stamps: FloatArray) -> FloatArray:
    """A robot that looks around now and then."""
    return np.asarray(0.8 * np.sin(0.9 * stamps) + 0.3 * np.sin(2.3 * stamps + 1.0))


def learned(
    offset_s: float,
    *,
    sigma_rad: float = 0.001,
    duration_s: float = 40.0,
    turns: float = 1.0,
    wrong: int = 0,
    period_s: float = 0.1,
) -> ClockLearner:
    """A camera at 15 Hz whose clock is ahead of a robot's at 10 Hz, or at another period."""
    rng = np.random.default_rng(3)
    robot, learner = Turns(), ClockLearner()
    for stamp_s in np.arange(0.0, duration_s, period_s):
        robot.add(stamp_s, turns * heading(stamp_s) + rng.normal(0.0, sigma_rad))
    frames = np.arange(0.01, duration_s, 1 / 15)
    jumps = set(rng.choice(frames.size, wrong, replace=False))
    for n, true_s in enumerate(frames):
        jump = 1.5 if n in jumps else 0.0
        learner.turns.add(true_s + offset_s, turns * heading(true_s) + jump + rng.normal(0.0, sigma_rad))
    learner.learn(robot, final=True)
    return learner


@pytest.mark.parametrize("offset_s", [-0.12, -0.03, 0.0, 0.02, 0.04, 0.15])
def test_the_offset_is_found(offset_s: float) -> None:
    clock = learned(offset_s).clock
    assert clock.known
    assert clock.offset_s == pytest.approx(offset_s, abs=0.004)
    assert clock.sigma_s < 0.01


def test_it_is_as_sure_as_it_is_right() -> None:
    clock = learned(0.03, sigma_rad=0.01).clock
    assert clock.known
    assert abs(clock.offset_s - 0.03) < 3.0 * clock.sigma_s


def test_wrong_matches_of_the_camera_do_not_move_it() -> None:
    clock = learned(0.03, wrong=30).clock
    assert clock.known
    assert clock.offset_s == pytest.approx(0.03, abs=0.006)


def test_a_long_run_is_taken_in_stretches() -> None:
    clock = learned(-0.03, duration_s=300.0).clock
    assert clock.offset_s == pytest.approx(-0.03, abs=0.003)


def test_scans_many_seconds_apart_show_it_in_longer_stretches() -> None:
    clock = learned(-0.12, duration_s=1200.0, period_s=7.3).clock
    assert clock.stretches >= 2
    assert clock.offset_s == pytest.approx(-0.12, abs=0.02)


@pytest.mark.parametrize("learner", [learned(0.03, turns=0.0), learned(0.03, duration_s=0.5), ClockLearner()])
def test_without_turns_clocks_are_taken_to_agree(learner: ClockLearner) -> None:
    assert not learner.clock.known
    assert learner.clock.offset_s == 0.0
    assert learner.clock.sigma_s == 0.01


def test_few_stretches_are_not_significant() -> None:
    assert learned(0.1).clock.significant_s == 0.0
    assert learned(0.1, duration_s=300.0).clock.significant_s == pytest.approx(0.1, abs=0.003)
    assert learned(0.005, duration_s=300.0).clock.significant_s == 0.0


def test_headings_wrap_and_stamps_that_go_back_show_nothing() -> None:
    turns = Turns()
    for stamp_s, yaw in ((0.0, 3.1), (0.1, -3.1), (5.0, 0.0), (5.0, 0.2), (4.9, 0.1), (5.1, 0.3)):
        turns.add(stamp_s, yaw)
    spans, values = turns.between(-np.inf, np.inf)
    np.testing.assert_allclose(spans, [[0.0, 0.1], [0.1, 5.0], [5.0, 5.1]])
    np.testing.assert_allclose(values, [2 * np.pi - 6.2, 3.1, 0.3])
    turns.add_turn(5.0, 5.2, 1.0)
    assert turns.newest_s == 5.1
    assert (Turns().oldest_s, Turns().newest_s) == (-np.inf, -np.inf)


def test_stamps_in_microseconds_make_no_more_stretches_than_readings_fill() -> None:
    learner, stamps = ClockLearner(), 0.05 * np.arange(400)
    for stamp_s, yaw in zip(1e6 * stamps, heading(stamps), strict=True):
        learner.turns.add(float(stamp_s), float(yaw))
    assert 1 < len(learner._stretches(len(stamps))) <= 20
