"""The search everywhere must be brute force over every pose, only faster; symmetry must be reported."""

import math
import os
from typing import Any

import gtsam
import numpy as np
import pytest
from flat_worlds import points_at, room

from slam.config.localization import LocalizationConfig
from slam.localization import global_search
from slam.localization.global_search import Place, Window, at_once, search_map
from slam.localization.poses import Measured
from slam.localization.whole_map_field import WholeMapField, build_whole_map_field
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.matching.planar import between, compose, transform_points
from slam.measurements import FloatArray

CELL_M = 0.1


def settings(least_score: float, keep_share: float) -> LocalizationConfig:
    values = {"search_least_score": least_score, "search_keep_share": keep_share}
    return LocalizationConfig().model_copy(update=values)


def searched(
    field: WholeMapField,
    points: FloatArray,
    least: float,
    keep: float,
    most: int,
    **given: Any,
) -> list[Place]:
    return at_once(search_map(field, points, settings(least, keep), most, **given))


def scores_of(field: WholeMapField, points: FloatArray) -> FloatArray:
    """Score sum of every robot pixel and yaw, (turns, rows, columns); -1 where none may stand."""
    picture, standing = field.levels[0].astype(int), field.standing[0]
    rows, columns = picture.shape
    reach_m = max(1.0, float(np.percentile(np.hypot(*points.T), 90)))
    turns = math.ceil(2.0 * math.pi * reach_m / CELL_M)
    margin = 60
    padded = np.pad(picture, margin, constant_values=field.unknown)
    scores = np.full((turns, rows, columns), -1)
    for turn in range(turns):
        seen = transform_points(points, np.array([0.0, 0.0, turn * 2.0 * math.pi / turns]))
        pixels = np.floor(seen / CELL_M + 0.5).astype(int) + margin
        total = np.zeros((rows, columns), int)
        for column, row in pixels:
            total += padded[row : row + rows, column : column + columns]
        scores[turn][standing] = total[standing]
    return scores


def small_world(seed: int) -> tuple[WholeMapField, FloatArray]:
    rng = np.random.default_rng(seed)
    walls = rng.uniform(-2.0, 2.0, (25, 2))
    grid = OccupancyGrid.of_log_odds(
        rng.choice(np.array([-2.0, 0.0, 2.0], np.float32), (50, 47)), 0.1, gtsam.Pose2(-2.5, -2.4, 0.0)
    )
    return build_whole_map_field(walls, grid, CELL_M), rng.uniform(-1.5, 1.5, (9, 2))


@pytest.mark.parametrize("seed", range(5))
def test_the_best_place_is_that_of_brute_force(seed: int) -> None:
    field, points = small_world(seed)
    scores = scores_of(field, points)
    found = searched(field, points, 0.1, 1.0, 3)
    assert found[0].score == pytest.approx(scores.max() / (255.0 * len(points)))
    turn, row, column = np.unravel_index(scores.argmax(), scores.shape)
    ties = np.argwhere(scores == scores.max())
    at = np.floor((found[0].pose[:2] - [field.origin_x, field.origin_y]) / CELL_M).astype(int)
    assert [at[1], at[0]] in ties[:, 1:].tolist(), (turn, row, column)


@pytest.mark.parametrize("seed", range(3))
def test_no_place_near_the_best_is_left_out(seed: int) -> None:
    field, points = small_world(seed)
    scores = scores_of(field, points)
    found = searched(field, points, 0.1, 0.9, 10_000)
    yaws = np.arange(len(scores)) * (2.0 * math.pi / len(scores))
    for turn, row, column in np.argwhere(scores >= 0.95 * scores.max()):
        pose = np.array(
            [
                field.origin_x + (column + 0.5) * CELL_M,
                field.origin_y + (row + 0.5) * CELL_M,
                yaws[turn],
            ]
        )
        offsets = np.array([between(place.pose, pose) for place in found])
        # Some place that stands for it: that of its block of 8 pixels, or one that this one was joined to.
        assert (np.hypot(offsets[:, 0], offsets[:, 1]) < 0.5 + 8 * CELL_M * math.sqrt(2.0)).any()


@pytest.mark.parametrize("seed", range(3))
def test_each_place_has_the_score_of_its_pose(seed: int) -> None:
    field, points = small_world(seed)
    # So far ahead of the robot that many fall outside of the map.
    points[:, 0] += 2.5
    scores = scores_of(field, points)
    yaw_rad = 2.0 * math.pi / len(scores)
    found = searched(field, points, 0.1, 0.8, 40)
    assert len(found) > 3
    for place in found:
        column, row = np.floor((place.pose[:2] - [field.origin_x, field.origin_y]) / CELL_M).astype(int)
        turn = round(place.pose[2] / yaw_rad) % len(scores)
        assert place.score == pytest.approx(scores[turn, row, column] / (255.0 * len(points)))


