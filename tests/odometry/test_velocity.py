"""How far the velocity leads where nothing else shows it, and who may teach it."""

from __future__ import annotations

import numpy as np
from scripted_tracker import STEP, Run

from slam.matching.planar import between


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
