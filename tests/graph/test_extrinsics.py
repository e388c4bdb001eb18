"""The camera's mount from two odometries: accuracy, bad pairs, wrong starts, and what cannot be reported."""

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion.curves import FORWARD
from slam.errors import GraphError
from slam.graph.extrinsics import (
    ExtrinsicsResult,
    MotionPair,
    camera_step_factor,
    estimate_extrinsics,
)
from slam.graph.hand_eye import Motions, covariances, linearise
from slam.measurements import FloatArray, Pose

# Rolled, pitched and turned from the usual mount, and off the centre.
MOUNT = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.05, 0.3, 0.6) * gtsam.Rot3(FORWARD), np.array([0.12, -0.07, 0.9]))
CAMERA_SIGMAS = np.array([np.radians(0.2)] * 3 + [0.005] * 3)
PLANAR_SIGMAS = np.array([0.003, 0.003, np.radians(0.1)])
SPATIAL_SIGMAS = np.array([np.radians(0.1)] * 3 + [0.003] * 3)


def pair_of(
    step: Pose, rng: np.random.Generator, noise: float = 1.0, mount: gtsam.Pose3 = MOUNT, bad: float = 0.0
) -> MotionPair:
    """A step as both odometries see it; a bad one stands still or jumps."""
    planar = isinstance(step, gtsam.Pose2)
    sigmas = PLANAR_SIGMAS if planar else SPATIAL_SIGMAS
    spatial = gtsam.Pose3(step) if planar else step
    seen = mount.inverse() * spatial * mount
    seen = seen * gtsam.Pose3.Expmap(noise * CAMERA_SIGMAS * rng.normal(size=6))
    reported = step * type(step).Expmap(noise * sigmas * rng.normal(size=sigmas.size))
    if rng.random() < bad:
        seen = [gtsam.Pose3(), seen * gtsam.Pose3.Expmap(rng.normal(0.0, 0.3, 6))][rng.integers(2)]
    return MotionPair(reported, np.diag(sigmas**2), seen, np.diag(CAMERA_SIGMAS**2))


def drive(rng: np.random.Generator, count: int = 150, turn_rad: float = 0.25) -> list[gtsam.Pose2]:
    """Steps of 0.25 m, turns in three of five."""
    turns = rng.normal(0.0, turn_rad, count) * (rng.random(count) < 0.6)
    return [gtsam.Pose2(0.25 * np.cos(turn / 2), 0.25 * np.sin(turn / 2), turn) for turn in turns]


def estimate(
    seed: int, start: gtsam.Pose3 | None = None, bad: float = 0.0, **kind: float
) -> ExtrinsicsResult:
    rng = np.random.default_rng(seed)
    return estimate_extrinsics([pair_of(step, rng, bad=bad) for step in drive(rng, **kind)], start)  # type: ignore[arg-type]


def base_error(result: ExtrinsicsResult) -> FloatArray:
    """Rotation vector and offset from the true mount, axes of the base, (6,)."""
    found = result.T_base_camera
    turn = gtsam.Rot3.Logmap(found.rotation() * MOUNT.rotation().inverse())
    return np.concatenate([turn, found.translation() - MOUNT.translation()])


def assert_on_target(result: ExtrinsicsResult) -> None:
    error = base_error(result)
    assert np.abs(error[:3]).max() < np.radians(1.0)
    assert np.abs(error[3:5]).max() < 0.03
    assert result.converged


@pytest.mark.parametrize("seed", range(3))
def test_from_no_start(seed: int) -> None:
    result = estimate(seed)
    assert_on_target(result)
    assert result.unobservable == ("height",)
    assert result.inlier_share > 0.95
    assert result.T_base_camera.z() == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("angle_deg", [30.0, 170.0])
@pytest.mark.parametrize("seed", range(2))
def test_from_a_wrong_start_with_bad_pairs(seed: int, angle_deg: float) -> None:
    rng = np.random.default_rng(100 + seed)
    axis, offset = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    wrong = gtsam.Pose3(gtsam.Rot3.Expmap(np.radians(angle_deg) * axis), 0.3 * offset)
    result = estimate(seed, MOUNT * wrong, bad=0.3)
    assert_on_target(result)
    assert 0.6 < result.inlier_share < 0.8
    # The height is the start's: nothing shows it.
    assert result.T_base_camera.z() == pytest.approx((MOUNT * wrong).z(), abs=1e-3)


