"""A frame against keyframes: by shape, by texture, by both, without a guess, and when to say no."""

from __future__ import annotations

import copy
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from room_world import (
    MIDDLE,
    T_BODY_CAMERA,
    Room,
    blind,
    dark,
    error_of,
    furnished,
    hall,
    looking,
    prepared,
    render,
)

from slam.comparison.dense_odometry import POINTS_IGNORED, DenseOdometry
from slam.config import Config, load_config
from slam.odometry.rgbd_odometry import RgbdOdometry
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe, dissimilarity

PLACE = looking(-0.3, 0.2, 1.5, -0.7, 0.35)
STEP = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.02), np.array([0.05, 0.03, 0.04]))
CONFIG = Config()
NOISE = (CONFIG.rgbd_odometry.depth_floor_m, CONFIG.rgbd_odometry.depth_share)


def seen(pose: gtsam.Pose3, room: Room | None = None, seed: int = 0) -> PreparedFrame:
    return prepared(render(room or furnished(), pose, MIDDLE, noise=NOISE, seed=seed))


def with_parts(frame: PreparedFrame, **changes: object) -> PreparedFrame:
    """The frame with other parts than its images give."""
    changed = copy.copy(frame)
    for name, value in changes.items():
        setattr(changed, name, value)
    return changed


@pytest.fixture(scope="module")
def before() -> PreparedFrame:
    return seen(PLACE, seed=1)


@pytest.fixture(scope="module")
def after() -> PreparedFrame:
    return seen(PLACE * STEP, seed=2)


def methods() -> list[RgbdOdometry]:
    features = load_config(None, [f"rgbd_odometry.correlated_points={POINTS_IGNORED}"])
    return [FrameMatcher(CONFIG), FrameMatcher(features), DenseOdometry(CONFIG)]


every_method = pytest.mark.parametrize(
    "method", [0, 1, pytest.param(2, marks=pytest.mark.open3d)], ids=["joint", "features", "dense"]
)


@every_method
@pytest.mark.parametrize(
    "T_odom_world", [gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3.RzRyRx(1, -1, 2), [9.0, 8.0, 7.0])]
)
def test_every_method_finds_the_motion(
    method: int, T_odom_world: gtsam.Pose3, before: PreparedFrame, after: PreparedFrame
) -> None:
    """In any odometry frame; the covariance holds the error."""
    odometry = methods()[method]
    place = T_odom_world * PLACE
    match = odometry.match(after, [VisualKeyframe(before, place)], place)
    assert match is not None
    error = error_of(match.pose, place * STEP)
    assert np.abs(error[:3]).max() < 0.004
    assert np.abs(error[3:]).max() < 0.01
    assert error @ np.linalg.solve(match.motion.covariance, error) / 6.0 < 3.0
    assert np.linalg.eigvalsh(match.motion.covariance)[0] > 0.0
    assert match.motion.converged
    assert not match.motion.degenerate
    assert match.motion.inlier_share > 0.8
    assert match.feature_count > 100


def test_in_the_dark_the_shape_is_enough(before: PreparedFrame) -> None:
    after = prepared(dark(render(furnished(), PLACE * STEP, MIDDLE, noise=NOISE, seed=2)))
    match = FrameMatcher(CONFIG).match(after, [VisualKeyframe(before, PLACE)], PLACE)
    assert match is not None
    assert match.feature_count == 0
    assert np.abs(error_of(match.pose, PLACE * STEP)).max() < 0.01
    assert not match.motion.degenerate


def test_before_a_flat_wall_the_texture_is_enough() -> None:
    place = looking(0.0, 0.0, 0.0, 0.1, 0.05)
    local = [VisualKeyframe(seen(place, hall(), seed=1), place)]
    match = FrameMatcher(CONFIG).match(seen(place * STEP, hall(), seed=2), local, place)
    assert match is not None
    assert not match.motion.degenerate
    assert np.abs(error_of(match.pose, place * STEP)).max() < 0.006


