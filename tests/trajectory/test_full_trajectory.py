"""Corrected anchors carried over to every reading: exact at the anchors, rigid outside, spread between."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.matching.planar import between, compose
from slam.measurements import FloatArray
from slam.trajectory import spread
from slam.trajectory.poses import Poses

QUIET = settings(deadline=None, max_examples=80)
ROWS = st.builds(
    lambda x, y, yaw: np.array([x, y, yaw]), st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1)
)


def rows(poses: Poses) -> FloatArray:
    return poses.trajectory(np.zeros(len(poses))).to_planar()


def spread_correction(motion: FloatArray, anchors: FloatArray, poses: FloatArray) -> FloatArray:
    """Of rows (N, 3)."""
    return rows(spread.spread_correction(Poses.planar(motion), anchors, Poses.planar(poses)))


def steadied(
    matched: FloatArray, bridged: FloatArray, variances: FloatArray, anchors: FloatArray
) -> FloatArray:
    """Of rows (S, 3)."""
    whole = np.zeros((len(variances), 6))
    whole[:, [0, 1, 5]] = variances
    return rows(spread.steadied(Poses.planar(matched), Poses.planar(bridged), whole, anchors))


def walk(rng: np.random.Generator, count: int) -> FloatArray:
    """A drifting trajectory."""
    poses = [rng.normal(0.0, 3.0, 3)]
    for _ in range(count - 1):
        poses.append(compose(poses[-1], rng.normal([0.2, 0.0, 0.0], [0.1, 0.03, 0.2])))
    return np.array(poses)


def corrected(rng: np.random.Generator, motion: FloatArray, anchors: FloatArray) -> FloatArray:
    """The anchors in a map of another frame, each a little off the motion."""
    frame = np.array([30.0, -7.0, 1.3])
    return np.array(
        [compose(compose(frame, motion[a]), rng.normal(0.0, [0.3, 0.3, 0.1])) for a in anchors]
    ).reshape(-1, 3)


@st.composite
def cases(draw: st.DrawFn) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Motion (N, 3), anchors (M,) and their poses (M, 3)."""
    count = draw(st.integers(1, 40))
    anchors = draw(st.sets(st.integers(0, count - 1), min_size=1))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    motion = walk(rng, count)
    numbers = np.array(sorted(anchors), dtype=np.int64)
    return motion, numbers, corrected(rng, motion, numbers)


def assert_same_poses(a: FloatArray, b: FloatArray, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(a[:, :2], b[:, :2], atol=tolerance)
    np.testing.assert_allclose(np.remainder(a[:, 2] - b[:, 2] + 1.0, 2 * math.pi), 1.0, atol=tolerance)


@QUIET
@given(cases())
def test_anchors_are_reproduced_exactly(case: tuple[FloatArray, FloatArray, FloatArray]) -> None:
    _, anchors, poses = case
    assert_same_poses(spread_correction(*case)[anchors], poses)
    assert np.isfinite(spread_correction(*case)).all()


@QUIET
@given(cases())
def test_rigid_before_the_first_and_after_the_last_anchor(
    case: tuple[FloatArray, FloatArray, FloatArray],
) -> None:
    motion, anchors, poses = case
    result = spread_correction(*case)
    for anchor, pose, readings in (
        (anchors[0], poses[0], range(anchors[0])),
        (anchors[-1], poses[-1], range(anchors[-1], len(motion))),
    ):
        expected = [compose(pose, between(motion[anchor], motion[n])) for n in readings]
        assert_same_poses(result[list(readings)], np.array(expected).reshape(-1, 3))


@QUIET
@given(cases(), ROWS)
def test_moving_the_map_moves_the_result(
    case: tuple[FloatArray, FloatArray, FloatArray], frame: FloatArray
) -> None:
    motion, anchors, poses = case
    expected = np.array([compose(frame, pose) for pose in spread_correction(*case)])
    there = np.array([compose(frame, pose) for pose in poses])
    assert_same_poses(spread_correction(motion, anchors, there), expected, 1e-7)


@QUIET
@given(cases(), ROWS)
def test_the_frame_of_the_motion_does_not_matter(
    case: tuple[FloatArray, FloatArray, FloatArray], frame: FloatArray
) -> None:
    motion, anchors, poses = case
    elsewhere = np.array([compose(frame, pose) for pose in motion])
    assert_same_poses(spread_correction(elsewhere, anchors, poses), spread_correction(*case), 1e-7)


@QUIET
@given(cases())
def test_motion_that_agrees_is_taken_as_it_is(case: tuple[FloatArray, FloatArray, FloatArray]) -> None:
    motion, anchors, _ = case
    assert_same_poses(spread_correction(motion, anchors, motion[anchors]), motion)


@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (5.0, 6.0, -2.0)])
def test_a_wrong_scale_is_spread_by_the_way(frame: tuple[float, ...]) -> None:
    """Wheels that say 1 m for every 1.1 m, at uneven steps: between the anchors each pose is scaled."""
    x = np.array([0.0, 0.1, 0.1, 0.7, 0.9, 1.0, 1.5, 2.0])
    motion = np.column_stack([x, np.zeros(8), np.zeros(8)])
    truth = np.array([compose(np.array(frame), row) for row in motion * [1.1, 1.0, 1.0]])
    anchors = np.array([0, 5, 7])
    assert_same_poses(spread_correction(motion, anchors, truth[anchors]), truth, 1e-5)


