"""Whom a step between two keyframes is taken from."""

from __future__ import annotations

import numpy as np

from slam.graph.step_vote import Step, agree, vote

SURE = np.diag([0.005, 0.005, 0.003]) ** 2
VAGUE = np.diag([0.1, 0.1, 0.05]) ** 2


def step(x: float, covariance: np.ndarray = SURE) -> Step:
    return Step(np.array([x, 0.0, 0.0]), covariance)


def test_what_agrees_is_all_kept() -> None:
    doubtful, kept = vote(step(0.2), None, [step(0.201), step(0.199)])
    assert not doubtful
    assert len(kept) == 2


def test_two_cameras_outvote_a_match_that_follows_a_walker() -> None:
    doubtful, kept = vote(step(0.0), None, [step(0.2), step(0.201)])
    assert doubtful
    assert len(kept) == 2


def test_wheels_break_the_tie_of_one_camera_and_the_match() -> None:
    doubtful, kept = vote(step(0.2), step(0.2, VAGUE), [step(0.6)])
    assert not doubtful
    assert kept == []
    doubtful, kept = vote(step(0.6), step(0.2, VAGUE), [step(0.2)])
    assert doubtful
    assert len(kept) == 1


def test_without_a_majority_the_loops_decide() -> None:
    doubtful, kept = vote(step(0.2), None, [step(0.6)])
    assert doubtful
    assert len(kept) == 1


def test_one_lying_camera_of_three_is_left_out() -> None:
    honest = [step(0.2), step(0.201)]
    doubtful, kept = vote(step(0.2), None, [*honest, step(0.5)])
    assert not doubtful
    assert [float(camera.motion[0]) for camera in kept] == [0.2, 0.201]


def test_without_a_match_there_is_no_vote() -> None:
    doubtful, kept = vote(None, step(0.1), [step(0.5)])
    assert not doubtful
    assert len(kept) == 1


def test_steps_agree_unless_two_of_them_contradict_each_other() -> None:
    near, beside, far = (Step(np.array([x, 0.0, 0.0]), SURE) for x in (0.2, 0.205, 0.3))
    assert agree([]) and agree([far]) and agree([near, beside])
    assert not agree([near, beside, far])


def test_how_near_steps_must_be_to_agree_may_be_told() -> None:
    """Half a radian from wheels that may be off by a quarter: no contradiction, and no agreement."""
    match = Step(np.array([0.0, 0.0, 1.0]), SURE)
    wheels = Step(np.array([0.0, 0.0, 1.5]), np.diag([0.01, 0.01, 0.0625]))
    assert agree([match, wheels])
    assert not agree([match, wheels], 3.0)
    assert agree([match, Step(np.array([0.0, 0.0, 1.3]), wheels.covariance)], 3.0)