def test_without_noise_it_is_exact() -> None:
    rng = np.random.default_rng(0)
    pairs = [pair_of(step, rng, noise=0.0) for step in drive(rng, 30)]
    np.testing.assert_allclose(base_error(estimate_extrinsics(pairs))[:5], 0.0, atol=1e-6)


@settings(max_examples=12, deadline=None)
@given(st.tuples(*[st.floats(-3.1, 3.1)] * 3), st.tuples(*[st.floats(-1.0, 1.0)] * 3))
def test_any_mount_in_space(turn: tuple[float, float, float], offset: tuple[float, float, float]) -> None:
    """A hand-held rig turns about all axes: all six numbers are reported, whatever they are."""
    mount = gtsam.Pose3(gtsam.Rot3.RzRyRx(*turn), np.array(offset))
    rng = np.random.default_rng(1)
    steps = [gtsam.Pose3.Expmap(rng.normal(0.0, 0.2, 6)) for _ in range(40)]
    result = estimate_extrinsics([pair_of(step, rng, mount=mount, bad=0.2) for step in steps])
    assert result.unobservable == ()
    assert mount.equals(result.T_base_camera, 0.03)


def test_the_covariance_is_calibrated() -> None:
    scores = []
    for seed in range(14):
        result = estimate(seed, count=60)
        axes = np.kron(np.eye(2), result.T_base_camera.rotation().matrix())
        covariance = (axes @ result.covariance @ axes.T)[:5, :5]
        error = base_error(result)[:5]
        scores.append(float(error @ np.linalg.solve(covariance, error)) / 5)
    assert 0.5 < np.mean(scores) < 2.0


def test_a_straight_drive_shows_the_heading_only() -> None:
    start = MOUNT * gtsam.Pose3(gtsam.Rot3.RzRyRx(0.1, -0.2, 0.15), np.array([0.1, 0.2, -0.1]))
    result = estimate(5, start, turn_rad=0.0)
    assert result.unobservable == ("roll", "x", "y", "height")
    assert np.abs(base_error(result)[1:3]).max() < np.radians(1.0)
    np.testing.assert_allclose(result.T_base_camera.translation(), start.translation(), atol=1e-3)
    sigmas = np.sqrt(np.diag(result.covariance))
    assert sigmas[:3].max() > 1.0 and sigmas[3:].min() > 1.0


def test_turning_on_the_spot_shows_no_heading() -> None:
    """Only the place of the camera across from the axis: its distance, not its bearing in the base."""
    rng = np.random.default_rng(6)
    turns = [gtsam.Pose2(0.0, 0.0, turn) for turn in rng.normal(0.0, 0.3, 80)]
    result = estimate_extrinsics([pair_of(step, rng) for step in turns])
    assert {"yaw", "height"} <= set(result.unobservable)
    assert not {"roll", "pitch"} & set(result.unobservable)


def test_standing_still_shows_nothing() -> None:
    rng = np.random.default_rng(7)
    result = estimate_extrinsics([pair_of(gtsam.Pose2(), rng) for _ in range(50)], MOUNT)
    assert result.unobservable == ("all",) and not result.converged
    assert result.T_base_camera.equals(MOUNT, 1e-3)
    assert np.sqrt(np.linalg.eigvalsh(result.covariance)[0]) > 1.0


@pytest.mark.parametrize("count", [0, 1])
def test_one_pair_or_none(count: int) -> None:
    rng = np.random.default_rng(8)
    result = estimate_extrinsics([pair_of(gtsam.Pose2(0.25, 0.0, 0.4), rng) for _ in range(count)], MOUNT)
    assert result.inliers.shape == (count,)
    assert "height" in result.unobservable or result.unobservable == ("all",)
    assert np.isfinite(result.covariance).all()
    # A start that is right is not spoilt.
    assert np.linalg.norm(base_error(result)) < 0.2


