"""SE(2) on rows must be GTSAM's SE(2)."""

import math

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from slam.matching.local_map import OrientedPoints
from slam.matching.planar import (
    adjoint,
    between,
    compose,
    rotate_covariance,
    transform_points,
    wrap,
)
from slam.measurements import pose2_from_row

QUIET = settings(deadline=None, max_examples=100)
LENGTHS = st.floats(-1e3, 1e3, allow_subnormal=False)
ROWS = st.builds(lambda x, y, yaw: np.array([x, y, yaw]), LENGTHS, LENGTHS, st.floats(-10.0, 10.0))
ROOTS = arrays(np.float64, (3, 3), elements=st.floats(-3.0, 3.0, allow_subnormal=False))


def assert_same(row: np.ndarray, pose: gtsam.Pose2) -> None:
    assert row[:2] == pytest.approx(pose.translation(), abs=1e-8)
    assert math.remainder(row[2] - pose.theta(), 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)
    assert -math.pi <= row[2] < math.pi


@QUIET
@given(ROWS, ROWS)
def test_compose_and_between_are_gtsams(a: np.ndarray, b: np.ndarray) -> None:
    assert_same(compose(a, b), pose2_from_row(a).compose(pose2_from_row(b)))
    assert_same(between(a, b), pose2_from_row(a).between(pose2_from_row(b)))


@QUIET
@given(ROWS, ROWS)
def test_between_undoes_compose(a: np.ndarray, b: np.ndarray) -> None:
    assert_same(between(a, compose(a, b)), pose2_from_row(b))


@QUIET
@given(ROWS)
def test_adjoint_is_gtsams(a: np.ndarray) -> None:
    np.testing.assert_allclose(adjoint(a), pose2_from_row(a).AdjointMap(), atol=1e-9)


@QUIET
@given(ROWS, ROWS)
def test_adjoints_multiply_as_poses_do(a: np.ndarray, b: np.ndarray) -> None:
    np.testing.assert_allclose(adjoint(compose(a, b)), adjoint(a) @ adjoint(b), rtol=1e-9, atol=1e-7)


@QUIET
@given(ROWS, ROOTS)
def test_rotate_covariance_is_the_product(a: np.ndarray, root: np.ndarray) -> None:
    covariance = root @ root.T
    ad = pose2_from_row(a).AdjointMap()
    scale = max(1.0, np.abs(ad).max()) ** 2
    np.testing.assert_allclose(
        rotate_covariance(adjoint(a), covariance), ad @ covariance @ ad.T, rtol=1e-9, atol=1e-9 * scale
    )


def test_a_rotated_covariance_is_that_of_the_moved_perturbations() -> None:
    """What the adjoint means: exp(Ad xi) * T = T * exp(xi), so the samples' covariance follows."""
    rng = np.random.default_rng(3)
    pose = np.array([2.0, -1.0, 0.7])
    covariance = np.diag([1e-6, 4e-6, 9e-7])
    T = pose2_from_row(pose)
    left = [
        gtsam.Pose2.Logmap(T.compose(gtsam.Pose2.Expmap(xi)).compose(T.inverse()))
        for xi in rng.multivariate_normal(np.zeros(3), covariance, 4000)
    ]
    expected = rotate_covariance(adjoint(pose), covariance)
    np.testing.assert_allclose(np.cov(np.array(left).T), expected, atol=0.1 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(0.0, 0.0), (math.pi, -math.pi), (-math.pi, -math.pi), (3.5 * math.pi, -0.5 * math.pi), (-7.0, -0.7168)],
)
def test_wrap(angle: float, wrapped: float) -> None:
    assert wrap(angle) == pytest.approx(wrapped, abs=1e-4)


def test_points_move_as_gtsam_moves_them_and_directions_only_turn() -> None:
    points = np.array([[1.0, 2.0], [-3.0, 0.5]])
    pose = np.array([4.0, -2.0, 2.5])
    T = pose2_from_row(pose)
    np.testing.assert_allclose(transform_points(points, pose), [T.transformFrom(p) for p in points])
    moved = OrientedPoints(points, points).moved(pose)
    np.testing.assert_allclose(moved.normals, points @ T.rotation().matrix().T)


def test_no_points() -> None:
    assert transform_points(np.zeros((0, 2)), np.ones(3)).shape == (0, 2)
