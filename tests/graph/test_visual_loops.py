"""Loops by the camera: a true revisit closes, another scene does not, and every verdict has its reason."""

from __future__ import annotations

import logging

import gtsam
import numpy as np
import pytest
from room_world import MIDDLE, Room, blind, error_of, furnished, looking, prepared, render

from slam.config import load_config
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.visual_loops import VisualLoopCloser
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prepared_frame import PreparedFrame

HOME = looking(-0.3, 0.2, 1.5, -0.7, 0.3)
AWAY = [looking(0.1, 0.1, 1.4, yaw, 0.05) for yaw in (0.6, 1.4, 2.2, 3.0)]
RETURN = HOME * gtsam.Pose3(gtsam.Rot3.RzRyRx(0.03, 0.06, -0.02), np.array([0.08, -0.03, 0.05]))
STRANGE = Room(np.array([[-1.2, -3.0, 0.0], [1.4, 2.7, 3.5]]), (), seed=5)


@pytest.fixture(scope="module")
def views() -> list[PreparedFrame]:
    """Home, four views elsewhere, home again."""
    return [prepared(render(furnished(), pose, MIDDLE)) for pose in [HOME, *AWAY, RETURN]]


class Walk:
    """Keyframes with poses that the test believes."""

    def __init__(self, *settings: str) -> None:
        self.frames: list[PreparedFrame] = []
        self.poses: list[gtsam.Pose3] = []
        config = load_config(None, settings)
        self._closer = VisualLoopCloser(config, FrameMatcher(config), self)

    def keyframe(self, key: int) -> PreparedFrame:
        return self.frames[key]

    def touch(self, key: int) -> None:
        """All are kept."""

    def add(self, frame: PreparedFrame, pose: gtsam.Pose3, *, adrift: bool = False) -> list[LoopCandidate]:
        """As the mapper does."""
        self.frames.append(frame)
        self.poses.append(pose)
        self._closer.add_keyframe(frame, adrift=adrift)
        return self._closer.close(len(self.frames) - 1, self.poses)

    def through(self, frames: list[PreparedFrame], poses: list[gtsam.Pose3]) -> list[LoopCandidate]:
        return [loop for frame, pose in zip(frames, poses, strict=True) for loop in self.add(frame, pose)]


TRUE = [HOME, *AWAY, RETURN]
# The same walk with a return that is believed two metres and half a turn off: only its looks can show it.
LOST = [*TRUE[:-1], gtsam.Pose3(gtsam.Rot3.Ry(1.6), np.array([2.0, 0.5, 1.0])) * RETURN]


@pytest.mark.parametrize("poses", [TRUE, LOST], ids=["believed near", "by its looks"])
def test_a_true_return_closes(poses: list[gtsam.Pose3], views: list[PreparedFrame]) -> None:
    loops = Walk().through(views, poses)
    (home,) = [loop for loop in loops if loop.accepted and (loop.place, loop.keyframe) == (0, 5)]
    assert home.motion is not None
    motion = home.motion.T_reference_base
    assert isinstance(motion, gtsam.Pose3)
    assert np.abs(error_of(motion, HOME.between(RETURN))).max() < 0.01
    assert home.reason == ""


@pytest.mark.parametrize("poses", [TRUE, LOST], ids=["believed near", "by its looks"])
def test_every_accepted_loop_is_true(poses: list[gtsam.Pose3], views: list[PreparedFrame]) -> None:
    for loop in Walk("visual_loops.near_dissimilarity=3.0").through(views, poses):
        assert loop.accepted == (loop.reason == "")
        if loop.accepted:
            assert loop.motion is not None
            expected = TRUE[loop.place].between(TRUE[loop.keyframe])
            assert np.abs(error_of(loop.motion.T_reference_base, expected)).max() < 0.05


@pytest.mark.parametrize("believed", [RETURN, LOST[-1]], ids=["believed near", "believed far"])
def test_another_scene_is_refused(
    believed: gtsam.Pose3, views: list[PreparedFrame], caplog: pytest.LogCaptureFixture
) -> None:
    stranger = prepared(render(STRANGE, looking(0.0, 0.0, 1.2, 0.9, 0.1), MIDDLE))
    walk = Walk()
    walk.through(views[:-1], TRUE[:-1])
    with caplog.at_level(logging.INFO, logger="slam.graph.loop_candidate"):
        loops = walk.add(stranger, believed)
    assert loops
    assert not any(loop.accepted for loop in loops)
    assert all("refused, " in record.message for record in caplog.records)
    assert len(caplog.records) == len(loops)


def test_a_dead_camera_closes_nothing(views: list[PreparedFrame]) -> None:
    walk = Walk()
    walk.through(views[:-1], TRUE[:-1])
    loops = walk.add(prepared(blind(views[0].frame)), RETURN)
    assert not any(loop.accepted for loop in loops)


def test_neighbours_are_no_loop(views: list[PreparedFrame]) -> None:
    walk = Walk("visual_loops.least_gap=3")
    loops = walk.through([views[0], views[5], views[0]], [HOME, RETURN, HOME])
    assert loops == []
    assert {loop.place for loop in walk.add(views[5], RETURN)} == {0}


def test_no_more_places_are_tried_than_asked(views: list[PreparedFrame]) -> None:
    walk = Walk("loops.near=2", "loops.by_appearance=0")
    for n in range(12):
        found = walk.add(views[0] if n % 2 else views[5], HOME if n % 2 else RETURN)
        assert len(found) <= 2
        places = [loop.place for loop in found]
        assert all(abs(a - b) >= 2 for a in places for b in places if a != b)


def test_disabled_means_none(views: list[PreparedFrame]) -> None:
    assert Walk("loops.enabled=false").through(views, TRUE) == []


def test_what_is_adrift_is_joined_by_its_looks_alone(views: list[PreparedFrame]) -> None:
    """After a loss nobody knows where the camera is: poses propose nothing until looks have shown it."""
    walk = Walk("loops.by_appearance=0")
    walk.through(views[:-1], TRUE[:-1])
    assert walk.add(views[5], RETURN, adrift=True) == []
    walk = Walk()
    walk.through(views[:-1], TRUE[:-1])
    loops = walk.add(views[5], RETURN, adrift=True)
    assert [loop.place for loop in loops if loop.accepted] == [0]
    # From here on it is known again, and near places are tried.
    later = walk.add(views[0], HOME)
    assert 0 in {loop.place for loop in later}
