import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from fusion.bayes import FREE, OCCUPIED, STEPS_A_UNIT, UNKNOWN
from fusion.height_band import HeightBand
from slam.config import Config
from slam.errors import ConfigError, ScanweaveError
from slam.mapping.depth_grid import DepthModel
from slam.mapping.evidence_tiles import SIDE, Board, EvidenceTiles
from slam.mapping.keyframe_grid import layer_settings
from slam.mapping.layer_builder import LayerBuilder
from slam.mapping.layered_map import DecisionRule, LayeredMap
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import CameraIntrinsics, LaserScan, RgbdFrame
from tools.layer_building import build_layers

CAMERA = CameraIntrinsics(240.0, 240.0, 159.5, 119.5, 320, 240)
OPTICAL = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
MOUNT = gtsam.Pose3(gtsam.Rot3.Ypr(0.0, math.radians(12.0), 0.0).compose(OPTICAL), np.array([0.0, 0.0, 0.5]))
DEPTH = DepthModel(HeightBand(0.0, 0.5, 0.02), 4.0, least_neighbours=2, voxel_m=0.0, pixel_stride=1)
SETTINGS = replace(layer_settings(Config()), depth=DEPTH, robot_radius_m=0.0)


def scan(stamp=0.0, range_m=2.0, beams=90):
    ranges = np.full(beams, range_m, dtype=np.float32)
    return LaserScan(stamp, ranges, -math.pi, 2 * math.pi / beams, 12.0)


def frame(stamp=0.0, boxes=(), wall_m=3.0, mount=MOUNT):
    """A floor, a wall across at x = wall_m, and boxes (x0, x1, y0, y1, z0, z1), seen by exact ray casting."""
    u, v = np.meshgrid((np.arange(320) - 159.5) / 240.0, (np.arange(240) - 119.5) / 240.0)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ mount.rotation().matrix().T
    start = mount.translation()
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(rays[:, 2] < 0, -start[2] / rays[:, 2], np.inf)
        depth = np.minimum(floor, np.where(rays[:, 0] > 0, (wall_m - start[0]) / rays[:, 0], np.inf))
        for box in boxes:
            low, high = np.array(box[::2]), np.array(box[1::2])
            one, other = (low - start) / rays, (high - start) / rays
            enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
            depth = np.where((enter <= leave) & (enter > 0), np.minimum(depth, enter), depth)
    depth = np.where(depth < 8.0, depth, 0.0).reshape(240, 320).astype(np.float32)
    return RgbdFrame(stamp, np.zeros((240, 320, 3), np.uint8), depth, CAMERA, mount)


def state(built, name, x, y):
    row, col = built.grid("fused").cells_of(np.array([[x, y]]))[0]
    return built.states(name)[row, col]


def same_base(count):
    return [gtsam.Pose2()] * count


def test_low_and_overhanging_things_are_kept_and_thin_ones_dropped():
    boxes = (
        (1.5, 1.7, -0.6, -0.4, 0.0, 0.10),  # low
        (1.5, 1.7, 0.4, 0.6, 0.30, 0.40),  # hangs inside the band
        (1.2, 1.4, -0.1, 0.1, 0.0, 0.008),  # a mat
        (2.0, 2.4, -0.1, 0.3, 0.6, 0.7),  # above the band
    )
    built = build_layers([frame(float(i), boxes) for i in range(4)], same_base(4), SETTINGS)
    assert state(built, "depth", 1.52, -0.5) == OCCUPIED
    assert state(built, "depth", 1.52, 0.5) == OCCUPIED
    assert state(built, "depth", 1.3, 0.0) == FREE
    assert state(built, "depth", 2.0, 0.1) == FREE
    # Behind the low box the rays pass over: nothing is known.
    assert state(built, "depth", 1.8, -0.55) == UNKNOWN
    # Beside the view, and under the camera, neither.
    assert state(built, "depth", 1.0, 1.5) == UNKNOWN
    assert state(built, "depth", 0.1, 0.0) == UNKNOWN


