"""What a heading that is wrong throws aside is a covariance, whatever else is known of the motion."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from slam.matching.motion import Motion
from slam.odometry.wheel_tracker import thrown_aside

_NUMBERS = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3)


@given(_NUMBERS, _NUMBERS)
def test_a_disputed_motion_stays_a_motion(pose: list[float], offset: list[float]) -> None:
    # A dispute has one direction: way and heading are wrong together.
    motion = Motion(np.array(pose), np.outer(offset, offset) + 1e-6 * np.eye(3))
    thrown = motion.widened(thrown_aside(motion)).covariance
    assert np.linalg.eigvalsh(thrown).min() > 0.0
