"""How far the velocity leads where nothing else shows it, and who may teach it."""

from __future__ import annotations

import numpy as np
import pytest
from scripted_tracker import STEP, Run

from slam.matching.planar import between
from slam.odometry.constant_velocity import Velocity


def test_what_nothing_shows_goes_on_for_half_a_second_and_then_stands() -> None:
    """Ten metres a second would be a hundred after ten seconds without a match."""
    run = Run.sure(5, wheels=False)
    run.odometry.answer = lambda guesses: None
    blind = [run.scan() for _ in range(100)]
    gone_m = float(np.hypot(*between(run.odometry.asked[4][0].pose, blind[-1].pose)[:2]))
    assert 2.0 * STEP[0] < gone_m < 8.0 * STEP[0]


def test_the_step_that_mends_a_guess_shows_no_velocity() -> None:
    """Blind for a scan the robot was 3 m off; where it is found again says nothing of its speed."""
    run = Run.sure(5, wheels=False)
    run.odometry.answer = lambda guesses: None
    run.scan(true_step=np.array([3.0, 0.0, 0.0]))
    run.see_the_truth()
    found = [run.scan(), run.scan()][0]
    expected = between(found.pose, run.odometry.asked[-1][0].pose)
    np.testing.assert_allclose(expected[:2], STEP[:2], atol=0.05)


def test_stamps_that_are_close_together_show_no_velocity() -> None:
    run = Run.sure(5, wheels=False)
    run.stamp_s -= 0.09
    close = run.scan()
    run.scan()
    expected = between(close.pose, run.odometry.asked[-1][0].pose)
    np.testing.assert_allclose(expected[:2], STEP[:2], atol=0.05)


def test_wheels_that_never_move_are_dead_once_the_robot_has_moved() -> None:
    run = Run.sure()
    still, ahead = np.zeros(3), np.array([0.1, 0.0, 0.0])
    run.scan(still, ahead)
    run.scan(still, ahead)
    assert len(run.odometry.asked[-1]) == 2  # nothing is known yet
    for _ in range(10):
        run.scan(still, ahead)
    assert run.wheels is not None
    assert run.wheels.dead
    assert len(run.odometry.asked[-1]) == 1
    for _ in range(12):
        run.scan(still, -ahead)
    assert run.wheels.dead, "back where it began they are no better"
    run.scan(ahead, ahead)
    assert not run.wheels.dead
    assert len(run.odometry.asked[-1]) == 2


def test_a_velocity_that_is_averaged_hardly_follows_one_noisy_step() -> None:
    velocity = Velocity()
    for step in [0.05] * 20 + [0.13]:
        velocity.follow(np.array([step, 0.0, 0.0]), 0.1, np.zeros(3))
    assert 0.05 < velocity.step[0] < 0.07
    velocity.stop()
    velocity.follow(np.array([0.03, 0.0, 0.0]), 0.1, np.zeros(3))
    assert velocity.step[0] == pytest.approx(0.03, abs=0.001)


def test_a_robot_that_turns_in_a_corridor_and_does_not_move_across_stands_still() -> None:
    """It drove along the corridor; at 45 degrees to it, a robot that only moves ahead would move across."""
    velocity = Velocity()
    for _ in range(100):
        velocity.follow(np.array([0.05, 0.0, 0.0]), 0.1, np.zeros(3))
    along = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0.0])
    for _ in range(20):
        velocity.follow(velocity.step @ along * along, 0.1, along)
    np.testing.assert_allclose(velocity.step[:2], 0.0, atol=0.01)


def test_one_noisy_step_leads_only_beside_wheels() -> None:
    for wheels, ahead_m in ((True, 0.13), (False, 0.11)):
        run = Run.sure(20, wheels=wheels)
        noisy = run.scan(true_step=np.array([0.13, 0.0, 0.0]))
        run.scan()
        velocity = run.odometry.asked[-1][-1].pose
        assert between(noisy.pose, velocity)[0] == pytest.approx(ahead_m, abs=0.012)


def test_without_wheels_an_exact_velocity_claims_more_than_the_settings() -> None:
    sigmas_m = []
    for wheels in (True, False):
        velocity = Run.sure(100, wheels=wheels).odometry.asked[-1][-1]
        sigmas_m.append(float(np.sqrt(velocity.covariance[0, 0])))
    assert sigmas_m[1] < 0.5 * sigmas_m[0]


def test_along_an_open_direction_the_velocity_stays() -> None:
    velocity = Velocity()
    for _ in range(100):
        velocity.follow(np.array([0.05, 0.0, 0.0]), 0.1, np.zeros(3))
    for _ in range(20):
        velocity.follow(np.array([0.4, 0.0, 0.0]), 0.1, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(velocity.step[:2], [0.05, 0.0], atol=0.001)
