"""Frame by frame tracking: guesses, lost frames, fresh starts, and when a keyframe is due."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from room_world import SMALL, furnished, looking, prepared, render

from slam.config import Config, load_config
from slam.estimates import MotionEstimate
from slam.odometry.camera_odometry import CameraOdometry, camera_step
from slam.odometry.camera_track import CameraPose
from slam.odometry.rgbd_tracker import RgbdTracker, TrackedFrame
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe, VisualMatch

CONFIG = load_config(None, ["match.lost_after=3", "match.local_map_keyframes=4", "rgbd_odometry.views=2"])
STEP = gtsam.Pose3(gtsam.Rot3.Ry(0.02), np.array([0.03, 0.0, 0.0]))
FAR = gtsam.Pose3(gtsam.Rot3.Ry(0.5), np.zeros(3))


def match_at(
    pose: gtsam.Pose3,
    overlap: float = 0.9,
    features: int = 50,
    converged: bool = True,
    degenerate: bool = False,
) -> VisualMatch:
    motion = MotionEstimate(pose, np.eye(6) * 1e-6, 0.9, 0.9, 0.001, converged, degenerate, np.zeros(6))
    return VisualMatch(motion, overlap, features, 0.5)


@pytest.fixture(scope="module")
def picture() -> PreparedFrame:
    return prepared(render(furnished(), looking(0, 0, 1.3, 0.3)))


class Run:
    """A tracker whose matcher answers as set; frames differ by their stamps alone."""

    def __init__(self, picture: PreparedFrame, config: Config = CONFIG) -> None:
        self.answer: Callable[[gtsam.Pose3], VisualMatch | None] = match_at
        self.guesses: list[gtsam.Pose3] = []
        self.local: list[list[VisualKeyframe]] = []
        self.tracker = RgbdTracker(self, config)
        self._picture = picture

    def match(
        self, frame: PreparedFrame, local: list[VisualKeyframe], guess: gtsam.Pose3
    ) -> VisualMatch | None:
        self.guesses.append(guess)
        self.local.append(local)
        return self.answer(guess)

    def at(self, stamp_s: float) -> TrackedFrame:
        """Track the frame of a stamp, and keep it where the tracker asks for it."""
        frame = copy.copy(self._picture)
        frame.frame = replace(frame.frame, stamp_s=stamp_s, intrinsics=SMALL)
        tracked = self.tracker.track(frame)
        if tracked.new_keyframe:
            self.tracker.add_keyframe(frame, tracked)
        return tracked

    def at_pose(self, stamp_s: float, pose: gtsam.Pose3) -> TrackedFrame:
        self.answer = lambda guess: match_at(pose)
        return self.at(stamp_s)


def same(one: gtsam.Pose3, other: gtsam.Pose3) -> bool:
    return bool(one.equals(other, 1e-9))


def test_the_first_frame_is_the_origin_and_a_keyframe(picture: PreparedFrame) -> None:
    run = Run(picture)
    first = run.at(0.0)
    assert same(first.pose, gtsam.Pose3())
    assert first.match is None
    assert first.new_keyframe
    assert not first.restarted
    assert run.guesses == []


def test_keyframes_know_the_noise_of_the_camera(picture: PreparedFrame) -> None:
    """The median of the newest matched keyframes, relative to the configured noise; 1 before the first."""
    run = Run(picture)
    run.at(0.0)
    odometry = CONFIG.rgbd_odometry
    sigma_m = odometry.depth_floor_m + odometry.depth_share * picture.median_depth_m**2
    for n, noise in enumerate((0.2, 0.3, 2.0), 1):
        match = match_at(gtsam.Pose3(gtsam.Rot3(), [float(n), 0.0, 0.0]))
        shown = replace(match, motion=replace(match.motion, residual_m=noise * sigma_m))
        run.answer = lambda guess, shown=shown: shown  # type: ignore[misc]
        run.at(0.1 * n)
    assert [keyframe.noise for keyframe in run.tracker._local] == pytest.approx([1.0, 0.2, 0.25, 0.3])


@pytest.mark.parametrize(("gap_s", "steps"), [(0.1, 1.0), (0.2, 2.0), (5.0, 3.0), (0.0, 0.0), (-1.0, 0.0)])
def test_the_velocity_is_carried_over_a_gap_but_not_for_ever(
    gap_s: float, steps: float, picture: PreparedFrame
) -> None:
    run = Run(picture)
    run.at(0.0)
    run.at_pose(0.1, STEP)
    run.at(0.1 + gap_s)
    expected = STEP * gtsam.Pose3.Expmap(steps * gtsam.Pose3.Logmap(STEP))
    assert same(run.guesses[-1], expected)


def test_a_lost_frame_keeps_the_pose_and_asks_again_where_it_was(picture: PreparedFrame) -> None:
    run = Run(picture)
    run.at(0.0)
    run.at_pose(0.1, STEP)
    run.answer = lambda guess: None
    lost = run.at(0.2)
    assert lost.match is None
    assert same(lost.pose, STEP)
    assert not lost.new_keyframe
    assert same(run.guesses[-2], STEP * STEP)
    assert same(run.guesses[-1], STEP)


def test_the_way_of_lost_frames_took_their_time(picture: PreparedFrame) -> None:
    """Two steps since the last match, one frame of them lost: the speed is one step a frame."""
    run = Run(picture)
    run.at(0.0)
    run.at_pose(0.1, STEP)
    run.answer = lambda guess: None
    run.at(0.2)
    run.at_pose(0.3, STEP * STEP * STEP)
    run.at(0.4)
    assert same(run.guesses[-1], STEP * STEP * STEP * STEP)


def test_long_lost_starts_anew_where_it_was_last_seen(picture: PreparedFrame) -> None:
    run = Run(picture)
    run.at(0.0)
    run.at_pose(0.1, STEP)
    run.answer = lambda guess: None
    tracked = [run.at(0.2 + 0.1 * n) for n in range(3)]
    assert [frame.restarted for frame in tracked] == [False, False, True]
    assert [frame.new_keyframe for frame in tracked] == [False, False, True]
    assert same(tracked[-1].pose, STEP)
    # What was known before is not matched any more.
    run.at_pose(0.5, STEP)
    assert len(run.local[-1]) == 1
    assert run.local[-1][0].frame.stamp_s == pytest.approx(0.4)
    # The count begins again.
    run.answer = lambda guess: None
    assert [run.at(0.6 + 0.1 * n).restarted for n in range(4)] == [False, False, True, False]


@pytest.mark.parametrize(
    ("features", "converged", "degenerate", "believed"),
    [(50, False, True, True), (2, True, False, True), (2, False, False, False), (2, True, True, False)],
    ids=["texture", "a corner", "still sliding", "a wall"],
)
def test_a_wall_alone_does_not_end_a_loss(
    features: int, converged: bool, degenerate: bool, believed: bool, picture: PreparedFrame
) -> None:
    """Any wall fits any other. While tracking goes on, that is enough; after a loss it is not."""
    run = Run(picture)
    run.at(0.0)
    run.answer = lambda guess: match_at(STEP, 0.9, features, converged, degenerate)
    assert run.at(0.1).match is not None
    run.answer = lambda guess: None
    run.at(0.2)
    run.answer = lambda guess: match_at(STEP, 0.9, features, converged, degenerate)
    assert (run.at(0.3).match is not None) == believed


def test_a_match_in_between_ends_the_count(picture: PreparedFrame) -> None:
    run = Run(picture)
    run.at(0.0)
    for n in range(1, 12):
        run.answer = (lambda guess: None) if n % 3 else match_at
        assert not run.at(0.1 * n).restarted


@pytest.mark.parametrize(
    ("pose", "overlap", "due"),
    [
        (gtsam.Pose3(), 0.9, False),
        (gtsam.Pose3(gtsam.Rot3(), np.array([0.11, 0.0, 0.0])), 0.9, False),
        (gtsam.Pose3(gtsam.Rot3(), np.array([0.4, 0.0, 0.0])), 0.9, True),  # parallax
        (gtsam.Pose3(gtsam.Rot3.Ry(0.19), np.zeros(3)), 0.9, False),
        (gtsam.Pose3(gtsam.Rot3.Ry(0.21), np.zeros(3)), 0.9, True),  # turn
        (gtsam.Pose3(), 0.5, True),  # overlap
    ],
)
def test_when_a_keyframe_is_due(pose: gtsam.Pose3, overlap: float, due: bool, picture: PreparedFrame) -> None:
    run = Run(picture)
    run.at(0.0)
    run.answer = lambda guess: match_at(pose, overlap)
    assert run.at(0.1).new_keyframe == due


def test_back_at_a_keyframe_none_is_due(picture: PreparedFrame) -> None:
    run = Run(picture)
    run.at(0.0)
    assert run.at_pose(0.1, FAR).new_keyframe
    assert not run.at_pose(0.2, gtsam.Pose3()).new_keyframe


def test_the_most_alike_keyframes_are_matched(picture: PreparedFrame) -> None:
    """Two views at most, of the four newest keyframes, none that looks elsewhere altogether."""
    run = Run(picture)
    turns = [0.0, 0.4, 0.8, 1.2, 1.6, 2.0]
    run.at(0.0)
    for n, turn in enumerate(turns[1:], start=1):
        run.at_pose(float(n), gtsam.Pose3(gtsam.Rot3.Ry(turn), np.zeros(3)))
    run.at_pose(5.0, gtsam.Pose3(gtsam.Rot3.Ry(1.65), np.zeros(3)))
    run.at(5.0)  # a stamp that stands: the guess is the last pose
    stamps = [keyframe.frame.stamp_s for keyframe in run.local[-1]]
    assert stamps == [4.0, 5.0]
    run.at_pose(5.0, gtsam.Pose3())  # a keyframe again: the first one is forgotten
    run.at(5.0)
    assert [same(keyframe.pose, gtsam.Pose3()) for keyframe in run.local[-1]] == [True]


class Rendered:
    """`CameraOdometry` on real matches: a camera that steps aside."""

    def __init__(self) -> None:
        self.odometry = CameraOdometry(load_config(None, ["match.lost_after=3"]))
        self.pose = looking(-0.3, 0.2, 1.5, -0.7, 0.35)

    def at(self, stamp_s: float) -> CameraPose | None:
        return self.odometry.track.at(stamp_s, clock_sigma_s=0.01)

    def add(self, stamp_s: float, step: gtsam.Pose3 | None = None, *, dead: bool = False) -> TrackedFrame:
        self.pose = self.pose if step is None else self.pose * step
        frame = render(furnished(), self.pose, stamp_s=stamp_s)
        if dead:
            frame = type(frame)(stamp_s, 0 * frame.color, 0 * frame.depth_m, SMALL)
        return self.odometry.add(prepared(frame))

    def add_near_a_wall(self, stamp_s: float, turn: gtsam.Rot3) -> TrackedFrame:
        """Too near for any depth, but seen all the same."""
        self.pose = self.pose * gtsam.Pose3(turn, np.zeros(3))
        frame = render(furnished(), self.pose, stamp_s=stamp_s)
        return self.odometry.add(prepared(replace(frame, depth_m=0 * frame.depth_m)))


def test_a_camera_is_known_at_its_frame_and_shortly_after() -> None:
    camera = Rendered()
    assert camera.at(0.0) is None
    camera.add(0.0)
    camera.add(0.1, STEP)
    assert camera.at(-0.36) is None
    assert camera.at(0.36) is None
    now, later = camera.at(0.1), camera.at(0.15)
    assert now is not None
    assert later is not None
    np.testing.assert_allclose(now.pose.matrix(), STEP.matrix(), atol=0.006)
    half = gtsam.Pose3.Expmap(0.5 * gtsam.Pose3.Logmap(now.pose))
    np.testing.assert_allclose(now.pose.between(later.pose).matrix(), half.matrix(), atol=1e-6)
    assert np.linalg.eigvalsh(later.covariance - now.covariance)[0] >= 0.0
    assert np.trace(later.covariance) > np.trace(now.covariance)


def test_a_camera_seen_once_may_move_at_any_speed() -> None:
    """One frame shows no speed: carried on it may have stood still, or not; and never is it sure."""
    camera = Rendered()
    camera.add(0.0)
    step = camera_step(camera.at(0.02), camera.at(0.2))
    assert step is not None
    sigmas = np.sqrt(np.diag(step[1]))
    assert sigmas.min() > 0.05
    assert np.linalg.eigvalsh(step[1])[0] > 0.0


def test_a_lost_camera_is_not_carried_on() -> None:
    camera = Rendered()
    camera.add(0.0)
    camera.add(0.1, dead=True)
    assert camera.at(0.1) is None


def test_a_fresh_start_has_no_motion_to_what_was_before() -> None:
    camera = Rendered()
    camera.add(0.0)
    camera.add(0.1, STEP)
    before = camera.at(0.1)
    assert not any(camera.add(0.2 + 0.1 * n, dead=True).restarted for n in range(4))
    # Nothing could be matched to what saw nothing; it begins anew with what does, elsewhere.
    assert camera.add(0.6, gtsam.Pose3(gtsam.Rot3.Ry(2.0), np.zeros(3))).restarted
    assert camera_step(before, camera.at(0.6)) is None
    assert camera.odometry.lost_frames > 0


def test_long_blind_and_back_where_it_was_goes_on() -> None:
    camera = Rendered()
    camera.add(0.0)
    assert not any(camera.add(0.1 + 0.1 * n, dead=True).restarted for n in range(5))
    found = camera.add(0.7, STEP)
    assert found.match is not None
    assert not found.restarted


def test_without_depth_images_alone_show_how_it_turns() -> None:
    camera = Rendered()
    camera.add(0.0)
    turns = [gtsam.Rot3.Ypr(0.0, 0.08, 0.03)] * 4
    lost = [camera.add_near_a_wall(0.1 + 0.1 * n, turn) for n, turn in enumerate(turns)]
    assert all(frame.match is None for frame in lost[2:])
    off = lost[-1].pose.rotation().between(gtsam.Rot3.Ypr(0.0, 0.32, 0.12))
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(off))) < 2.0


@pytest.mark.parametrize("side", [0, 1])
def test_no_step_from_or_to_nowhere(side: int) -> None:
    known = CameraPose(gtsam.Pose3(), np.eye(6), 0)
    ends = [known, known]
    ends[side] = None  # type: ignore[call-overload]
    assert camera_step(*ends) is None


def test_a_step_has_the_covariance_of_both_ends() -> None:
    """By samples: errors of either pose, seen as an error of the motion in its last frame."""
    rng = np.random.default_rng(0)
    poses = [gtsam.Pose3(gtsam.Rot3.RzRyRx(0.2, 0.1, -0.5), [1.0, 2.0, 3.0])]
    poses.append(poses[0] * gtsam.Pose3(gtsam.Rot3.RzRyRx(-0.3, 0.4, 0.2), [0.5, -0.2, 0.3]))
    covariances = [np.diag([1, 4, 2, 9, 1, 3]) * 1e-6, np.diag([3, 1, 1, 2, 8, 1]) * 1e-6]
    ends = [CameraPose(pose, covariance, 0) for pose, covariance in zip(poses, covariances, strict=True)]
    found = camera_step(*ends)
    assert found is not None
    motion, covariance = found
    assert same(motion, poses[0].between(poses[1]))
    errors = []
    for _ in range(4000):
        moved = [
            pose * gtsam.Pose3.Expmap(rng.multivariate_normal(np.zeros(6), c))
            for pose, c in zip(poses, covariances, strict=True)
        ]
        errors.append(gtsam.Pose3.Logmap(motion.between(moved[0].between(moved[1]))))
    expected = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(covariance / scale, expected / scale, atol=0.08)