def test_a_flat_wall_in_the_dark_is_open_and_says_so() -> None:
    place = looking(0.0, 0.0, 0.0, 0.1, 0.05)
    frames = [
        prepared(dark(render(hall(), pose, MIDDLE, noise=NOISE, seed=n)))
        for n, pose in enumerate((place, place * STEP))
    ]
    match = FrameMatcher(CONFIG).match(frames[1], [VisualKeyframe(frames[0], place)], place)
    assert match is not None
    assert match.motion.degenerate
    # The wall is x = const: what is weak lies in it.
    weak = match.pose.rotation().matrix() @ match.motion.weak_direction[3:]
    assert abs(weak[0]) < 0.1
    error = error_of(match.pose, place * STEP)
    assert error @ np.linalg.solve(match.motion.covariance, error) / 6.0 < 3.0


def test_a_far_guess_is_mended_by_the_features(before: PreparedFrame, after: PreparedFrame) -> None:
    """A person who shook the camera: half a radian and half a metre off."""
    wild = PLACE * gtsam.Pose3(gtsam.Rot3.Ry(0.5), np.array([0.3, 0.2, -0.4]))
    match = FrameMatcher(CONFIG).match(after, [VisualKeyframe(before, PLACE)], wild)
    assert match is not None
    assert np.abs(error_of(match.pose, PLACE * STEP)).max() < 0.01


def walker(aside_m: float) -> Room:
    """Somebody in one colour stands 0.8 m ahead of the camera."""
    room = furnished()
    x, y, _ = PLACE.transformFrom(np.array([aside_m, 0.0, 0.8]))
    return replace(
        room, outside=(*room.outside, np.array([[x - 0.2, y - 0.2, 0.0], [x + 0.2, y + 0.2, 1.9]]))
    )


def while_somebody_walks(aside_m: float, moved_m: float, noise: tuple[float, float]) -> list[PreparedFrame]:
    """A frame at the place and one a step later, with a plain walker before the camera."""
    frames = []
    for pose, at_m in ((PLACE, aside_m), (PLACE * STEP, aside_m + moved_m)):
        image = render(walker(at_m), pose, MIDDLE, noise=noise, seed=len(frames))
        plain = np.where(image.depth_m[..., None] < 1.25, np.uint8(90), image.color)
        frames.append(prepared(replace(image, color=plain)))
    return frames


@pytest.mark.parametrize(("aside_m", "moved_m"), [(-0.1, 0.1), (0.2, 0.15)])
def test_who_walks_before_the_camera_does_not_take_it_along(aside_m: float, moved_m: float) -> None:
    """Surfaces fit best between him and the room, 8 to 14 cm off; features are of the room."""
    frames = while_somebody_walks(aside_m, moved_m, NOISE)
    match = FrameMatcher(CONFIG).match(frames[1], [VisualKeyframe(frames[0], PLACE)], PLACE)
    assert match is not None
    assert np.abs(error_of(match.pose, PLACE * STEP)).max() < 0.01


def test_a_good_camera_sees_who_walks_slowly() -> None:
    """2 cm are within the configured noise of depth, and take the camera along, but not within its own."""
    good = 0.2
    frames = while_somebody_walks(0.2, 0.02, (good * NOISE[0], good * NOISE[1]))
    errors = []
    for noise in (1.0, good):
        match = FrameMatcher(CONFIG).match(frames[1], [VisualKeyframe(frames[0], PLACE, noise)], PLACE)
        assert match is not None
        errors.append(np.abs(error_of(match.pose, PLACE * STEP)).max())
    assert errors[0] > 0.02 and errors[1] < 0.002


