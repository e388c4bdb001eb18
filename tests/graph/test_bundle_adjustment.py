"""Bundle adjustment of a window: exact worlds, noise (NEES), outliers, and windows that cannot be solved."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.errors import GraphError
from slam.graph.bundle_adjustment import (
    PoseStep,
    WindowFailure,
    WindowResult,
    WindowSettings,
    adjust_window,
)
from slam.graph.landmarks import LandmarkObservations, starting_points, tracked
from slam.measurements import CameraIntrinsics, FloatArray

CAMERA = CameraIntrinsics(525.0, 520.0, 319.5, 239.5, 640, 480)
STEP = gtsam.Pose3(gtsam.Rot3.Ypr(0.03, 0.02, 0.01), np.array([0.08, 0.01, 0.05]))
ORIGIN = gtsam.Pose3(gtsam.Rot3.Ypr(0.5, 0.3, 0.2), np.array([10.0, -2.0, 3.0]))
DEPTH_SIGMA = WindowSettings().depth_sigma_at_1m


@dataclass(frozen=True)
class World:
    truth: list[gtsam.Pose3]
    start: list[gtsam.Pose3]
    seen: LandmarkObservations
    outliers: np.ndarray


def world(
    seed: int,
    keyframes: int = 5,
    landmarks: int = 80,
    noise: float = 1.0,
    depth_share: float = 0.8,
    outlier_share: float = 0.0,
    visible: float = 0.8,
) -> World:
    """Points before a moving camera; ``noise`` is a factor on one pixel and on the default depth noise."""
    rng = np.random.default_rng(seed)
    truth = [ORIGIN]
    for _ in range(keyframes - 1):
        truth.append(truth[-1].compose(STEP))
    points = ORIGIN.transformFrom(rng.uniform([-1.2, -1.0, 1.5], [1.2, 1.0, 4.0], (landmarks, 3)).T).T
    rows = []
    for k, pose in enumerate(truth):
        names = np.flatnonzero(rng.random(landmarks) < visible)
        x, y, z = pose.transformTo(points[names].T)
        u = CAMERA.fx * x / z + CAMERA.cx + noise * rng.normal(size=names.size)
        v = CAMERA.fy * y / z + CAMERA.cy + noise * rng.normal(size=names.size)
        depth = 1.0 / (1.0 / z + noise * DEPTH_SIGMA * rng.normal(size=names.size))
        false = rng.random(names.size) < outlier_share
        u[false], v[false] = rng.uniform(0, 640, false.sum()), rng.uniform(0, 480, false.sum())
        depth[rng.random(names.size) > depth_share] = 0.0
        rows.append(np.column_stack([np.full(names.size, k), names, u, v, depth, false]))
    table = np.concatenate(rows)
    seen = LandmarkObservations(
        table[:, 0].astype(np.int64),
        # Names are any numbers, with gaps.
        table[:, 1].astype(np.int64) * 7 + 1000,
        table[:, 2:4],
        table[:, 4],
        np.ones(len(table)),
    )
    start = [truth[0], *(pose.retract(rng.normal(0.0, 0.01, 6)) for pose in truth[1:])]
    return World(truth, start, seen, table[:, 5] > 0)


def solved(made: World, steps: list[PoseStep] | None = None) -> WindowResult:
    result = adjust_window(made.start, made.seen, CAMERA, steps or [])
    assert isinstance(result, WindowResult), result
    return result


def reason(made: World, **changed: object) -> str:
    result = adjust_window(made.start, replace(made.seen, **changed), CAMERA)
    assert isinstance(result, WindowFailure)
    return result.reason


def true_steps(made: World, sigma: float) -> list[PoseStep]:
    return [
        PoseStep(k, k + 1, a.between(b), sigma**2 * np.eye(6))
        for k, (a, b) in enumerate(zip(made.truth[:-1], made.truth[1:], strict=True))
    ]


def nees(made: World, result: WindowResult, reference: int, covariance: FloatArray) -> float:
    """Squared error of the last pose seen from the reference, a degree of freedom."""
    true, found = (poses[reference].between(poses[-1]) for poses in (made.truth, result.poses))
    error = true.localCoordinates(found)
    return float(error @ np.linalg.solve(covariance, error)) / 6


@pytest.mark.parametrize("depth_share", [1.0, 0.5])
def test_without_noise_it_is_exact(depth_share: float) -> None:
    made = world(0, noise=0.0, depth_share=depth_share)
    result = solved(made)
    assert result.converged and result.inliers.mean() > 0.97
    for true, found in zip(made.truth, result.poses, strict=True):
        assert true.equals(found, 1e-5)
    assert result.poses[0].equals(made.truth[0], 0.0)


def test_depthless_landmarks_take_their_scale_from_the_steps() -> None:
    made = world(1, noise=0.0, depth_share=0.0)
    result = solved(made, true_steps(made, 0.001))
    for true, found in zip(made.truth, result.poses, strict=True):
        assert true.equals(found, 1e-4)
    assert np.isnan(result.depth_sigma_at_1m)
    assert "scale" in reason(made)


@pytest.mark.parametrize("shape", [{"keyframes": 2}, {"keyframes": 5}, {"keyframes": 5, "visible": 0.4}])
def test_the_covariance_is_calibrated(shape: dict[str, float]) -> None:
    scores = []
    for seed in range(20):
        made = world(seed, **shape)  # type: ignore[arg-type]
        result = solved(made)
        last = len(made.truth) - 1
        scores.append(
            [
                nees(made, result, 0, result.covariance_first),
                nees(made, result, last - 1, result.covariance_previous),
            ]
        )
    mean = np.mean(scores, axis=0)
    assert np.all((mean > 0.5) & (mean < 2.0)), mean


def test_noise_is_measured_not_believed() -> None:
    made = world(2, landmarks=150, noise=3.0)
    result = solved(made)
    quiet = solved(world(2, landmarks=150, noise=1.0))
    assert 2.0 < result.residual_px < 3.3
    assert 0.7 < result.depth_sigma_at_1m / (3.0 * DEPTH_SIGMA) < 1.3
    ratio = np.trace(result.covariance_first) / np.trace(quiet.covariance_first)
    assert 5.0 < ratio < 14.0  # 9 by theory


@pytest.mark.parametrize("share", [0.1, 0.25])
def test_outliers_are_dropped(share: float) -> None:
    made = world(3, landmarks=150, outlier_share=share)
    result = solved(made)
    # A false sighting may fall near the true place by chance.
    assert result.inliers[made.outliers].mean() < 0.03
    assert result.inliers[~made.outliers].mean() > 0.8
    assert np.linalg.norm(made.truth[-1].between(result.poses[-1]).translation()) < 0.02


def test_a_keyframe_without_sightings_hangs_on_its_step() -> None:
    """The step alone tells where the last pose is and how sure, whatever the others' errors."""
    made = world(4)
    seen = made.seen.where(made.seen.keyframe != 4)
    step = PoseStep(3, 4, STEP, 1e-6 * np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    result = adjust_window(made.start, seen, CAMERA, [step])
    assert isinstance(result, WindowResult)
    assert result.poses[3].between(result.poses[4]).equals(STEP, 1e-6)
    np.testing.assert_allclose(result.covariance_previous, step.covariance, rtol=1e-3, atol=1e-10)
    without = adjust_window(made.start, seen, CAMERA)
    assert isinstance(without, WindowFailure) and "keyframe 4" in without.reason


def test_what_cannot_be_solved_says_so() -> None:
    made = world(5)
    assert "two keyframes" in reason(made, landmark=np.arange(len(made.seen)))
    few = made.seen.where(made.seen.landmark < 1000 + 7 * 6)
    result = adjust_window(made.start, few, CAMERA)
    assert isinstance(result, WindowFailure) and "shares" in result.reason
    nothing = made.seen.where(np.zeros(len(made.seen), np.bool_))
    assert isinstance(adjust_window(made.start, nothing, CAMERA), WindowFailure)


def test_most_landmarks_takes_the_longest_tracks() -> None:
    keyframe = np.array([0, 1, 2, 0, 1, 0, 0])
    landmark = np.array([5, 5, 5, 9, 9, 4, 4])
    blank = np.zeros(7)
    seen = LandmarkObservations(keyframe, landmark, np.zeros((7, 2)), blank, blank)
    everything = np.ones(7, np.bool_)
    assert tracked(seen, everything, 1).tolist() == [True] * 3 + [False] * 4
    # Landmark 4 is seen twice, but from one keyframe.
    assert tracked(seen, everything, 9).tolist() == [True] * 5 + [False] * 2


@settings(max_examples=25, deadline=None)
@given(st.floats(0.3, 8.0), st.floats(-0.8, 0.8), st.floats(0.1, 0.4), st.booleans())
def test_a_start_is_where_the_rays_meet(z: float, x: float, baseline: float, deep: bool) -> None:
    poses = [gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.array([0.0, baseline * max(z, 1.0), 0.0]))]
    point = np.array([x, 0.2, z])
    seen_from = [pose.transformTo(point) for pose in poses]
    pixels = np.array(
        [[CAMERA.fx * p[0] / p[2] + CAMERA.cx, CAMERA.fy * p[1] / p[2] + CAMERA.cy] for p in seen_from]
    )
    depth = np.array([p[2] for p in seen_from]) if deep else np.zeros(2)
    seen = LandmarkObservations(np.array([0, 1]), np.array([0, 0]), pixels, depth, np.ones(2))
    points, known = starting_points(seen, poses, CAMERA)
    assert known.tolist() == [True]
    np.testing.assert_allclose(points[0], point, atol=1e-6)