def test_a_low_box_is_not_cleared_by_what_passes_over_it():
    box = (1.5, 1.7, -0.3, 0.3, 0.0, 0.10)
    seen = [frame(0.0, (box,))]
    # The camera turned up so that only rays over the box are left.
    up = gtsam.Pose3(gtsam.Rot3.Ypr(0.0, math.radians(-20.0), 0.0).compose(OPTICAL), MOUNT.translation())
    over = [frame(1.0 + i, (box,), mount=up) for i in range(8)]
    built = build_layers(seen + over, same_base(9), SETTINGS)
    assert state(built, "depth", 1.52, 0.0) == OCCUPIED


def test_what_has_gone_fades_and_the_lidar_keeps_what_it_sees():
    person = (1.5, 1.7, -0.2, 0.2, 0.0, 1.5)
    gone = [frame(0.0, (person,)), *(frame(1.0 + i) for i in range(8))]
    built = build_layers(gone, same_base(9), SETTINGS)
    assert state(built, "depth", 1.52, 0.0) == FREE
    built = build_layers([*gone, scan(50.0, 1.52), scan(51.0, 1.52)], same_base(11), SETTINGS)
    assert state(built, "decision", 1.52, 0.0) == OCCUPIED


def test_one_missing_sensor_is_unknown_and_the_map_stands():
    only_lidar = build_layers([scan(float(i)) for i in range(3)], same_base(3), SETTINGS)
    assert only_lidar.depth is None
    np.testing.assert_array_equal(only_lidar.states("decision"), only_lidar.states("lidar"))
    assert (only_lidar.states("decision") == FREE).any() and not only_lidar.free_at_lidar_height().any()
    assert (only_lidar.states("depth") == UNKNOWN).all()
    only_depth = build_layers([frame()], same_base(1), SETTINGS)
    assert only_depth.lidar is None
    np.testing.assert_array_equal(only_depth.states("decision"), only_depth.states("depth"))
    with pytest.raises(ScanweaveError, match="no reading"):
        build_layers([], [], SETTINGS)


def test_order_partial_maps_and_repeats_change_nothing():
    rng = np.random.default_rng(1)
    boxes = ((1.5, 1.7, -0.6, -0.4, 0.0, 0.10),)
    readings = [scan(float(i), rng.uniform(1, 5)) for i in range(6)]
    readings += [frame(float(i), boxes, rng.uniform(2, 4)) for i in range(6)]
    poses = [gtsam.Pose2(*rng.uniform([-9, -9, -3], [9, 9, 3])) for _ in readings]
    whole = build_layers(readings, poses, SETTINGS)
    for order in (rng.permutation(12), np.arange(12)[::-1]):
        other = build_layers([readings[i] for i in order], [poses[i] for i in order], SETTINGS)
        np.testing.assert_array_equal(other.lidar.steps, whole.lidar.steps)
        np.testing.assert_array_equal(other.depth.steps, whole.depth.steps)
        assert other.T_map_grid.equals(whole.T_map_grid, 1e-12)
    twice = build_layers(readings + readings, poses + poses, SETTINGS)
    np.testing.assert_array_equal(twice.depth.steps, whole.depth.steps)
    np.testing.assert_array_equal(twice.lidar.steps, whole.lidar.steps)


def test_tiles_on_disk_hold_the_same_sums():
    rng = np.random.default_rng(2)
    boards = [
        Board(rng.integers(-900, 900, (90, 70)).astype(np.int16), *map(int, rng.integers(-1500, 1500, 2)))
        for _ in range(60)
    ]
    small, large = (EvidenceTiles(mb) for mb in (0.1, 500.0))
    for board in boards:
        small.add(board)
        large.add(board)
    box = (-1500 - SIDE, -1500, 3500, 3400)
    expected = large.clipped(box, -4000, 4000)
    assert np.abs(expected).max() > 800
    np.testing.assert_array_equal(small.clipped(box, -4000, 4000), expected)
    assert small.used == large.used


