"""Is a match as certain as it says? Normalised errors over many seeds, and the corridor's open direction."""

import itertools
import math

import numpy as np
import pytest
from flat_worlds import box, corridor, moved, points_at, room

from slam.config.stages import MatchConfig
from slam.estimates import MotionEstimate
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.match_covariance import motion_from_alignment, weak_direction
from slam.matching.planar import between, compose
from slam.matching.point_to_line import Alignment
from slam.measurements import FloatArray, row_from_pose2

CONFIG = MatchConfig()
# The covariance as the theory gives it, without any of the caution that the configuration adds.
BARE = CONFIG.model_copy(update={"floor_m": 1e-6, "minimal_residual_m": 1e-4})
HOME = np.array([0.3, -0.2, 0.1])
EXACT = 0  # instead of a number of noisy sweeps: the map is free of noise


def scan_at(segments: FloatArray, pose: FloatArray, **options: object) -> OrientedPoints:
    return OrientedPoints.from_scan(points_at(segments, pose, **options))


def map_of(segments: FloatArray, pose: FloatArray, sweeps: int, sigma_m: float, rng: object) -> LocalMap:
    """A local map in the world frame: one dense exact sweep, or a few noisy ones."""
    if sweeps == EXACT:
        return LocalMap.build([scan_at(segments, pose, beams=2881).moved(pose)], CONFIG)
    scans = [scan_at(segments, pose, sigma_m=sigma_m, seed=rng) for _ in range(sweeps)]
    return LocalMap.build([scan.moved(pose) for scan in scans], CONFIG)


def match(
    segments: FloatArray, pose: FloatArray, noise: MatchConfig, sigma_m: float = 0.0, seed: int = 0
) -> MotionEstimate:
    """A sweep matched from the true pose to the map that another one gives."""
    rng = np.random.default_rng(seed)
    local_map = map_of(segments, pose, 1 if sigma_m else EXACT, sigma_m, rng)
    scan = scan_at(segments, pose, sigma_m=sigma_m, seed=rng)
    return motion_from_alignment(local_map.align(scan, pose), noise)


def normalised_errors(sigma_m: float, sweeps: int, noise: MatchConfig, count: int) -> FloatArray:
    """Squared Mahalanobis error over its degrees of freedom, of (count,) matches in the room."""
    rng = np.random.default_rng(7)
    errors = np.empty(count)
    local_map = map_of(room(), HOME, EXACT, 0.0, rng)
    for n in range(count):
        if sweeps != EXACT:
            local_map = map_of(room(), HOME, sweeps, sigma_m, rng)
        truth = compose(HOME, rng.normal(0.0, [0.03, 0.03, 0.02]))
        scan = scan_at(room(), truth, sigma_m=sigma_m, seed=rng)
        guess = compose(truth, rng.normal(0.0, [0.02, 0.02, 0.01]))
        motion = motion_from_alignment(local_map.align(scan, guess), noise)
        error = between(row_from_pose2(motion.T_reference_base), truth)
        errors[n] = error @ np.linalg.solve(motion.covariance, error) / 3.0
    return errors


@pytest.mark.parametrize(
    ("sigma_m", "sweeps"), [(0.005, EXACT), (0.01, EXACT), (0.02, EXACT), (0.01, 1), (0.01, 8)]
)
def test_independent_noise_gives_the_errors_that_the_covariance_foretells(
    sigma_m: float, sweeps: int
) -> None:
    """An edge has two ends, each with such an error, and here only one is wrong: a little above one half."""
    assert 0.25 < normalised_errors(sigma_m, sweeps, BARE, 100).mean() < 1.0


@pytest.mark.parametrize(
    ("sigma_m", "sweeps", "most"), [(0.01, EXACT, 1.0), (0.01, 1, 1.0), (0.03, 1, 1.5), (0.03, 8, 6.0)]
)
def test_the_default_covariance_is_not_overconfident(sigma_m: float, sweeps: int, most: float) -> None:
    """The floors make it a little cautious, but not empty.

    Where several noisy sweeps lie over each other, the nearest of them is nearer than the wall, and residuals
    look smaller than they are (measured 4.0 for eight sweeps of 3 cm).
    """
    assert 0.05 < normalised_errors(sigma_m, sweeps, CONFIG, 60).mean() < most


def test_errors_that_neighbouring_beams_share_widen_the_covariance() -> None:
    """Bumps of a metre on the walls are shared by the many beams that see each."""
    rng = np.random.default_rng(5)
    squares, as_if_independent = [], []
    for _ in range(60):
        local_map = map_of(bumpy(room(), 0.01, rng), HOME, EXACT, 0.0, rng)
        alignment = local_map.align(scan_at(room(), HOME, sigma_m=0.002, seed=rng), HOME)
        error = between(alignment.pose, HOME)
        for errors, found in ((squares, alignment), (as_if_independent, alignment._replace(spread=None))):
            covariance = motion_from_alignment(found, BARE).covariance
            errors.append(error @ np.linalg.solve(covariance, error) / 3.0)
    assert np.mean(squares) < 1.5
    assert np.mean(as_if_independent) > 2.5 * np.mean(squares)


def bumpy(segments: FloatArray, sigma_m: float, rng: np.random.Generator) -> FloatArray:
    """Walls cut into pieces of a metre, each moved along its normal at random."""
    pieces = []
    for x1, y1, x2, y2 in np.asarray(segments).reshape(-1, 4):
        start, end = np.array([x1, y1]), np.array([x2, y2])
        length = float(np.hypot(*(end - start)))
        normal = np.array([y1 - y2, x2 - x1]) / length
        cuts = np.linspace(0.0, 1.0, max(2, round(length) + 1))
        for low, high in itertools.pairwise(cuts):
            offset = normal * rng.normal(0.0, sigma_m)
            pieces.append([*(start + low * (end - start) + offset), *(start + high * (end - start) + offset)])
    return np.array(pieces).reshape(-1, *np.asarray(segments).shape[1:])


