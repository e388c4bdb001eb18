"""Frames that support a lidar in a known map: each is used where the lidar was at its time."""

from __future__ import annotations

from collections import deque
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from room_world import SMALL

from slam.config.stages import RgbdConfig
from slam.localization.localizer import Localizer
from slam.localization.poses import Measured
from slam.measurements import PointCloud, RgbdFrame
from slam.vision.prepared_frame import PreparedFrame


def frame_at(stamp_s: float) -> PreparedFrame:
    shape = SMALL.height, SMALL.width
    grey = np.zeros((*shape, 3), np.uint8)
    return PreparedFrame(RgbdFrame(stamp_s, grey, np.ones(shape, np.float32), SMALL), RgbdConfig())


class _Locator:
    """Notes at which lidar stamp it is asked about a frame."""

    def __init__(self) -> None:
        self.asked = list[tuple[float, float]]()

    def view(self, frame: PreparedFrame) -> PreparedFrame:
        return frame

    def near(self, frame: PreparedFrame, pose: gtsam.Pose3) -> None:
        self.asked.append((frame.frame.stamp_s, pose.x()))


class _Lidar:
    """Drives a metre per second along x."""

    copied, tracked = 0.0, Measured(gtsam.Pose3(), np.eye(6))

    def add(self, cloud: PointCloud) -> SimpleNamespace:
        self.tracked = Measured(gtsam.Pose3(gtsam.Rot3(), np.array([cloud.stamp_s, 0.0, 0.0])), np.eye(6))
        return SimpleNamespace(stamp_s=cloud.stamp_s)

    def wants_help(self) -> bool:
        return True


def localizer_of(locator: _Locator) -> Localizer:
    localizer = object.__new__(Localizer)
    for name, value in {"_lidar": _Lidar(), "_locator": locator, "_frames": deque(), "_clouds": None}.items():
        setattr(localizer, name, value)
    return localizer


def test_a_clock_that_is_set_back_leaves_no_frame_waiting() -> None:
    locator = _Locator()
    localizer = localizer_of(locator)
    for stamp_s in (100.0, 1.0, 1.1, 1.2):
        localizer.add(frame_at(stamp_s))
    localizer.add(PointCloud(1.15, np.zeros((1, 3), np.float32)))
    assert locator.asked == [(1.1, 1.15)]


@pytest.mark.parametrize("ahead_s", [0.0, 0.5])
def test_a_frame_is_used_at_the_reading_of_its_time(ahead_s: float) -> None:
    locator = _Locator()
    localizer = localizer_of(locator)
    frames = [frame_at(0.03 * n) for n in range(100)]
    clouds = [PointCloud(0.1 * n, np.zeros((1, 3), np.float32)) for n in range(30)]
    log = [(one.frame.stamp_s - ahead_s, one) for one in frames] + [(one.stamp_s, one) for one in clouds]
    for _, one in sorted(log, key=lambda pair: pair[0]):
        localizer.add(one)
    assert len(locator.asked) > 25
    late_s = np.array([lidar_s - frame_s for frame_s, lidar_s in locator.asked])
    assert late_s.min() >= 0.0 and late_s.max() < 0.031
