"""Point-to-line alignment: known displacements come back, and what is open stays at the guess."""

import math

import numpy as np
import pytest
from flat_worlds import box, corridor, moved, points_at, room

from slam.matching.planar import between, compose, transform_points
from slam.matching.point_to_line import Alignment, align
from slam.matching.surfel_map import SurfelMap, build_surfel_maps
from slam.measurements import FloatArray

LOOSE = np.eye(3)
FRAMES = [(0.0, 0.0, 0.0), (70.0, -30.0, 2.2)]
DISPLACEMENTS = [(0.0, 0.0, 0.0), (0.05, 0.0, 0.0), (0.0, -0.05, 0.0), (0.0, 0.0, 0.04), (-0.04, 0.05, -0.03)]


def surfels_of(segments: FloatArray, pose: FloatArray, cell_m: float = 0.1) -> SurfelMap:
    """The map that one sweep from a pose gives, in the world frame."""
    points, normals = points_at(segments, pose, beams=1441).oriented()
    turn = np.array([0.0, 0.0, pose[2]])
    return build_surfel_maps(transform_points(points, pose), transform_points(normals, turn), (cell_m,))[0]


def align_to(
    surfels: SurfelMap,
    segments: FloatArray,
    truth: FloatArray,
    guess: FloatArray,
    prior: FloatArray = LOOSE,
    iterations: int = 30,
) -> Alignment:
    points, normals = points_at(segments, truth).oriented()
    return align(points, normals, guess, guess, surfels, 0.1, iterations, prior)


@pytest.mark.parametrize("displacement", DISPLACEMENTS)
@pytest.mark.parametrize("frame", FRAMES)
def test_a_square_room_recovers_a_known_displacement(
    frame: tuple[float, ...], displacement: tuple[float, ...]
) -> None:
    segments = moved(room(), frame)
    home = compose(np.array(frame), np.array([0.3, -0.2, 0.1]))
    truth = compose(home, np.array(displacement))
    result = align_to(surfels_of(segments, home), segments, truth, guess=home)
    error = between(truth, result.pose)
    assert math.hypot(error[0], error[1]) < 1e-3
    assert abs(error[2]) < 1e-3
    assert result.converged
    assert result.residual_m < 0.005
    assert result.inlier_share > 0.95
    assert 0.9 < result.fit <= result.inlier_share + 1e-9


def test_convergence_is_reported() -> None:
    home = np.array([0.3, -0.2, 0.1])
    surfels = surfels_of(room(), home)
    guess = compose(home, np.array([0.08, 0.0, 0.0]))
    assert not align_to(surfels, room(), home, guess, iterations=1).converged
    assert align_to(surfels, room(), home, guess, iterations=30).converged


def test_the_hessian_counts_points() -> None:
    """In a square empty room half the points look along x, half along y: the information is known."""
    segments = box(-2, -2, 2, 2)
    home = np.zeros(3)
    result = align_to(surfels_of(segments, home, 0.05), segments, home, home)
    assert result.hessian[0, 0] + result.hessian[1, 1] == pytest.approx(result.weight, rel=1e-6)
    assert result.hessian[0, 0] == pytest.approx(result.hessian[1, 1], rel=0.05)
    np.testing.assert_allclose(result.hessian, result.hessian.T)
    points, normals = points_at(segments, home).oriented()
    levers = points[:, 0] * normals[:, 1] - points[:, 1] * normals[:, 0]
    assert result.hessian[2, 2] == pytest.approx((levers.astype(float) ** 2).sum(), rel=0.05)


@pytest.mark.parametrize("frame", FRAMES)
def test_the_hessian_is_of_the_base_frame(frame: tuple[float, ...]) -> None:
    """The same room and scan in another map frame: nothing of the result but the pose changes."""
    home = np.array([0.3, -0.2, 0.1])
    plain = align_to(surfels_of(room(), home), room(), home, home)
    segments, there = moved(room(), frame), compose(np.array(frame), home)
    other = align_to(surfels_of(segments, there), segments, there, there)
    np.testing.assert_allclose(other.hessian, plain.hessian, rtol=0.05, atol=0.05 * plain.weight)