@pytest.mark.parametrize("seed", range(3))
def test_in_a_window_the_best_is_that_of_brute_force_there(seed: int) -> None:
    field, points = small_world(seed)
    scores = scores_of(field, points)
    known = Measured(gtsam.Pose2(0.4, -0.6, 2.0), np.diag([0.02, 0.08, 0.05]) ** 2)
    window = Window.of(known, 4.0)
    assert window.highest[0] - window.lowest[0] > window.highest[1] - window.lowest[1], "it looks along y"
    columns, rows = (
        np.floor((np.array([window.lowest[a], window.highest[a]]) - origin) / CELL_M).astype(int)
        for a, origin in enumerate((field.origin_x, field.origin_y))
    )
    yaws = np.arange(len(scores)) * (2.0 * math.pi / len(scores))
    near = np.abs((yaws - 2.0 + np.pi) % (2.0 * np.pi) - np.pi) <= window.half_yaw
    best = scores[near][:, rows[0] : rows[1] + 1, columns[0] : columns[1] + 1].max()
    found = searched(field, points, 0.1, 0.9, 50, window=window)
    assert found[0].score == pytest.approx(best / (255.0 * len(points)))
    for place in found:
        away = np.abs(place.pose[:2] - [0.4, -0.6])
        assert (away <= 0.5 * (window.highest - window.lowest) + CELL_M).all()
        assert abs(place.pose[2] - 2.0) <= window.half_yaw


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    field, points = small_world(7)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    alone = searched(field, points, 0.1, 0.7, 12)
    for threads in (2, 3):
        monkeypatch.setattr(os, "cpu_count", lambda count=threads: count)
        shared = searched(field, points, 0.1, 0.7, 12)
        np.testing.assert_array_equal([p.pose for p in alone], [p.pose for p in shared])
        assert [p.score for p in alone] == [p.score for p in shared]


def test_a_room_that_looks_the_same_turned_round_is_reported_twice() -> None:
    corners = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 3.0], [0.0, 3.0]])
    walls = np.concatenate(
        [
            a + (b - a) * np.linspace(0.0, 1.0, 60)[:, None]
            for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)
        ]
    )
    field = build_whole_map_field(walls, None, CELL_M)
    truth = np.array([1.5, 1.0, 0.4])
    points = transform_points(walls, between(truth, np.zeros(3)))
    found = searched(field, points, 0.8, 0.97, 10)
    assert len(found) == 2
    turned = np.array([5.0 - truth[0], 3.0 - truth[1], truth[2] - math.pi])
    for expected in (truth, turned):
        errors = [between(expected, place.pose) for place in found]
        assert min(np.hypot(e[0], e[1]) for e in errors) < 0.15


@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (40.0, -75.0, 2.0)])
def test_finds_a_furnished_room_wherever_its_frame_is(frame: tuple[float, ...]) -> None:
    base = np.array(frame)
    home, away = np.array([0.3, -0.2, 0.1]), np.array([-0.8, 0.5, 2.5])
    seen = transform_points(points_at(room(), home, beams=721).points_base, compose(base, home))
    field = build_whole_map_field(seen, None, CELL_M)
    scan = points_at(room(), away).points_base[::3]
    best = searched(field, scan, 0.4, 0.9, 5)[0]
    error = between(compose(base, away), best.pose)
    assert np.hypot(error[0], error[1]) < 0.15 and abs(error[2]) < 0.06


def test_a_high_bar_is_not_met() -> None:
    field, points = small_world(1)
    assert searched(field, points, 0.99, 0.9, 5) == []


def test_a_search_halts_after_so_many_blocks_and_finds_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    field, points = small_world(3)
    whole = searched(field, points, 0.1, 0.8, 12)[0]
    looked_at: list[int] = []
    bound = global_search._bound

    def counted(*arguments: Any) -> None:
        looked_at.append(len(arguments[7]))
        bound(*arguments)

    monkeypatch.setattr(global_search, "_MOST_BLOCKS", 2000)
    monkeypatch.setattr(global_search, "_bound", counted)
    steps, halts = search_map(field, points, settings(0.1, 0.8), 12), 0
    try:
        while True:
            next(steps)
            assert sum(looked_at) == 2000
            looked_at.clear()
            halts += 1
    except StopIteration as ended:
        assert tuple(ended.value[0].pose) == tuple(whole.pose)
    assert halts > 3 and sum(looked_at) < 2000
