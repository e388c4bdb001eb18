"""The adjustment of the latest keyframes by the landmarks that they share."""

from __future__ import annotations

import gtsam
import numpy as np
from room_world import MIDDLE, error_of, furnished, looking, prepared, render

from slam.config_stages import BundleConfig, RgbdOdometryConfig
from slam.sliding_window import SlidingWindow

POSES = [looking(-0.6 + 0.15 * n, -0.4, 1.2, 0.5 + 0.05 * n) for n in range(5)]


def window() -> SlidingWindow:
    return SlidingWindow(BundleConfig(), RgbdOdometryConfig())


def test_a_disturbed_motion_is_put_right() -> None:
    room, adjusting = furnished(), window()
    steps = []
    for number, pose in enumerate(POSES):
        disturbed = pose.retract(np.array([0.0, 0.004, 0.0, 0.015, 0.0, 0.0]) * (number > 0))
        steps.append(adjusting.add(prepared(render(room, pose, MIDDLE)), disturbed))
    assert steps[0] is None
    for before, after, step in zip(POSES[:-1], POSES[1:], steps[1:], strict=True):
        assert step is not None
        error = error_of(step.T_previous_newest, before.between(after))
        assert np.linalg.norm(error[3:]) < 0.008
        assert np.linalg.norm(error[:3]) < 0.004
        assert step.landmarks > 50
        assert np.linalg.eigvalsh(step.covariance)[0] > 0.0


def test_nothing_is_told_after_a_restart() -> None:
    room, adjusting = furnished(), window()
    adjusting.add(prepared(render(room, POSES[0], MIDDLE)), POSES[0])
    adjusting.restart()
    assert adjusting.add(prepared(render(room, POSES[1], MIDDLE)), POSES[1]) is None


def test_keyframes_that_share_nothing_are_not_adjusted() -> None:
    adjusting = window()
    there = looking(0.5, 0.5, 1.2, 0.3)
    away = looking(-1.0, 1.0, 1.2, 3.3)
    adjusting.add(prepared(render(furnished(), there, MIDDLE)), there)
    assert adjusting.add(prepared(render(furnished(3), away, MIDDLE)), gtsam.Pose3()) is None
