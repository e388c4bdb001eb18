"""Poses at the stamps of the log, where clouds were placed by the middle of their turns."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.measurements import Trajectory
from slam.trajectory.frame_poses import FramePoses, at_stamps

TWIST = np.array([0.05, 0.0, 0.7, 1.5, 0.1, -0.2])


def along(stamps_s: np.ndarray) -> Trajectory:
    frames = FramePoses()
    for stamp_s in stamps_s:
        frames.add(float(stamp_s), gtsam.Pose3.Expmap(TWIST * stamp_s))
    frames.mark_keyframe()
    last = gtsam.Pose3.Expmap(TWIST * stamps_s[-1])
    return frames.trajectory([last], gtsam.Pose3())


@pytest.mark.parametrize("shift_s", [0.05, -0.05])
def test_an_even_motion_is_carried_on(shift_s: float) -> None:
    stamps_s = np.arange(12) * 0.1
    told = at_stamps(along(stamps_s + shift_s), stamps_s)
    true = along(stamps_s)
    np.testing.assert_allclose(told.stamps_s, stamps_s)
    np.testing.assert_allclose(told.positions_m, true.positions_m, atol=1e-9)
    turned = np.abs(np.sum(told.quaternions_xyzw * true.quaternions_xyzw, axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-12)


def test_stamps_that_stand_still_or_are_too_few_move_nothing() -> None:
    stamps_s = np.array([0.05, 0.05, 0.15])
    told = at_stamps(along(stamps_s), np.array([0.0, 0.0, 0.1]))
    assert np.isfinite(told.positions_m).all()
    one = along(np.array([0.05]))
    np.testing.assert_array_equal(at_stamps(one, np.array([0.0])).positions_m, one.positions_m)