def test_the_covariance_follows_the_noise() -> None:
    """Twice the noise, four times the variance."""
    quiet = match(room(), HOME, BARE, sigma_m=0.005).covariance
    loud = match(room(), HOME, BARE, sigma_m=0.01).covariance
    np.testing.assert_allclose(np.diag(loud) / np.diag(quiet), 4.0, rtol=0.25)


def test_no_match_is_surer_than_the_floors() -> None:
    covariance = match(room(), HOME, BARE.model_copy(update={"floor_m": 0.2})).covariance
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [0.2, 0.2, 0.1], rtol=1e-3)


def test_points_that_fit_nothing_are_a_doubt() -> None:
    local_map = map_of(room(), HOME, EXACT, 0.0, 0)
    confident = local_map.align(scan_at(room(), HOME), HOME)
    doubtful = confident._replace(inlier_share=0.5)
    bare = BARE.model_copy(update={"floor_m": 1e-9})
    ratio = (
        motion_from_alignment(doubtful, bare).covariance / motion_from_alignment(confident, bare).covariance
    )
    np.testing.assert_allclose(np.diag(ratio), (confident.inlier_share / 0.5) ** 2, rtol=0.02)


@pytest.mark.parametrize("sigma_m", [0.0, 0.01])
@pytest.mark.parametrize("yaw", [0.0, 0.6, math.pi / 2, -2.4])
@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (40.0, -7.0, 1.1)])
def test_a_corridor_leaves_its_own_direction_open(
    frame: tuple[float, ...], yaw: float, sigma_m: float
) -> None:
    pose = compose(np.array(frame), np.array([0.0, 0.2, yaw]))
    motion = match(moved(corridor(), frame), pose, CONFIG, sigma_m)
    assert motion.degenerate
    along = np.array([math.cos(yaw), -math.sin(yaw), 0.0])  # the corridor, seen from the base
    across = np.array([math.sin(yaw), math.cos(yaw), 0.0])
    assert np.linalg.norm(motion.weak_direction) == pytest.approx(1.0)
    assert abs(motion.weak_direction @ along) > math.cos(math.radians(4.0))
    assert along @ motion.covariance @ along > 10.0**2
    assert across @ motion.covariance @ across < 0.05**2
    assert motion.covariance[2, 2] < 0.02**2


@pytest.mark.parametrize("sigma_m", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("yaw", [0.0, 0.6, -2.4])
def test_a_room_is_not_degenerate(yaw: float, sigma_m: float) -> None:
    motion = match(room(), np.array([0.3, -0.2, yaw]), CONFIG, sigma_m)
    assert not motion.degenerate
    np.testing.assert_array_equal(motion.weak_direction, np.zeros(3))
    assert np.sqrt(np.diag(motion.covariance)).max() < 0.05


def test_a_corridors_end_in_sight_closes_the_direction() -> None:
    """The flag is a share of the points: an end wall near by is enough, one far away is not."""
    near = match(box(-5, -1, 200, 1), np.zeros(3), CONFIG)
    far = match(box(-29, -1, 200, 1), np.zeros(3), CONFIG)
    assert not near.degenerate
    assert far.degenerate


def test_a_single_wall_leaves_the_direction_along_it_open() -> None:
    wall = np.array([[-50.0, 2.0, 50.0, 2.0]])
    motion = match(wall, np.array([0.0, 0.0, 0.3]), CONFIG)
    assert motion.degenerate
    along = np.array([math.cos(0.3), -math.sin(0.3), 0.0])
    assert abs(motion.weak_direction @ along) > math.cos(math.radians(3.0))


def test_a_round_room_does_not_show_the_heading() -> None:
    angles = np.linspace(0.0, 2.0 * math.pi, 361)
    corners = 3.0 * np.column_stack([np.cos(angles), np.sin(angles)])
    circle = np.hstack([corners[:-1], corners[1:]])
    round_room = match(circle, np.zeros(3), CONFIG)
    square_room = match(room(), np.zeros(3), CONFIG)
    assert round_room.covariance[2, 2] > 100.0 * square_room.covariance[2, 2]
    assert round_room.covariance[2, 2] > 0.03**2
    assert round_room.covariance[0, 0] < 0.05**2


@pytest.mark.parametrize("residual_m", [0.01, math.inf])
def test_no_information_is_no_infinite_doubt(residual_m: float) -> None:
    """A match of nothing: a finite, positive definite and huge covariance."""
    nothing = Alignment(np.zeros(3), np.zeros((3, 3)), 0.0, residual_m, 0.0, 0.0, False)
    motion = motion_from_alignment(nothing, CONFIG)
    assert not motion.converged
    assert np.isfinite(motion.covariance).all()
    assert np.linalg.eigvalsh(motion.covariance)[0] > 1.0


def test_the_weak_direction_is_judged_with_the_yaw_free() -> None:
    """All information on x comes with a lever arm: once the yaw is free, none is left."""
    rows = np.array([[1.0, 0.0, 2.0]] * 50 + [[0.0, 1.0, 0.0]] * 50)
    alignment = Alignment(np.zeros(3), rows.T @ rows, 100.0, 0.01, 1.0, 1.0, True)
    weak = weak_direction(alignment, 0.02)
    assert weak is not None
    np.testing.assert_allclose(np.abs(weak), [1.0, 0.0, 0.0], atol=1e-6)
    # The same rows, the levers on both sides: x is determined.
    rows[:25, 2] = -2.0
    assert weak_direction(alignment._replace(hessian=rows.T @ rows), 0.02) is None
