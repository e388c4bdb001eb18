import math

import gtsam
import numpy as np
import pytest

from slam.errors import ConfigError, ScanweaveError
from slam.mapping.occupancy_grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    GridBuilder,
    InverseSensorModel,
    OccupancyGrid,
    PosedScan,
    build_grid,
)
from slam.measurements import LaserScan, row_from_pose2

MODEL = InverseSensorModel(p_hit=0.7, p_miss=0.4, p_min=0.01, p_max=0.99, max_clear_range_m=3.0)
LETTERS = {UNKNOWN: ".", FREE: "o", OCCUPIED: "#"}


def scan_at(pose, ranges, start=0.0, step=math.pi / 2):
    return PosedScan(np.array(pose, dtype=float), np.array(ranges, dtype=np.float32), start, step, 50.0)


def picture(grid, **bounds):
    """The states as text, the highest row first."""
    return ["".join(LETTERS[int(state)] for state in row) for row in grid.states(**bounds)[::-1]]


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
    grid = build_grid([scan_at([x + 0.5, y + 0.5, 0.0], [2.0, 1.0, 3.0, np.inf])], 1.0, MODEL)
    assert picture(grid, occupied_above=0.5, free_below=0.5) == [
        "...#..",
        "#oooo#",
        "...o..",
        "...o..",
        "...o..",
    ]
    np.testing.assert_allclose(row_from_pose2(grid.T_map_grid), [x - 3.0, y - 3.0, 0.0], atol=1e-12)
    hit, miss = MODEL.evidence()
    assert grid.log_odds[3, 5] == np.float32(hit)
    assert grid.log_odds[3, 4] == np.float32(miss)
    assert grid.probabilities()[3, 5] == pytest.approx(0.7, abs=1e-3)
    assert grid.probabilities()[3, 4] == pytest.approx(0.4, abs=1e-3)
    assert grid.probabilities()[0, 0] == 0.5


def test_a_turned_laser_sees_the_same_room():
    straight = build_grid([scan_at([0.5, 0.5, 0.0], [2.0, 1.0, 3.0, np.inf])], 1.0, MODEL)
    turned = build_grid([scan_at([0.5, 0.5, math.pi / 2], [1.0, 3.0, np.inf, 2.0])], 1.0, MODEL)
    mounted = build_grid([scan_at([0.5, 0.5, 0.0], [1.0, 3.0, np.inf, 2.0], start=math.pi / 2)], 1.0, MODEL)
    assert picture(straight) == picture(turned) == picture(mounted)


def test_a_map_moved_with_its_axes_holds_the_same_cells():
    scans = random_scans(np.random.default_rng(2))
    grid = build_grid(scans, 0.25, MODEL)
    # The lattice turned about its origin and moved by whole cells: the same cells elsewhere.
    T_moved_map = gtsam.Pose2(0.0, 0.0, 0.7).compose(gtsam.Pose2(5.0, -3.25, 0.0))
    moved = [
        scan._replace(pose_xyt=row_from_pose2(T_moved_map.compose(gtsam.Pose2(*scan.pose_xyt))))
        for scan in scans
    ]
    other = build_grid(moved, 0.25, MODEL, axes_yaw_rad=0.7)
    assert other.T_map_grid.equals(T_moved_map.compose(grid.T_map_grid), 1e-9)
    assert other.log_odds.shape == grid.log_odds.shape
    # A beam that ends on the very border of a cell may fall to either side after the move.
    assert np.mean(other.log_odds != grid.log_odds) < 1e-3


def test_the_order_of_the_scans_does_not_matter_to_the_last_bit():
    rng = np.random.default_rng(3)
    scans = random_scans(rng, count=40)
    grid = build_grid(scans, 0.2, MODEL)
    for _ in range(3):
        rng.shuffle(scans)
        again = build_grid(iter(scans), 0.2, MODEL)
        assert np.array_equal(again.log_odds, grid.log_odds)
        assert again.T_map_grid.equals(grid.T_map_grid, 0.0)


def test_evidence_adds_up_and_is_clamped_at_the_end():
    hit = scan_at([0.5, 0.5, 0.0], [2.0])
    passed = scan_at([0.5, 0.5, 0.0], [3.0])
    once, miss = MODEL.evidence()
    assert (
        build_grid([hit] * 3, 1.0, MODEL).log_odds[0].tolist()
        == np.float32([3 * miss, 3 * miss, 3 * once]).tolist()
    )
    many = build_grid([hit] * 100, 1.0, MODEL)
    np.testing.assert_allclose(many.probabilities()[0], [0.01, 0.01, 0.99], atol=1e-4)
    # A hundred hits weigh more than a hundred misses, though both would have met a bound on the way.
    both = build_grid([hit] * 100 + [passed] * 100, 1.0, MODEL)
    assert both.probabilities()[0, 2] == pytest.approx(0.99, abs=1e-4)