@pytest.mark.parametrize("planar", [True, False])
def test_jacobians_of_the_factor(planar: bool) -> None:
    rng = np.random.default_rng(9)
    kind = gtsam.Pose2 if planar else gtsam.Pose3
    size = 3 if planar else 6
    first, second = (kind.Expmap(rng.normal(0.0, 0.7, size)) for _ in range(2))
    measured = gtsam.Pose3.Expmap(rng.normal(0.0, 0.4, 6))
    factor = camera_step_factor((0, 1, 2), measured, gtsam.noiseModel.Unit.Create(6), planar)

    def values_at(changes: list[FloatArray]) -> gtsam.Values:
        values = gtsam.Values()
        for key, (pose, change) in enumerate(zip((first, second, MOUNT), changes, strict=True)):
            values.insert(key, pose.compose(type(pose).Expmap(change)))
        return values

    still = [np.zeros(size), np.zeros(size), np.zeros(6)]
    given_jacobians = np.split(factor.linearize(values_at(still)).jacobian()[0], [size, 2 * size], axis=1)
    for n, analytic in enumerate(given_jacobians):
        for column in range(analytic.shape[1]):
            ends = []
            for h in (1e-6, -1e-6):
                changes = [change.copy() for change in still]
                changes[n][column] = h
                ends.append(factor.unwhitenedError(values_at(changes)))
            np.testing.assert_allclose(analytic[:, column], (ends[0] - ends[1]) / 2e-6, atol=1e-6)


def test_jacobians_of_the_search() -> None:
    rng = np.random.default_rng(10)
    steps = [gtsam.Pose3.Expmap(rng.normal(0.0, 0.4, 6)) for _ in range(4)]
    pairs = [pair_of(step, rng, noise=0.0) for step in steps]
    base = np.stack([pair.base_step.matrix() for pair in pairs])
    camera = np.stack([pair.camera_step.matrix() for pair in pairs])
    tiny = np.tile(1e-8 * np.eye(6), (4, 1, 1))
    split = [part for steps in (base, camera) for part in (steps[:, :3, :3], steps[:, :3, 3], tiny)]
    errors_at = partial(linearise, Motions(*split))
    matrix = MOUNT.matrix()
    errors, jacobians = errors_at(matrix[:3, :3], matrix[:3, 3])
    np.testing.assert_allclose(errors, 0.0, atol=1e-9)
    for column in range(6):
        ends = []
        for h in (1e-6, -1e-6):
            moved = (MOUNT * gtsam.Pose3.Expmap(h * np.eye(6)[column])).matrix()
            ends.append(errors_at(moved[:3, :3], moved[:3, 3])[0])
        np.testing.assert_allclose(jacobians[:, :, column], (ends[0] - ends[1]) / 2e-6, atol=1e-6)


def test_the_base_noise_reaches_the_camera_by_the_adjoint() -> None:
    root = np.random.default_rng(12).normal(size=(6, 6))
    base, camera = root @ root.T, np.eye(6)
    blank = (np.eye(3)[None], np.zeros((1, 3)))
    motions = Motions(*blank, base[None], *blank, camera[None])
    back = MOUNT.inverse().AdjointMap()
    found = covariances(motions, MOUNT.rotation().matrix(), MOUNT.translation())
    np.testing.assert_allclose(found[0], camera + back @ base @ back.T, rtol=1e-9)


def test_bad_pairs_that_agree_among_themselves() -> None:
    """A third of the camera steps carries the same gross error."""
    rng = np.random.default_rng(13)
    jump = gtsam.Pose3.Expmap(rng.normal(size=6))
    pairs = [pair_of(step, rng) for step in drive(rng)]
    spoilt = rng.random(len(pairs)) < 0.3
    pairs = [
        replace(pair, camera_step=pair.camera_step * jump) if bad else pair
        for pair, bad in zip(pairs, spoilt, strict=True)
    ]
    result = estimate_extrinsics(pairs)
    assert_on_target(result)
    assert not result.inliers[spoilt].any()


@pytest.mark.parametrize(
    "change",
    [
        {"base_step": gtsam.Pose2(np.nan, 0.0, 0.0)},
        {"base_step": gtsam.Pose3()},
        {"camera_step": gtsam.Pose3(gtsam.Rot3(), np.array([0.0, np.inf, 0.0]))},
        {"base_covariance": np.diag([1.0, 1.0, 0.0])},
        {"base_covariance": np.eye(6)},
        {"camera_covariance": np.full((6, 6), np.nan)},
    ],
)
def test_bad_pairs_of_numbers_are_refused(change: dict[str, object]) -> None:
    rng = np.random.default_rng(11)
    good = [pair_of(step, rng) for step in drive(rng, 3)]
    with pytest.raises(GraphError):
        estimate_extrinsics([*good, replace(good[0], **change)])  # type: ignore[arg-type]


def test_a_start_that_is_not_finite_is_refused() -> None:
    with pytest.raises(GraphError):
        estimate_extrinsics([], gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0])))