def test_features_contradict_surfaces_that_somebody_took_along(
    before: PreparedFrame, after: PreparedFrame
) -> None:
    """A slow walker shifts surfaces by less than their gate, and they fit badly; else they are right."""
    matcher, local = FrameMatcher(CONFIG), [VisualKeyframe(before, PLACE)]
    landmarks = matcher._landmarks(after, local, PLACE * STEP)
    right = matcher._align(after, local, landmarks, PLACE * STEP, 0)
    shifted = right.pose * gtsam.Pose3(gtsam.Rot3(), np.array([0.02, 0.0, 0.0]))
    taken = replace(right, pose=shifted, residual_m=5.0 * right.residual_m)
    found = matcher._without_walkers(taken, after, local, landmarks)
    assert np.abs(error_of(found.pose, PLACE * STEP)).max() < 0.005
    tight = replace(taken, residual_m=0.1 * right.residual_m)
    assert matcher._without_walkers(tight, after, local, landmarks) is tight


def test_without_a_guess_among_several_keyframes(before: PreparedFrame, after: PreparedFrame) -> None:
    other = looking(0.3, 0.0, 1.4, 2.4)
    local = [VisualKeyframe(seen(other), other), VisualKeyframe(before, PLACE)]
    match = FrameMatcher(CONFIG).match_anywhere(after, local)
    assert match is not None
    assert np.abs(error_of(match.pose, PLACE * STEP)).max() < 0.01


def test_another_room_is_refused(before: PreparedFrame) -> None:
    """Other walls with another pattern."""
    small = Room(np.array([[-1.2, -3.0, 0.0], [1.4, 2.7, 3.5]]), (), seed=5)
    stranger = seen(looking(0.0, 0.0, 1.2, 0.9, 0.1), small)
    local = [VisualKeyframe(before, PLACE)]
    assert FrameMatcher(CONFIG).match_anywhere(stranger, local) is None
    for method in methods()[:2]:
        assert method.match(stranger, local, PLACE) is None


@every_method
def test_a_dead_frame_matches_nothing(method: int, before: PreparedFrame) -> None:
    dead = prepared(blind(before.frame))
    odometry = methods()[method]
    assert odometry.match(dead, [VisualKeyframe(before, PLACE)], PLACE) is None
    assert odometry.match(before, [VisualKeyframe(dead, PLACE)], PLACE) is None


def test_more_keyframes_make_surer(before: PreparedFrame, after: PreparedFrame) -> None:
    matcher = FrameMatcher(CONFIG)
    third = PLACE * gtsam.Pose3(gtsam.Rot3.Ry(0.1), np.array([-0.05, 0.0, 0.05]))
    local = [VisualKeyframe(before, PLACE), VisualKeyframe(seen(third, seed=3), third)]
    one, two = matcher.match(after, local[:1], PLACE), matcher.match(after, local, PLACE)
    assert one is not None
    assert two is not None
    assert np.trace(two.motion.covariance) < np.trace(one.motion.covariance)


def test_features_that_all_disagree_count_against_the_match(
    before: PreparedFrame, after: PreparedFrame
) -> None:
    """A hundred features and none fits: worse than if two of them did."""
    matcher = FrameMatcher(CONFIG)
    pixels = after.features.pixels[:, ::-1] * np.float32(0.7)
    torn = with_parts(after, features=replace(after.features, pixels=np.ascontiguousarray(pixels)))
    match = matcher.match(torn, [VisualKeyframe(before, PLACE)], PLACE * STEP)
    assert match is None or match.motion.inlier_share < 0.7


@pytest.mark.parametrize(("turn", "way"), [(0.0, 0.0), (0.3, 0.0), (0.0, 1.0), (0.3, 1.0)])
def test_dissimilarity_counts_turn_and_travel(turn: float, way: float) -> None:
    other = T_BODY_CAMERA * gtsam.Pose3(gtsam.Rot3.Ry(turn), np.array([way, 0.0, 0.0]))
    assert dissimilarity(T_BODY_CAMERA, other, 2.0) == pytest.approx(np.hypot(turn, way / 2.0))