def test_two_misses_free_a_cell_and_one_hit_marks_it_by_default():
    scan = scan_at([0.5, 0.5, 0.0], [2.0])
    assert picture(build_grid([scan], 1.0)) == ["..#"]
    assert picture(build_grid([scan] * 2, 1.0)) == ["oo#"]


def test_a_laser_scan_is_placed_by_its_mount():
    T_base_laser = gtsam.Pose2(1.0, 0.0, math.pi / 2)
    scan = LaserScan(0.0, np.array([2.0], dtype=np.float32), -math.pi / 2, 0.1, 50.0, T_base_laser)
    posed = PosedScan.of(scan, gtsam.Pose2(0.5, 0.5, math.pi / 2))
    np.testing.assert_allclose(posed.pose_xyt, [0.5, 1.5, math.pi], atol=1e-12)
    grid = build_grid([posed], 1.0, MODEL)
    np.testing.assert_allclose(row_from_pose2(grid.T_map_grid), [0.0, 1.0, 0.0], atol=1e-12)
    assert picture(grid, occupied_above=0.5, free_below=0.5) == ["#", "o", "o"]


def test_points_find_their_cells_in_a_turned_grid():
    grid = OccupancyGrid(np.zeros((4, 6), np.float32), 0.5, gtsam.Pose2(2.0, 1.0, math.pi / 2))
    # One cell along the grid's x is half a metre along the map's y.
    cells = grid.cells_of(np.array([[1.9, 1.1], [1.9, 1.6], [1.4, 1.1], [2.1, 0.9]]))
    assert cells.tolist() == [[0, 0], [0, 1], [1, 0], [-1, -1]]


def test_returns_beyond_a_sensors_range_or_the_models_are_no_returns():
    scan = scan_at([0.5, 0.5, 0.0], [9.0])
    near = InverseSensorModel(max_hit_range_m=5.0, max_clear_range_m=2.0)
    assert picture(build_grid([scan], 1.0, near), occupied_above=0.5, free_below=0.5) == ["ooo"]
    short = scan._replace(range_max_m=1.0)
    assert picture(build_grid([short], 1.0, MODEL), occupied_above=0.5, free_below=0.5) == ["oo"]


def test_growing_keeps_what_was_there_and_costs_no_more_cells_than_allowed():
    builder = GridBuilder(1.0, MODEL, max_cells=110)
    builder.add(scan_at([0.5, 0.5, 0.0], [1.0]))
    before = builder.finish()
    with pytest.raises(
        ScanweaveError, match=r"cells of 1 m, the limit is 110: choose a coarser resolution"
    ) as caught:
        builder.add(scan_at([30.5, 30.5, 0.0], [1.0]))
    assert "\n" not in str(caught.value)
    assert np.array_equal(builder.finish().log_odds, before.log_odds)
    builder.add(scan_at([-8.5, -8.5, 0.0], [1.0]))
    grid = builder.finish()
    assert grid.log_odds.shape == (10, 11)
    assert np.array_equal(grid.log_odds[9:, 9:], before.log_odds)
    assert np.array_equal(grid.log_odds[:1, :2], before.log_odds)


def test_what_cannot_be_mapped_is_refused():
    with pytest.raises(ScanweaveError, match="no scan"):
        build_grid([], 0.05)
    for bad in (np.nan, np.inf, 1e300):
        with pytest.raises(ScanweaveError, match="not finite"):
            build_grid([scan_at([0.0, bad, 0.0], [1.0])], 0.05)
    for resolution in (0.0, -0.05, np.nan, np.inf):
        with pytest.raises(ConfigError, match="resolution_m"):
            build_grid([], resolution)
    empty = build_grid([scan_at([0.5, 0.5, 0.0], [np.nan])], 1.0)
    assert picture(empty) == ["."]


@pytest.mark.parametrize(
    "fields",
    [
        {"p_hit": 0.5},
        {"p_miss": 0.5},
        {"p_hit": 0.4, "p_miss": 0.7},
        {"p_min": 0.45},
        {"p_max": 1.0},
        {"p_hit": math.nan},
        {"max_clear_range_m": math.inf},
        {"max_clear_range_m": -1.0},
        {"max_hit_range_m": 0.0},
    ],
)
def test_a_senseless_sensor_model_is_refused(fields):
    with pytest.raises(ConfigError, match=next(iter(fields))):
        InverseSensorModel(**fields)


def test_bounds_out_of_order_are_refused():
    grid = OccupancyGrid(np.zeros((1, 1), np.float32), 1.0)
    with pytest.raises(ConfigError, match="out of order"):
        grid.states(occupied_above=0.3, free_below=0.4)
