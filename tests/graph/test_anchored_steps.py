"""Steps after keyframes that were placed by a guess: no surer than it, and the sure way goes round them."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.estimates import MotionEstimate
from slam.graph.anchored_steps import AnchoredSteps
from slam.measurements import FloatArray

CONFIDENT = np.diag([1e-6] * 3 + [1e-4] * 3)
ALONG = np.diag([1e-6] * 3 + [0.25, 1e-4, 1e-4])  # a corridor along x
STEP = gtsam.Pose3(gtsam.Rot3.Yaw(np.pi / 2), np.array([1.0, 0.0, 0.0]))


def at(key: int) -> gtsam.Pose3:
    return gtsam.Pose3() if key == 0 else at(key - 1).compose(STEP)


def match(covariance: FloatArray, *, degenerate: bool = False, converged: bool = True) -> MotionEstimate:
    return MotionEstimate(gtsam.Pose3(), covariance, 0.9, 0.9, 0.01, converged, degenerate, np.zeros(6))


def begun(reach: int = 40) -> AnchoredSteps:
    steps = AnchoredSteps(reach)
    steps.begin(0, gtsam.Pose3())
    return steps


def test_between_sure_keyframes_a_match_is_the_step() -> None:
    steps = begun()
    for key in (1, 2):
        covariance, bridge = steps.add(key, STEP, at(key), match(CONFIDENT))
        np.testing.assert_array_equal(covariance, CONFIDENT)
        assert bridge is None


@pytest.mark.parametrize("doubt", [{"degenerate": True}, {"converged": False}])
def test_past_an_unsure_keyframe_the_way_is_bridged(doubt: dict[str, bool]) -> None:
    steps = begun()
    covariance, bridge = steps.add(1, STEP, at(1), match(ALONG, **doubt))
    np.testing.assert_array_equal(covariance, ALONG)
    assert bridge is None
    covariance, bridge = steps.add(2, STEP, at(2), match(CONFIDENT))
    # The corridor's direction is x at the uncertain keyframe, and y after the turn.
    np.testing.assert_allclose(np.diag(covariance)[3:], [2e-4, 0.2501, 2e-4], rtol=0.02)
    assert bridge is not None
    assert bridge.source == 0
    assert bridge.T_source_target.equals(at(2), 1e-9)
    np.testing.assert_allclose(bridge.covariance, 4.0 * CONFIDENT)
    assert steps.add(3, STEP, at(3), match(CONFIDENT))[1] is None


def test_nothing_is_bridged_to_what_is_no_longer_in_the_local_map() -> None:
    steps = begun(reach=3)
    for key in (1, 2, 3):
        steps.add(key, STEP, at(key), match(ALONG, degenerate=True))
    covariance, bridge = steps.add(4, STEP, at(4), match(CONFIDENT))
    assert bridge is None
    assert covariance[4, 4] > 0.2
    again = begun()
    again.add(1, STEP, at(1), match(ALONG, degenerate=True))
    again.begin(2, at(2))
    covariance, bridge = again.add(3, STEP, at(3), match(CONFIDENT))
    np.testing.assert_array_equal(covariance, CONFIDENT)
    assert bridge is None