# Hand-drawn grids: a letter a cell, the highest row first.
LETTER = {"#": 2 * STEPS_A_UNIT, "o": -2 * STEPS_A_UNIT, ".": 0}
SIGN = {OCCUPIED: "#", FREE: "o", UNKNOWN: "."}


def drawn(*rows):
    return np.array([[LETTER[cell] for cell in row] for row in rows[::-1]], dtype=np.int16)


def laid(steps, yaw, row=-40, col=20):
    """A grid whose corner is that row and column of the lattice."""
    corner = gtsam.Pose2(0.0, 0.0, yaw).compose(gtsam.Pose2(0.05 * col, 0.05 * row, 0.0))
    return OccupancyGrid(steps, 0.05, corner)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_the_table_on_hand_drawn_grids(yaw):
    lidar, depth = drawn("###", "ooo", "..."), drawn("#o.", "#o.", "#o.")
    built = LayeredMap(laid(lidar, yaw), laid(depth, yaw))

    def picture(name, made=built):
        return ["".join(SIGN[int(cell)] for cell in row) for row in made.states(name)[::-1]]

    assert picture("decision") == ["###", "#o.", "#o."]
    assert (built.free_at_lidar_height() == (drawn("...", "..o", "...") < 0)).all()
    corrected = replace(built, rule=DecisionRule("corrected"))
    assert picture("decision", corrected) == ["###", "#oo", "#o."]
    printed = replace(built, rule=DecisionRule("printed"))
    assert picture("decision", printed) == ["###", "#oo", "o#."]
    # Eq. (10): what contradicts itself is uncertain.
    assert picture("fused") == ["#.#", ".oo", "#o."]
    at = built.T_map_grid.transformFrom(np.array([0.075, 0.125]))
    assert built.grid("fused").cells_of(at[None])[0].tolist() == [2, 1]


@pytest.mark.parametrize("yaw", [0.0, -0.7])
def test_grids_of_different_sizes_are_laid_on_one_lattice(yaw):
    built = LayeredMap(laid(drawn("##", "oo"), yaw, 5, -3), laid(drawn("#", "#", "o"), yaw, 3, 0))
    assert built.box == (3, -3, 4, 4)

    def picture(name):
        return ["".join(SIGN[int(cell)] for cell in row) for row in built.states(name)[::-1]]

    assert picture("lidar") == ["##..", "oo..", "....", "...."]
    assert picture("depth") == ["....", "...#", "...#", "...o"]
    assert picture("decision") == ["##..", "...#", "...#", "...o"]
    assert built.grid("lidar").T_map_grid.equals(laid(drawn("#"), yaw, 3, -3).T_map_grid, 1e-12)
    for other in (laid(drawn("#"), yaw, 3.4, 0), laid(drawn("#"), yaw + 0.1, 3, 0)):
        with pytest.raises(ScanweaveError, match="misaligned cells"):
            LayeredMap(built.lidar, other)


def test_two_logs_whose_clocks_agree_count_both():
    one = build_layers([scan()], same_base(1), SETTINGS)
    both = build_layers([scan(), scan()], [gtsam.Pose2(), gtsam.Pose2(0.001, 0.0, 0.0)], SETTINGS)
    assert both.lidar.steps.max() > 1.5 * one.lidar.steps.max()


def test_the_grid_holds_the_world():
    wall = [scan(float(i), 2.0, 720) for i in range(3)]
    built = build_layers(wall, same_base(3), SETTINGS)
    bearings = np.linspace(-3, 3, 50)
    ring = np.column_stack([np.cos(bearings), np.sin(bearings)])
    for radius, expected in ((2.0, OCCUPIED), (1.8, FREE), (0.5, FREE)):
        rows, cols = built.grid("lidar").cells_of(radius * ring).T
        assert (built.states("lidar")[rows, cols] == expected).mean() > 0.9


