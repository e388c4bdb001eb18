"""Steps after keyframes that were placed by a guess: no surer than it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.estimates import MotionEstimate
from slam.graph.place_doubt import PlaceDoubt
from slam.measurements import FloatArray

CONFIDENT = np.diag([1e-6] * 3 + [1e-4] * 3)
ALONG = np.diag([1e-6] * 3 + [0.25, 1e-4, 1e-4])  # a corridor along x
STEP = gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 2), np.array([1.0, 0.0, 0.0]))


def match(covariance: FloatArray, *, degenerate: bool = False, converged: bool = True) -> MotionEstimate:
    return MotionEstimate(gtsam.Pose3(), covariance, 0.9, 0.9, 0.01, converged, degenerate, np.zeros(6))


def test_between_sure_keyframes_a_match_is_the_step() -> None:
    steps = PlaceDoubt()
    for _ in range(2):
        np.testing.assert_array_equal(steps.add(STEP, match(CONFIDENT)), CONFIDENT)


@pytest.mark.parametrize("doubt", [{"degenerate": True}, {"converged": False}])
def test_the_step_after_an_unsure_keyframe_is_as_unsure(doubt: dict[str, bool]) -> None:
    steps = PlaceDoubt()
    np.testing.assert_array_equal(steps.add(STEP, match(ALONG, **doubt)), ALONG)
    # The corridor's direction is x at the uncertain keyframe, and y after the turn.
    covariance = steps.add(STEP, match(CONFIDENT))
    np.testing.assert_allclose(np.diag(covariance)[3:], [2e-4, 0.2501, 2e-4], rtol=0.02)
    np.testing.assert_array_equal(steps.add(STEP, match(CONFIDENT)), CONFIDENT)


def test_a_keyframe_that_begins_a_local_map_is_certain_in_it() -> None:
    steps = PlaceDoubt()
    steps.add(STEP, match(ALONG, degenerate=True))
    steps.begin()
    np.testing.assert_array_equal(steps.add(STEP, match(CONFIDENT)), CONFIDENT)
