"""The lidar's grid: rooms drawn by hand, order, bounds, growth, and what is refused."""

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from fusion.bayes import evidence_steps
from fusion.depth_model import RangeNoise
from slam.config import Config
from slam.errors import ConfigError, ScanweaveError
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.layer_builder import LayerBuilder
from slam.mapping.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, Thresholds
from slam.measurements import LaserScan, row_from_pose2
from tools.layer_building import build_layers

# Beams without noise: each says the most of its own cell, and of all before it.
DEFAULTS = replace(layer_settings(Config()), resolution_m=1.0, robot_radius_m=0.0)
EXACT = replace(DEFAULTS.lidar, p_miss=0.4, noise=RangeNoise(1e-6), max_clear_range_m=3.0, margin_sigmas=0.0)
SETTINGS = replace(DEFAULTS, lidar=EXACT, p_min=0.01, p_max=0.99)
EVEN = Thresholds(0.5, 0.5)
LETTERS = {UNKNOWN: ".", FREE: "o", OCCUPIED: "#"}


def scan_at(pose, ranges, start=0.0, step=math.pi / 2, stamp=0.0):
    """A scan, and the pose of its laser."""
    return LaserScan(stamp, np.array(ranges, np.float32), start, step, 50.0), gtsam.Pose2(*pose)


def build_grid(scans, settings=SETTINGS):
    """The grid of scans with their poses; each is a keyframe of its own."""
    posed = [(replace(scan, stamp_s=float(n)), pose) for n, (scan, pose) in enumerate(scans)]
    grid = build_layers([scan for scan, _ in posed], [pose for _, pose in posed], settings).lidar
    assert grid is not None
    return grid


def picture(grid, thresholds=EVEN):
    """The states as text, the highest row first."""
    return ["".join(LETTERS[int(state)] for state in row) for row in grid.states(thresholds)[::-1]]