def test_a_far_hit_weighs_less_and_bad_input_is_refused():
    near, far = (build_layers([scan(0.0, r)], same_base(1), SETTINGS).lidar.steps.max() for r in (1.0, 11.0))
    assert 0 < far < near
    builder = LayerBuilder(SETTINGS)
    with pytest.raises(ScanweaveError, match="its pose is lost"):
        builder.add(scan(), gtsam.Pose2(math.nan, 0, 0))
    with pytest.raises(ScanweaveError, match="no known mounting"):
        builder.add(replace(frame(), T_base_camera=None), gtsam.Pose2())
    with pytest.raises(ScanweaveError, match="the limit"):
        LayerBuilder(replace(SETTINGS, max_cells=4)).add(scan(), gtsam.Pose2())
    with pytest.raises(ScanweaveError, match="1 keyframes for 2 poses"):
        build_layers([scan()], same_base(2), SETTINGS)
    with pytest.raises(ScanweaveError, match="more keyframes"):
        build_layers([scan(), scan(1.0)], same_base(1), SETTINGS)
    with pytest.raises(ConfigError, match="a cell must be larger"):
        build_layers([frame()], same_base(1), replace(SETTINGS, resolution_m=0.03))
    assert builder.add(scan(), gtsam.Pose2())
    assert not builder.add(scan(), gtsam.Pose2())


def test_an_image_without_readings_says_nothing():
    empty = replace(frame(), depth_m=np.zeros((240, 320), np.float32))
    built = build_layers([empty, scan()], same_base(2), SETTINGS)
    assert built.depth is None and built.lidar is not None


def test_a_sensor_that_dies_half_way_leaves_the_other_to_map_on():
    scans, frames = [scan(float(i), 2.0) for i in range(3)], [frame(10.0 + i) for i in range(3)]
    far = gtsam.Pose2(20.0, 0.0, 0.0)
    built = build_layers([*scans, *frames], same_base(3) + [far] * 3, SETTINGS)
    assert state(built, "decision", 1.0, 0.0) == UNKNOWN  # no camera saw it
    assert state(replace(built, rule=DecisionRule("corrected")), "decision", 1.0, 0.0) == FREE
    assert built.free_at_lidar_height()[tuple(built.grid("fused").cells_of(np.array([[1.0, 0.0]]))[0])]
    assert state(built, "decision", 22.98, 0.0) == OCCUPIED
    assert state(built, "lidar", 22.98, 0.0) == UNKNOWN


def test_what_stood_where_the_robot_passes_has_gone():
    walker = (1.4, 1.6, -0.1, 0.1, 0.0, 0.5)
    beside = (1.4, 1.6, 0.4, 0.6, 0.0, 0.5)
    readings = [frame(0.0, boxes=(walker, beside)), frame(1.0), frame(2.0)]
    poses = [gtsam.Pose2(), gtsam.Pose2(1.45, 0.0, 0.1), gtsam.Pose2(1.6, 0.0, 0.1)]
    there = build_layers(readings, poses, SETTINGS)
    gone = build_layers(readings, poses, replace(SETTINGS, robot_radius_m=0.2))
    for x in (1.41, 1.44):
        assert state(there, "decision", x, 0.0) == OCCUPIED
        assert state(gone, "decision", x, 0.0) != OCCUPIED
    assert state(gone, "decision", 1.41, 0.5) == state(there, "decision", 1.41, 0.5) == OCCUPIED


def test_a_robot_smaller_than_a_cell_clears_nothing():
    readings, poses = [frame()], same_base(1)
    thin = build_layers(readings, poses, replace(SETTINGS, robot_radius_m=0.03))
    np.testing.assert_array_equal(
        thin.states("depth"), build_layers(readings, poses, SETTINGS).states("depth")
    )
