"""Frames prepared for matching, and what is collected to find out where a colour camera sits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from room_world import LESS, MIDDLE, furnished, looking, prepared, render

from slam.config import load_config
from slam.config.stages import RgbdConfig
from slam.doctor.registration_pairs import registrations_of
from slam.measurements import Measurement, WheelOdometry
from slam.vision.color_registration import ColorRegistration
from slam.vision.prepared_frame import FramePreparer, PreparedFrame

FRAME = render(furnished(), looking(0.0, 0.0, 1.3, 0.3), MIDDLE)


def test_what_is_no_frame_passes() -> None:
    reading = WheelOdometry(1.0, gtsam.Pose2())
    assert FramePreparer(RgbdConfig(), {})(reading) is reading


def test_a_prepared_frame_keeps_its_image_and_obeys_the_limits() -> None:
    found = prepared(FRAME, features=100, points=500, working_width=160)
    assert found.frame is FRAME
    assert 50 < len(found.features) <= 100
    assert len(found.points) < 800
    assert found.depth[0].shape == (120, 160)
    assert found.surface.planes.shape == (120, 160, 4)
    assert 1.5 < found.median_depth_m < 3.0
    assert prepared(replace(FRAME, depth_m=0 * FRAME.depth_m)).median_depth_m == 1.0


def test_features_of_a_camera_aside_lie_in_the_depth_image() -> None:
    """Colour taken 5 cm to the right: its features go where the depth camera sees them."""
    T_depth_color = gtsam.Pose3(gtsam.Rot3(), np.array([0.05, 0.0, 0.0]))
    pose = looking(0.0, 0.0, 1.3, 0.3)
    torn = replace(FRAME, color=render(furnished(), pose * T_depth_color, MIDDLE).color)
    aside = ColorRegistration(MIDDLE, MIDDLE, T_depth_color, True, "5 cm beside")
    mended = FramePreparer(RgbdConfig(), {"camera": aside})(torn)
    assert isinstance(mended, PreparedFrame)
    assert len(mended.features) > 200
    assert (mended.features.depth_m > 0.0).all()
    # As seen from the depth camera: about 5 cm f / z to the right of where colour has them.
    raw = prepared(torn).features
    shift = np.median(mended.features.pixels[:, 0]) - np.median(raw.pixels[:, 0])
    assert shift == pytest.approx(0.05 * MIDDLE.fx / mended.median_depth_m, abs=6.0)


class TestRegistrations:
    FRAMES: tuple[Measurement, ...] = tuple(
        render(furnished(), looking(0, 0, 1.3, 0.1 * n), LESS, 0.3 * n, smooth=False) for n in range(6)
    )

    def test_given_asks_nothing(self) -> None:
        config = load_config(None, ["rgbd.registration=given"])
        assert registrations_of(iter(()), ["camera"], config) == {}

    def test_too_little_to_show_is_no_other_place(self) -> None:
        found = registrations_of(self.FRAMES, ["camera", "absent"], load_config(None))
        assert not any(registration.accepted for registration in found.values())

    def test_only_the_beginning_is_read(self) -> None:
        read: list[float] = []

        def log() -> Iterator[Measurement]:
            for n in range(1000):
                read.append(float(n))
                yield WheelOdometry(float(n), gtsam.Pose2())

        registrations_of(log(), ["camera"], load_config(None))
        assert max(read) < 45.0
