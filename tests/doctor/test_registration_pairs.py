"""Where the colour camera sits, from a second or two of a log: rendered frames, and a real Kinect's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from room_world import MIDDLE, furnished, looking, render

from slam.config import load_config
from slam.datasets import open_dataset
from slam.doctor.registration_pairs import registrations_of
from slam.measurements import RgbdFrame
from slam.vision.color_registration import register_features

REDKITCHEN = Path(__file__).parents[3] / "shared" / "data" / "rgbd" / "redkitchen"
T_DEPTH_COLOR = gtsam.Pose3(gtsam.Rot3(), np.array([0.025, 0.0, 0.0]))
WIDE = replace(MIDDLE, fx=0.85 * MIDDLE.fx, fy=0.85 * MIDDLE.fy)
# Seven steps from frame to frame are too few to judge by.
SHORT = 8


def frame(number: int, *, beside: bool, every_s: float = 0.21) -> RgbdFrame:
    """One of a turning camera's frames."""
    pose = looking(0.08 * number - 0.5, 0.05 * number, 1.3, 0.08 * number, 0.02 * number)
    found = render(furnished(), pose, MIDDLE, stamp_s=every_s * number, smooth=False)
    if not beside:
        return found
    return replace(found, color=render(furnished(), pose * T_DEPTH_COLOR, WIDE, smooth=False).color)


@pytest.mark.parametrize("beside", [True, False])
def test_a_short_log_shows_where_its_colour_camera_sits(beside: bool) -> None:
    frames = [frame(number, beside=beside) for number in range(SHORT)]
    found = registrations_of(frames, ["camera"], load_config(None))["camera"]
    assert found.accepted == beside, found.reason
    if beside:
        assert found.intrinsics_color.fx == pytest.approx(0.85 * MIDDLE.fx, rel=0.02)
        # At 2 m, where most of the room is: a shift and a moved principal point look much the same.
        wall = np.full((MIDDLE.height, MIDDLE.width), 2.0, dtype=np.float32)
        truth = replace(found, intrinsics_color=WIDE, T_depth_color=T_DEPTH_COLOR)
        pixels = np.random.default_rng(0).uniform(60.0, 180.0, (100, 2))
        off_px = register_features(pixels, wall, found)[0] - register_features(pixels, wall, truth)[0]
        assert np.sqrt((off_px**2).sum(axis=1).mean()) < 3.0


def test_of_a_fast_camera_every_frame_is_looked_at() -> None:
    """In steps of 0.2 s it would be four frames."""
    frames = [frame(number, beside=True, every_s=0.05) for number in range(2 * SHORT)]
    found = registrations_of(frames, ["camera"], load_config(None))["camera"]
    assert found.accepted, found.reason


@pytest.mark.skipif(not REDKITCHEN.is_dir(), reason=f"REAL LOG ABSENT, not tested: {REDKITCHEN}")
@pytest.mark.parametrize("first", [0, 300, 450])
def test_fifty_frames_of_a_kinect_show_that_its_colour_is_not_registered(first: int, tmp_path: Path) -> None:
    for file in REDKITCHEN.iterdir():
        if not file.name.startswith("frame-") or first <= int(file.name[6:12]) < first + 50:
            (tmp_path / file.name).symlink_to(file)
    (found,) = registrations_of(open_dataset(tmp_path), ["camera"], load_config(None)).values()
    assert found.accepted, found.reason
    # 529 px by the whole log, 585 if colour were registered. Nine of ten such windows give the same.
    assert found.intrinsics_color.fx == pytest.approx(529.0, abs=14.0)
