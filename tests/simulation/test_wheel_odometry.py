"""The wheels: exact without errors, drifting by their model with them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.simulation.steering import advance
from slam.simulation.wheel_odometry import WheelModel, dead_reckoning, wheel_readings, wheel_travel

PERFECT = WheelModel(scale_sigma=0.0, wheel_base_sigma=0.0, noise=0.0, slips_per_s=0.0)


def arcs(count: int, speed: float, turn: float, rate_hz: float = 20.0) -> np.ndarray:
    poses = [(0.0, 0.0, 0.0)]
    for _ in range(count):
        poses.append(advance(*poses[-1], speed, turn, 1.0 / rate_hz))
    return np.array(poses)


@pytest.mark.parametrize(("speed", "turn"), [(0.5, 0.0), (0.4, 0.7), (0.0, -0.8), (0.3, -1e-9)])
def test_perfect_wheels_show_the_truth(speed: float, turn: float) -> None:
    poses = arcs(200, speed, turn)
    read = wheel_readings(PERFECT, poses, np.random.default_rng(0))
    assert np.allclose(read.poses_xyt[:, :2], poses[:, :2], atol=1e-9)
    assert np.allclose(np.exp(1j * read.poses_xyt[:, 2]), np.exp(1j * poses[:, 2]), atol=1e-9)
    assert np.allclose(read.twists[1:], [speed, turn], atol=1e-9)
    assert not read.slipping.any()


def test_odometry_begins_at_zero_wherever_the_robot_does() -> None:
    poses = arcs(100, 0.4, 0.3)
    turned = poses + np.array([3.0, -2.0, 1.2])
    cos, sin = math.cos(1.2), math.sin(1.2)
    turned[:, :2] = poses[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + [3.0, -2.0]
    read = wheel_readings(PERFECT, turned, np.random.default_rng(0))
    assert np.allclose(read.poses_xyt[:, :2], poses[:, :2], atol=1e-9)


def test_travel_and_dead_reckoning_undo_each_other() -> None:
    travel = np.random.default_rng(3).uniform(-0.02, 0.03, (50, 2))
    assert np.allclose(wheel_travel(dead_reckoning(travel, 0.4), 0.4), travel, atol=1e-12)


def test_scales_spread_the_length_and_the_yaw_as_stated() -> None:
    # A straight 10 m: length error = mean of two scales, yaw error = their difference * 10 m / base.
    model = WheelModel(scale_sigma=0.006, wheel_base_sigma=0.0, noise=0.0, slips_per_s=0.0)
    poses = arcs(400, 0.5, 0.0)
    yaws, lengths = [], []
    for seed in range(400):
        read = wheel_readings(model, poses, np.random.default_rng(seed))
        lengths.append(read.twists[1:, 0].sum() / model.rate_hz - 10.0)
        yaws.append(read.twists[1:, 1].sum() / model.rate_hz)
    assert np.std(lengths) == pytest.approx(10.0 * 0.006 / math.sqrt(2.0), rel=0.12)
    assert np.std(yaws) == pytest.approx(10.0 * 0.006 * math.sqrt(2.0) / model.wheel_base_m, rel=0.12)
    assert abs(np.mean(lengths)) < 3.0 * np.std(lengths) / 20.0


def test_noise_grows_with_the_root_of_the_way() -> None:
    model = WheelModel(scale_sigma=0.0, wheel_base_sigma=0.0, noise=0.004, slips_per_s=0.0)
    spreads = []
    for steps in (100, 400):
        poses = arcs(steps, 0.5, 0.0)
        ends = [
            wheel_readings(model, poses, np.random.default_rng(seed)).twists[1:, 0].sum() / model.rate_hz
            for seed in range(300)
        ]
        spreads.append(np.std(ends))
    assert spreads[0] == pytest.approx(0.004 * math.sqrt(2.5 / 2.0), rel=0.15)
    assert spreads[1] / spreads[0] == pytest.approx(2.0, rel=0.2)


def test_slip_is_marked_where_it_bends_the_path_and_nowhere_else() -> None:
    model = WheelModel(scale_sigma=0.0, wheel_base_sigma=0.0, noise=0.0, slips_per_s=0.1)
    poses = arcs(4000, 0.4, 0.1)
    read = wheel_readings(model, poses, np.random.default_rng(5))
    off = np.abs(read.twists[1:] - [0.4, 0.1]).max(axis=1) > 1e-9
    assert (off == read.slipping[1:].any(axis=1)).all()
    # 0.1 slips a second of 0.5 s each: about 5 % of the time, the wheels alike.
    assert 0.02 < off.mean() < 0.10
    assert read.slipping.any(axis=0).all()
    # A spinning wheel shows more than it rolled, never less.
    assert read.twists[1:, 0].min() > 0.4 - 1e-9


def test_a_standing_robot_neither_drifts_nor_slips() -> None:
    model = WheelModel(slips_per_s=5.0)
    read = wheel_readings(model, np.tile([1.0, 2.0, 0.5], (200, 1)), np.random.default_rng(0))
    assert np.allclose(read.poses_xyt, 0.0)
    assert not read.slipping.any()


def test_one_pose_and_the_same_seed() -> None:
    assert wheel_readings(PERFECT, np.zeros((1, 3)), np.random.default_rng(0)).poses_xyt.shape == (1, 3)
    poses = arcs(50, 0.5, 0.2)
    first, second = (wheel_readings(WheelModel(), poses, np.random.default_rng(9)) for _ in range(2))
    assert first.poses_xyt.tobytes() == second.poses_xyt.tobytes()