def random_scans(rng, count=25, beams=60):
    return [
        scan_at(
            rng.uniform([-20, -20, -4], [20, 20, 4]),
            np.where(rng.random(beams) < 0.2, np.inf, rng.uniform(0.2, 9.0, beams)),
            start=rng.uniform(-3, 3),
            step=0.07,
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("corner", [(0.0, 0.0), (-3.0, 5.0), (12.0, -40.0)])
def test_a_room_drawn_by_hand(corner):
    x, y = corner
    grid = build_grid([scan_at([x + 0.5, y + 0.5, 0.0], [2.0, 1.0, 3.0, np.inf])])
    assert picture(grid) == [
        "...#..",
        "#oooo#",
        "...o..",
        "...o..",
        "...o..",
    ]
    np.testing.assert_allclose(row_from_pose2(grid.T_map_grid), [x - 3.0, y - 3.0, 0.0], atol=1e-12)
    assert grid.steps[3, 5] == evidence_steps(0.7)
    assert grid.steps[3, 4] == evidence_steps(0.4)
    assert grid.probabilities()[3, 5] == pytest.approx(0.7, abs=1e-3)
    assert grid.probabilities()[3, 4] == pytest.approx(0.4, abs=1e-3)
    assert grid.probabilities()[0, 0] == 0.5


def test_a_turned_laser_sees_the_same_room():
    straight = build_grid([scan_at([0.5, 0.5, 0.0], [2.0, 1.0, 3.0, np.inf])])
    turned = build_grid([scan_at([0.5, 0.5, math.pi / 2], [1.0, 3.0, np.inf, 2.0])])
    mounted = build_grid([scan_at([0.5, 0.5, 0.0], [1.0, 3.0, np.inf, 2.0], start=math.pi / 2)])
    assert picture(straight) == picture(turned) == picture(mounted)


def test_a_map_moved_by_whole_cells_holds_the_same_cells():
    scans = random_scans(np.random.default_rng(2))
    grid = build_grid(scans, replace(SETTINGS, resolution_m=0.25))
    T_moved_map = gtsam.Pose2(5.0, -3.25, 0.0)
    moved = [(scan, T_moved_map.compose(pose)) for scan, pose in scans]
    other = build_grid(moved, replace(SETTINGS, resolution_m=0.25))
    assert other.T_map_grid.equals(T_moved_map.compose(grid.T_map_grid), 1e-9)
    assert other.shape == grid.shape
    # A beam that ends on the very border of a cell may fall to either side after the move.
    assert np.mean(other.steps != grid.steps) < 1e-3


def test_the_order_of_the_scans_does_not_matter_to_the_last_bit():
    rng = np.random.default_rng(3)
    scans = random_scans(rng, count=40)
    fine = replace(SETTINGS, resolution_m=0.2)
    grid = build_grid(scans, fine)
    for _ in range(3):
        rng.shuffle(scans)
        again = build_grid(scans, fine)
        assert np.array_equal(again.steps, grid.steps)
        assert again.T_map_grid.equals(grid.T_map_grid, 0.0)


def test_evidence_adds_up_and_is_clamped_at_the_end():
    hit = scan_at([0.5, 0.5, 0.0], [2.0])
    passed = scan_at([0.5, 0.5, 0.0], [3.0])
    once, miss = evidence_steps(0.7), evidence_steps(0.4)
    assert build_grid([hit] * 3).steps[0].tolist() == [3 * miss, 3 * miss, 3 * once]
    many = build_grid([hit] * 100)
    np.testing.assert_allclose(many.probabilities()[0], [0.01, 0.01, 0.99], atol=1e-4)
    # A hundred hits weigh more than a hundred misses, though both would have met a bound on the way.
    both = build_grid([hit] * 100 + [passed] * 100)
    assert both.probabilities()[0, 2] == pytest.approx(0.99, abs=1e-4)


def test_one_hit_marks_a_cell_and_some_misses_free_it_by_default():
    scan = scan_at([0.5, 0.5, 0.0], [2.0])
    assert picture(build_grid([scan], DEFAULTS), Thresholds()) == ["..#"]
    assert picture(build_grid([scan] * 3, DEFAULTS), Thresholds()) == ["oo#"]


def test_a_laser_scan_is_placed_by_its_mount():
    T_base_laser = gtsam.Pose2(1.0, 0.0, math.pi / 2)
    scan = LaserScan(0.0, np.array([2.0], dtype=np.float32), -math.pi / 2, 0.1, 50.0, T_base_laser)
    # The laser stands at 0.5, 1.5 and looks back along x; the beam goes up.
    grid = build_grid([(scan, gtsam.Pose2(0.5, 0.5, math.pi / 2))])
    np.testing.assert_allclose(row_from_pose2(grid.T_map_grid), [0.0, 1.0, 0.0], atol=1e-12)
    assert picture(grid) == ["#", "o", "o"]


def test_points_find_their_cells_in_a_turned_grid():
    grid = OccupancyGrid(np.zeros((4, 6), np.int16), 0.5, gtsam.Pose2(2.0, 1.0, math.pi / 2))
    # One cell along the grid's x is half a metre along the map's y.
    cells = grid.cells_of(np.array([[1.9, 1.1], [1.9, 1.6], [1.4, 1.1], [2.1, 0.9]]))
    assert cells.tolist() == [[0, 0], [0, 1], [1, 0], [-1, -1]]


def test_log_odds_are_kept_to_a_step():
    log_odds = np.array([[3.0, -0.25, 0.0]], np.float32)
    grid = OccupancyGrid.of_log_odds(log_odds, 0.1)
    assert np.array_equal(grid.log_odds, log_odds) and grid.log_odds.dtype == np.float32
    np.testing.assert_allclose(grid.probabilities(), 1.0 / (1.0 + np.exp(-log_odds)), atol=1e-6)


def test_returns_beyond_a_sensors_range_or_the_models_are_no_returns():
    scan, pose = scan_at([0.5, 0.5, 0.0], [9.0])
    near = replace(SETTINGS, lidar=replace(EXACT, max_hit_range_m=5.0, max_clear_range_m=2.0))
    assert picture(build_grid([(scan, pose)], near)) == ["ooo"]
    assert picture(build_grid([(replace(scan, range_max_m=1.0), pose)])) == ["oo"]


def test_growing_keeps_what_was_there_until_only_a_lost_pose_can_explain_it():
    builder = LayerBuilder(replace(SETTINGS, max_cells=110))
    builder.add(*scan_at([0.5, 0.5, 0.0], [1.0]))
    before = builder.grid("lidar")
    with pytest.raises(
        ScanweaveError, match=r"cells of 1 m, the limit is 256 x 110: choose a coarser resolution"
    ) as caught:
        builder.add(*scan_at([300.5, 300.5, 0.0], [1.0], stamp=1.0))
    assert "\n" not in str(caught.value)
    assert np.array_equal(builder.grid("lidar").steps, before.steps)
    builder.add(*scan_at([-8.5, -8.5, 0.0], [1.0], stamp=2.0))
    grid = builder.grid("lidar")
    assert grid.shape == (10, 11)
    assert np.array_equal(grid.steps[9:, 9:], before.steps)
    assert np.array_equal(grid.steps[:1, :2], before.steps)


@pytest.mark.parametrize(("most", "side"), [(10_000, 1), (2_500, 2), (1_100, 3), (300, 6)])
def test_a_map_of_too_many_cells_gets_larger_ones_as_the_likeliest_in_them(most: int, side: int):
    """What the fine grid calls occupied is so in the coarse one, and only what is free throughout is free."""
    rng = np.random.default_rng(2)
    whole, small = LayerBuilder(SETTINGS), LayerBuilder(replace(SETTINGS, max_cells=most))
    for n in range(60):
        reading = scan_at([*rng.uniform(-40.0, 40.0, 2), 0.0], rng.uniform(1.0, 8.0, 5), stamp=float(n))
        assert whole.add(*reading) and small.add(*reading)
    fine, coarse = whole.grid("lidar"), small.grid("lidar")
    assert coarse.resolution_m == side * fine.resolution_m and coarse.steps.size <= 1.2 * most
    corner = np.rint([fine.T_map_grid.y(), fine.T_map_grid.x()]).astype(int)
    expected = np.full(coarse.shape, -(2**15), dtype=np.int16)
    placed = np.zeros((side * coarse.shape[0], side * coarse.shape[1]), dtype=np.int16)
    top, left = corner - np.rint([coarse.T_map_grid.y(), coarse.T_map_grid.x()]).astype(int)
    placed[top : top + fine.shape[0], left : left + fine.shape[1]] = fine.steps
    for row, col in np.ndindex(coarse.shape):
        expected[row, col] = placed[side * row : side * row + side, side * col : side * col + side].max()
    np.testing.assert_array_equal(coarse.steps, expected)


def test_what_cannot_be_mapped_is_refused():
    with pytest.raises(ScanweaveError, match="no reading"):
        build_grid([])
    for bad in (np.nan, np.inf, 1e300):
        with pytest.raises(ScanweaveError, match="pose is lost"):
            build_grid([scan_at([0.0, bad, 0.0], [1.0])])
    empty = build_grid([scan_at([0.5, 0.5, 0.0], [np.nan])])
    assert picture(empty) == ["."]


def test_bounds_out_of_order_are_refused():
    with pytest.raises(ConfigError, match="0 < free_below <= occupied_above < 1"):
        Thresholds(occupied_above=0.3, free_below=0.4)
