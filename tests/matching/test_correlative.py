"""Branch and bound must be brute force, only faster."""

import math

import numpy as np
import pytest
from flat_worlds import moved, points_at, room
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.matching.correlative import LikelihoodField, build_field, search_window
from slam.matching.planar import between, compose, transform_points
from slam.measurements import FloatArray

CELL_M, SIGMA_M = 0.05, 0.1


def window_scores(
    field: LikelihoodField, points: FloatArray, guess: FloatArray, half_width_m: float, half_yaw_rad: float
) -> FloatArray:
    """Mean likelihood of every pose in the window, (turns, y offsets, x offsets), pose by pose."""
    step_rad = yaw_step_rad(points)
    turns = math.ceil(half_yaw_rad / step_rad)
    steps = math.ceil(half_width_m / CELL_M)
    offsets = np.arange(-steps, steps + 1)
    margin = 400
    picture = np.pad(field.levels[0].astype(int), margin)
    scores = np.empty((2 * turns + 1, offsets.size, offsets.size))
    for turn in range(-turns, turns + 1):
        yaw = guess[2] + turn * step_rad
        cos, sin = math.cos(yaw), math.sin(yaw)
        x = cos * points[:, 0] - sin * points[:, 1] + guess[0] - field.origin_x
        y = sin * points[:, 0] + cos * points[:, 1] + guess[1] - field.origin_y
        columns = np.floor(x / CELL_M).astype(int)[:, None, None] + offsets[None, :] + margin
        rows = np.floor(y / CELL_M).astype(int)[:, None, None] + offsets[:, None] + margin
        scores[turn + turns] = picture[rows, columns].mean(axis=0) / 255.0
    return scores


def yaw_step_rad(points: FloatArray) -> float:
    """The turn that moves the far points by a cell."""
    return CELL_M / max(1.0, float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90)))


@pytest.mark.parametrize("seed", range(4))
def test_pooled_levels_are_maxima(seed: int) -> None:
    rng = np.random.default_rng(seed)
    field = build_field(rng.uniform(-1.0, 1.0, (12, 2)), CELL_M, SIGMA_M)
    picture = field.levels[0]
    assert len(field.levels) > 1
    for k, level in enumerate(field.levels):
        width = 1 << k
        padded = np.pad(picture, ((width - 1, 0), (width - 1, 0)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (width, width))
        np.testing.assert_array_equal(level, windows.max(axis=(2, 3)))
    # A blob's outermost row reaches the last rows of the highest level, and is not cut off.
    last = np.flatnonzero(picture.any(axis=1)).max()
    assert field.levels[-1][last + width - 1].any()


@pytest.mark.parametrize("offset", [(0.0, 0.0), (-812.3, 55.1)])
def test_a_field_falls_off_as_a_gaussian(offset: tuple[float, float]) -> None:
    point = np.array([[0.4, 0.7]]) + offset
    field = build_field(point, CELL_M, SIGMA_M)
    picture = field.levels[0]
    row, column = np.unravel_index(picture.argmax(), picture.shape)
    assert picture[row, column] == 255
    assert field.origin_x + column * CELL_M <= point[0, 0] < field.origin_x + (column + 1) * CELL_M
    assert field.origin_y + row * CELL_M <= point[0, 1] < field.origin_y + (row + 1) * CELL_M
    for cells in range(1, 6):
        expected = 255.0 * math.exp(-0.5 * (cells * CELL_M / SIGMA_M) ** 2)
        for value in (picture[row, column + cells], picture[row - cells, column]):
            assert value == pytest.approx(expected, abs=1.0)


@st.composite
def searches(draw: st.DrawFn) -> tuple[FloatArray, FloatArray, FloatArray, float, float]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spots = rng.uniform(-1.5, 1.5, (draw(st.integers(1, 30)), 2))
    points = rng.uniform(-1.5, 1.5, (draw(st.integers(1, 12)), 2))
    guess = np.array([*rng.uniform(-1.0, 1.0, 2), rng.uniform(-math.pi, math.pi)])
    return spots, points, guess, draw(st.floats(0.01, 1.2)), draw(st.floats(0.0, 0.5))


@settings(deadline=None, max_examples=60)
@given(searches(), st.floats(0.0, 0.8))
def test_branch_and_bound_is_brute_force(
    search: tuple[FloatArray, FloatArray, FloatArray, float, float], least_score: float
) -> None:
    spots, points, guess, half_width_m, half_yaw_rad = search
    field = build_field(spots, CELL_M, SIGMA_M)
    scores = window_scores(field, points, guess, half_width_m, half_yaw_rad)
    result = search_window(field, points, guess, half_width_m, half_yaw_rad, least_score)
    assert result.found == (round(scores.max() * 255 * len(points)) > int(least_score * 255 * len(points)))
    if not result.found:
        np.testing.assert_array_equal(result.pose, guess)
        return
    assert result.score == pytest.approx(scores.max(), abs=1e-9)
    # The pose is a whole number of cells and turns away, inside the window, and it has that score.
    steps = (result.pose - guess) / [CELL_M, CELL_M, yaw_step_rad(points)]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    x, y, turn = np.round(steps).astype(int) + np.array(scores.shape)[::-1] // 2
    assert min(x, y, turn) >= 0
    assert scores[turn, y, x] == pytest.approx(result.score, abs=1e-9)


@pytest.mark.parametrize("half_width_m", [0.1, 0.3, 0.6, 1.0])
def test_nothing_outside_the_window_is_found(half_width_m: float) -> None:
    """The one place that fits lies just outside, on each side in turn: the search must not reach it."""
    points = np.array([[0.0, 0.0], [0.6, 0.1], [0.1, 0.9]])
    field = build_field(points, CELL_M, 0.02)
    for side in np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]):
        for beyond_m in (0.15, 0.4, 0.7):
            guess = np.array([*((half_width_m + beyond_m) * side), 0.0])
            result = search_window(field, points, guess, half_width_m, 0.0, 0.5)
            assert not result.found, f"found {result.pose - guess} from the guess"