def broken(field: str, value: float) -> Callable[[LandmarkObservations], LandmarkObservations]:
    def breaks(seen: LandmarkObservations) -> LandmarkObservations:
        column = getattr(seen, field).copy()
        column[3] = value
        return replace(seen, **{field: column})

    return breaks


@pytest.mark.parametrize(
    "breaks",
    [
        broken("pixels", np.nan),
        broken("depth_m", np.inf),
        broken("depth_m", -1.0),
        broken("sigma_px", 0.0),
        broken("keyframe", 5),
        broken("keyframe", -1),
        lambda seen: replace(seen, sigma_px=seen.sigma_px[1:]),
    ],
)
def test_bad_sightings_are_refused(
    breaks: Callable[[LandmarkObservations], LandmarkObservations],
) -> None:
    made = world(6)
    with pytest.raises(GraphError):
        adjust_window(made.start, breaks(made.seen), CAMERA)


@pytest.mark.parametrize(
    "step",
    [
        PoseStep(0, 9, STEP, np.eye(6)),
        PoseStep(1, 1, STEP, np.eye(6)),
        PoseStep(0, 1, gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0])), np.eye(6)),
        PoseStep(0, 1, STEP, np.eye(3)),
        PoseStep(0, 1, STEP, np.diag([1.0, 1, 1, 1, 1, 0])),
    ],
)
def test_bad_steps_are_refused(step: PoseStep) -> None:
    made = world(7)
    with pytest.raises(GraphError):
        adjust_window(made.start, made.seen, CAMERA, [step])


def test_bad_poses_are_refused() -> None:
    made = world(8)
    with pytest.raises(GraphError):
        adjust_window(made.start[:1], made.seen, CAMERA)
    lost = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0]))
    with pytest.raises(GraphError):
        adjust_window([*made.start[:4], lost], made.seen, CAMERA)