def test_the_prior_holds_what_the_points_leave_open() -> None:
    segments = corridor()
    home = np.array([0.0, 0.2, 0.0])
    surfels = surfels_of(segments, home)
    guess = np.array([0.7, 0.15, 0.02])
    result = align_to(surfels, segments, home, guess)
    assert result.pose[0] == pytest.approx(0.7, abs=0.01), "along the corridor only the guess speaks"
    assert result.pose[1] == pytest.approx(0.2, abs=1e-3), "across it the walls do"
    assert result.pose[2] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.5])
def test_the_prior_is_of_the_base_frame(yaw: float) -> None:
    """A prior on the base's own x pins that and lets the walls decide on y, whatever way the base faces."""
    home = np.array([0.3, -0.2, yaw])
    truth = compose(home, np.array([0.04, 0.04, 0.0]))
    result = align_to(surfels_of(room(), home), room(), truth, home, np.diag([1e9, 0.0, 1e9]))
    moved_by = between(home, result.pose)
    assert moved_by[0] == pytest.approx(0.0, abs=1e-5)
    assert moved_by[1] == pytest.approx(0.04, abs=0.01)


def test_a_strong_prior_pins_the_pose() -> None:
    home = np.array([0.3, -0.2, 0.1])
    guess = compose(home, np.array([0.05, 0.03, 0.02]))
    result = align_to(surfels_of(room(), home), room(), home, guess, np.eye(3) * 1e12)
    np.testing.assert_allclose(result.pose, guess, atol=1e-6)


def test_the_start_is_not_the_guess() -> None:
    """The iteration starts at one pose and the prior holds another: the prior decides what is open."""
    segments = corridor()
    home = np.array([0.0, 0.2, 0.0])
    points, normals = points_at(segments, home).oriented()
    start, guess = np.array([0.3, 0.2, 0.0]), np.array([-0.2, 0.2, 0.0])
    result = align(points, normals, start, guess, surfels_of(segments, home), 0.1, 20, LOOSE * 10)
    assert result.pose[0] == pytest.approx(-0.2, abs=0.01)
    # The caller's start is not written to.
    np.testing.assert_array_equal(start, [0.3, 0.2, 0.0])


def test_people_in_the_room_pull_little() -> None:
    """A fifth of the points stands 25 cm before the walls: the kernel lets them go."""
    home = np.array([0.3, -0.2, 0.1])
    points, normals = points_at(room(), home).oriented()
    points = points.copy()
    points[:70] += 0.25 * normals[:70]
    result = align(points, normals, home, home, surfels_of(room(), home, 0.3), 0.05, 30, LOOSE)
    error = between(home, result.pose)
    assert math.hypot(error[0], error[1]) < 0.01
    assert result.inlier_share == pytest.approx(1.0 - 70 / len(points), abs=0.05)
    assert result.fit == pytest.approx(result.inlier_share, abs=0.05)


def test_no_overlap_moves_nothing() -> None:
    home = np.array([0.3, -0.2, 0.1])
    guess = np.array([100.0, 0.0, 0.0])
    result = align_to(surfels_of(room(), home), room(), home, guess)
    np.testing.assert_allclose(result.pose, guess)
    assert result.inlier_share == result.fit == result.weight == 0.0
    assert result.residual_m == math.inf


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_leave_a_finite_pose(count: int) -> None:
    home = np.array([0.3, -0.2, 0.1])
    points, normals = points_at(room(), home).oriented()
    guess = compose(home, np.array([0.05, 0.0, 0.0]))
    result = align(points[:count], normals[:count], guess, guess, surfels_of(room(), home), 0.1, 20, LOOSE)
    assert np.isfinite(result.pose).all()
    assert math.hypot(*(result.pose - home)[:2]) < 0.1
    if count == 0:
        np.testing.assert_array_equal(result.pose, guess)


def test_an_empty_map_and_no_prior_at_all() -> None:
    empty = build_surfel_maps(np.zeros((0, 2)), np.zeros((0, 2)), (0.1,))[0]
    result = align_to(empty, room(), np.zeros(3), np.ones(3), np.zeros((3, 3)))
    np.testing.assert_array_equal(result.pose, np.ones(3))
