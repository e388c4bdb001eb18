"""Camera keyframes of a run: the same from memory as from disk; and a pose for every frame between them."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from room_world import MIDDLE, furnished, looking, prepared, render

from slam.config.stages import RgbdConfig
from slam.mapper.keyframe_store import KeyframeStore, registration_notes
from slam.measurements import CameraIntrinsics
from slam.vision.color_registration import ColorRegistration, identity_registration
from slam.vision.prepared_frame import PreparedFrame


@pytest.fixture(scope="module")
def frames() -> list[PreparedFrame]:
    return [
        prepared(render(furnished(), looking(0, 0, 1.3, yaw), MIDDLE, stamp_s=yaw)) for yaw in (0.0, 1.0, 2.0)
    ]


def test_a_keyframe_from_disk_is_the_one_that_was_added(frames: list[PreparedFrame]) -> None:
    """Depth to a step of 0.2 mm, features to the bit, surfaces to what that step does."""
    store = KeyframeStore(RgbdConfig(), cached=1)
    assert [store.add(frame) for frame in frames] == [0, 1, 2]
    assert len(store) == len(store.images) == 3
    for key, frame in enumerate(frames):
        found = store.keyframe(key)
        assert found.stamp_s == frame.stamp_s
        np.testing.assert_array_equal(found.features.descriptors, frame.features.descriptors)
        np.testing.assert_array_equal(found.features.depth_m, frame.features.depth_m)
        np.testing.assert_allclose(found.depth[0], frame.depth[0], atol=1.1e-4)
        assert abs(len(found.points) - len(frame.points)) < 20
        turned = np.linalg.norm((found.surface.planes - frame.surface.planes)[..., 1:], axis=2)
        assert np.median(turned) < 2e-3


def test_the_latest_used_are_kept_whole(frames: list[PreparedFrame]) -> None:
    store = KeyframeStore(RgbdConfig(), cached=2)
    for frame in frames:
        store.add(frame)
    assert store.keyframe(1) is frames[1]
    assert store.keyframe(2) is frames[2]
    remade = store.keyframe(0)
    assert remade is not frames[0]
    assert store.keyframe(0) is remade
    # What was asked for longest ago has gone.
    assert store.keyframe(1) is not frames[1]


def test_colour_goes_where_the_depth_camera_sees_it(frames: list[PreparedFrame]) -> None:
    """A colour camera 5 cm beside: pixels that it does not see lose their depth, and keep no wrong colour."""
    color = CameraIntrinsics(MIDDLE.fx, MIDDLE.fy, MIDDLE.cx, MIDDLE.cy, MIDDLE.width, MIDDLE.height)
    aside = ColorRegistration(color, MIDDLE, gtsam.Pose3(gtsam.Rot3(), [0.05, 0.0, 0.0]), True, "5 cm beside")
    store = KeyframeStore(RgbdConfig(), cached=2)
    store.add(frames[0], aside)
    image = store.images.frame(0)
    kept = image.depth_m > 0.0
    assert 0.8 < kept.mean() < 1.0
    np.testing.assert_allclose(image.depth_m[kept], frames[0].frame.depth_m[kept], atol=1.1e-4)
    assert np.abs(image.color.astype(int) - frames[0].frame.color).mean() > 5.0


def test_notes_name_cameras_that_sit_aside() -> None:
    aside = ColorRegistration(MIDDLE, MIDDLE, gtsam.Pose3(), True, "5 cm beside")
    reported = {"left": aside, "right": identity_registration(MIDDLE, "as registered")}
    assert registration_notes(reported) == ["left: 5 cm beside"]
    assert registration_notes({}) == []


@pytest.mark.parametrize("asked", [[0, 1], [2, 0], [1, 2, 0, 1], [0, 0]])
def test_touching_does_to_the_memory_what_asking_does(frames: list[PreparedFrame], asked: list[int]) -> None:
    """Which keyframes are whole must not depend on whether their answers were known."""
    looked, touched = KeyframeStore(RgbdConfig(), cached=2), KeyframeStore(RgbdConfig(), cached=2)
    for frame in frames:
        looked.add(frame)
        touched.add(frame)
    for key in asked:
        looked.keyframe(key)
        touched.touch(key)
    for key in (2, 1, 0):
        one, other = looked.keyframe(key), touched.keyframe(key)
        assert (one is frames[key]) == (other is frames[key]), key
        np.testing.assert_array_equal(one.depth[0], other.depth[0])