@pytest.mark.parametrize(("turns", "finds"), [(None, False), ([0.0, 1.5], False), ([-2.0, 0.5, 2.0], True)])
def test_each_further_yaw_of_a_guess_has_its_own_window(turns: list[float] | None, finds: bool) -> None:
    points = np.array([[0.0, 0.0], [1.2, 0.1], [0.1, 0.9], [-1.6, -0.4]])
    truth, step_rad = np.array([0.3, -0.2, 2.1]), yaw_step_rad(points)
    field = build_field(transform_points(points, truth), CELL_M, SIGMA_M)
    further = None if turns is None else np.array(turns)
    result = search_window(field, points, np.zeros(3), 0.5, 3.0 * step_rad, 0.7, further)
    assert result.found == finds
    if finds:
        assert np.abs(result.pose - truth) == pytest.approx(0.0, abs=max(CELL_M, step_rad))


@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (-35.0, 80.0, -1.9)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_finds_a_wide_offset_in_a_room(frame: tuple[float, ...], sign: float) -> None:
    """2 m and 40 degrees off, to within a cell and a step of the yaw."""
    segments = moved(room(), frame)
    home = compose(np.array(frame), np.array([0.3, -0.2, 0.1]))
    seen = points_at(segments, home, beams=721).points_base
    field = build_field(transform_points(seen, home), CELL_M, SIGMA_M)
    truth = compose(home, np.array([-0.4, 0.6, 0.3]))
    scan = np.ascontiguousarray(points_at(segments, truth).points_base[::3])
    guess = compose(truth, sign * np.array([1.4, -1.4, math.radians(40.0)]))
    result = search_window(field, scan, guess, 2.2, math.radians(45.0), 0.5)
    assert result.found
    assert result.score > 0.8
    error = between(truth, result.pose)
    assert math.hypot(error[0], error[1]) < 1.5 * CELL_M
    assert abs(error[2]) < CELL_M / 2.0


def test_a_high_bar_is_not_met() -> None:
    rng = np.random.default_rng(0)
    field = build_field(rng.uniform(-3.0, 3.0, (40, 2)), CELL_M, SIGMA_M)
    guess = np.array([0.5, 0.5, 0.2])
    result = search_window(field, rng.uniform(-3.0, 3.0, (100, 2)), guess, 1.0, 0.5, 0.95)
    assert not result.found
    np.testing.assert_array_equal(result.pose, guess)


def test_points_wholly_outside_the_field() -> None:
    field = build_field(np.array([[0.0, 0.0]]), CELL_M, SIGMA_M)
    assert not search_window(field, np.array([[500.0, 0.0]]), np.zeros(3), 0.5, 0.3, 0.0).found


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_window_of_nothing_still_scores_the_guess(dtype: type) -> None:
    points = np.array([[0.0, 0.0], [1.0, 0.5], [0.2, 0.9]], dtype=dtype)
    field = build_field(points, CELL_M, SIGMA_M)
    result = search_window(field, points, np.zeros(3), 0.0, 0.0, 0.0)
    assert result.found
    assert result.score == pytest.approx(1.0)
    np.testing.assert_array_equal(result.pose, np.zeros(3))