def test_a_missed_turn_is_spread_by_the_turn() -> None:
    """On the spot, the anchors turned by 1.2 rad where the wheels say 1: across pi, at uneven steps."""
    yaw = 2.5 + np.array([0.0, 0.1, 0.4, 0.9, 1.0])
    motion = np.column_stack([np.zeros(5), np.zeros(5), np.remainder(yaw + math.pi, 2 * math.pi) - math.pi])
    truth = np.column_stack([np.zeros(5), np.zeros(5), 2.5 + 1.2 * (yaw - 2.5)])
    assert_same_poses(spread_correction(motion, np.array([0, 4]), truth[[0, 4]]), truth, 1e-5)


def test_the_residual_grows_monotonically() -> None:
    rng = np.random.default_rng(2)
    motion = walk(rng, 30)
    anchors = np.array([0, 29])
    poses = motion[anchors].copy()
    poses[1] += [0.5, -0.2, 0.1]
    added = spread_correction(motion, anchors, poses) - motion
    shares = added[:, 0] / 0.5
    assert shares[0] == pytest.approx(0.0, abs=1e-12)
    assert shares[-1] == pytest.approx(1.0)
    assert (np.diff(shares) > 0.0).all()
    np.testing.assert_allclose(added[:, 1], -0.2 * shares, atol=1e-9)


def test_a_robot_that_stands_shares_evenly() -> None:
    """No way at all between two anchors that differ: the correction is spread over the readings."""
    motion = np.zeros((5, 3))
    result = spread_correction(motion, np.array([0, 4]), np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]]))
    np.testing.assert_allclose(result[:, 0], [0.0, 0.1, 0.2, 0.3, 0.4], atol=1e-9)


@pytest.mark.parametrize(("guessed", "shares"), [([2, 3], [0, 0, 1, 2, 3, 3]), ([], [0, 1, 2, 3, 4, 5])])
def test_what_nothing_measured_is_what_was_wrong(guessed: list[int], shares: list[int]) -> None:
    """The steps to and from guesses take all of a correction; where there are none each takes its part."""
    motion, end = np.zeros((6, 3)), np.array([0.3, 0.0, 0.0])
    motion[:, 0] = np.arange(6)
    mask = np.isin(np.arange(6), guessed)
    anchors = np.array([0, 5])
    poses = Poses.planar(np.array([motion[0], motion[5] + end]))
    found = rows(spread.spread_correction(Poses.planar(motion), anchors, poses, mask))
    np.testing.assert_allclose(found[:, 0] - motion[:, 0], 0.3 * np.array(shares) / shares[-1], atol=1e-9)


def test_one_reading() -> None:
    found = spread_correction(np.ones((1, 3)), np.array([0]), np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(found, [[1.0, 2.0, 3.0]], atol=1e-12)


def straight(count: int) -> FloatArray:
    """Poses every 5 cm."""
    return np.column_stack([0.05 * np.arange(count), np.zeros(count), np.zeros(count)])


def test_noise_between_anchors_goes_and_anchors_stay() -> None:
    way, anchors = straight(201), np.arange(0, 201, 5)
    noise = np.random.default_rng(0).normal(0.0, (0.02, 0.02, 0.01), (201, 3))
    noise[anchors] = 0.0
    matched = way + noise
    poses = steadied(matched, way, np.full((201, 3), (0.02, 0.02, 0.01)) ** 2, anchors)
    np.testing.assert_allclose(poses[anchors], way[anchors], atol=1e-12)
    assert np.std(poses - way) < 0.35 * np.std(noise)


def test_where_wheels_slip_the_matches_count() -> None:
    """The way is 10 cm off over an interval; matches are 5 mm fine."""
    way, anchors = straight(101), np.array([0, 40, 60, 100])
    slipped = way.copy()
    slipped[41:60, 1] += 0.1
    poses = steadied(way, slipped, np.full((101, 3), 0.005**2), anchors)
    assert np.abs(poses - way).max() < 0.002


def test_a_pose_that_nothing_measured_stays() -> None:
    way = straight(11)
    matched = way + np.array([0.0, 0.01, 0.0])
    matched[[0, 10]] = way[[0, 10]]
    poses = steadied(matched, way, np.full((11, 3), np.nan), np.array([0, 10]))
    np.testing.assert_allclose(poses, matched, atol=1e-12)
