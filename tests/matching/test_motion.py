"""When two motions agree: the chi-square gate, whatever frame they are in."""

from __future__ import annotations

import numpy as np
import pytest

from slam.matching.motion import Motion
from slam.matching.planar import compose

COVARIANCE = np.diag([0.02, 0.01, 0.005]) ** 2


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (3.0, -2.0, 3.1)])
def test_the_distance_is_reported_in_sigmas_of_the_motions_own_axes(pose: tuple[float, ...]) -> None:
    motion = Motion(np.array(pose), COVARIANCE)
    for axis, sigma in enumerate((0.02, 0.01, 0.005)):
        off = compose(motion.pose, 2.0 * sigma * np.eye(3)[axis])
        assert motion.squared_mahalanobis(off) == pytest.approx(4.0)


def test_true_motions_pass_the_gate_with_its_probability() -> None:
    rng = np.random.default_rng(1)
    said = rng.standard_normal((2, 4000, 3)) * np.sqrt(np.diag(COVARIANCE))
    agreed = [
        Motion(one, COVARIANCE).agrees(Motion(other, COVARIANCE)) for one, other in zip(*said, strict=True)
    ]
    assert np.mean(agreed) == pytest.approx(0.97, abs=0.01)


def test_a_motion_holds_less_than_agrees_with_it() -> None:
    """Whoever is asked whether a pose is possible does not know how uncertain that pose is."""
    motion, off = Motion(np.zeros(3), COVARIANCE), np.array([0.07, 0.0, 0.0])
    assert not motion.holds(off)
    assert motion.agrees(Motion(off, COVARIANCE))
    assert not motion.agrees(Motion(np.array([0.1, 0.0, 0.0]), COVARIANCE))
