"""Tours of generated homes: all rooms, no collision, within the limits, and back."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from slam.errors import ConfigError
from slam.simulation.home import generate_home
from slam.simulation.steering import STEP_S, DriveLimits
from slam.simulation.tour import Tour, drivable_floor, plan_tour
from slam.simulation.true_grid import true_grid

RADIUS_M, HEIGHT_M = 0.2, 1.1
HOMES = [("home", 0), ("home", 3), ("home", 11), ("office", 1)]


@cache
def tour_of(kind: str, seed: int) -> Tour:
    return plan_tour(generate_home(seed, kind), RADIUS_M, HEIGHT_M, seed)


@pytest.mark.parametrize(("kind", "seed"), HOMES)
def test_every_room_is_visited_and_nothing_is_touched(kind: str, seed: int) -> None:
    home, tour = generate_home(seed, kind), tour_of(kind, seed)
    assert sorted(tour.rooms) == sorted(room.name for room in home.rooms)
    # A finer grid than the planner's, and the distance to occupied cells by brute force.
    grid = true_grid(home, 0.012, HEIGHT_M, 0.025)
    occupied = np.argwhere(grid.occupied)[:, ::-1] * 0.025 + 0.0125 + np.array(grid.origin_xy)
    places = tour.poses_xyt[::25, :2]
    nearest = min(np.linalg.norm(occupied - place, axis=1).min() for place in places)
    assert nearest >= RADIUS_M - 0.02
    assert tour.clearance_m >= RADIUS_M


@pytest.mark.parametrize(("kind", "seed"), HOMES)
def test_the_robot_keeps_its_limits(kind: str, seed: int) -> None:
    tour, limits = tour_of(kind, seed), DriveLimits()
    assert (
        np.abs(tour.twists).max(axis=0) <= [limits.speed_m_s + 1e-12, limits.turn_rate_rad_s + 1e-12]
    ).all()
    change = np.abs(np.diff(tour.twists, axis=0)).max(axis=0) / STEP_S
    assert (change <= [limits.acceleration_m_s2 + 1e-9, limits.turn_acceleration_rad_s2 + 1e-9]).all()
    # It drives; it does not creep.
    assert tour.twists[:, 0].mean() > 0.15


@pytest.mark.parametrize(("kind", "seed"), HOMES)
def test_the_end_repeats_the_beginning(kind: str, seed: int) -> None:
    tour = tour_of(kind, seed)
    assert tour.lap_s < tour.duration_s - 5.0
    first = tour.poses_xyt[: int(10.0 / STEP_S)]
    last = tour.poses_at(np.arange(tour.lap_s, tour.duration_s, 0.1))
    # Where the robot went at first it is again at the end, looking the same way: a loop that closes.
    distance = np.linalg.norm(first[::10, None, :2] - last[None, :, :2], axis=2)
    turn = np.abs(np.angle(np.exp(1j * (first[::10, None, 2] - last[None, :, 2]))))
    met = ((distance < 0.3) & (turn < 0.5)).any(axis=1)
    assert met.mean() > 0.4


def test_poses_between_the_steps_lie_on_the_arc() -> None:
    tour = tour_of("home", 0)
    for time_s in (3.0, 10.01, 25.37):
        before, after = tour.pose_at(time_s - 1e-4), tour.pose_at(time_s + 1e-4)
        speed, turn = tour.twists[int(time_s / STEP_S)]
        assert math.dist(before[:2], after[:2]) / 2e-4 == pytest.approx(speed, abs=0.02)
        assert (after[2] - before[2]) / 2e-4 == pytest.approx(turn, abs=0.04)
    assert tour.pose_at(-1.0) == tuple(tour.poses_xyt[0])
    assert tour.pose_at(1e9) == pytest.approx(tuple(tour.poses_xyt[-1]))


def test_a_short_drive_is_a_cut_tour_and_a_long_one_more_laps() -> None:
    home, whole = generate_home(0), tour_of("home", 0)
    short = plan_tour(home, RADIUS_M, HEIGHT_M, 0, 20.0)
    assert short.duration_s == 20.0
    assert np.allclose(short.poses_xyt[:900], whole.poses_xyt[:900])
    assert math.isinf(short.lap_s)
    # Two minutes are not enough for all rooms: some are left out, and the robot comes back.
    medium = plan_tour(home, RADIUS_M, HEIGHT_M, 0, 120.0)
    assert medium.lap_s < 120.0
    assert 2 <= len(medium.rooms) < len(whole.rooms)
    long = plan_tour(home, RADIUS_M, HEIGHT_M, 0, 1.5 * whole.duration_s)
    assert long.duration_s == 1.5 * whole.duration_s
    assert long.twists[-1, 0] > 0.0 or long.twists[-1, 1] != 0.0
    assert long.clearance_m >= RADIUS_M


def test_the_seed_decides_the_order_and_nothing_else_does() -> None:
    home = generate_home(0)
    again = plan_tour(home, RADIUS_M, HEIGHT_M, 0)
    assert again.poses_xyt.tobytes() == tour_of("home", 0).poses_xyt.tobytes()
    assert plan_tour(home, RADIUS_M, HEIGHT_M, 1).poses_xyt.tobytes() != again.poses_xyt.tobytes()


def test_what_cannot_be_driven_is_refused() -> None:
    home = generate_home(0)
    with pytest.raises(ConfigError, match="smaller robot"):
        plan_tour(home, 30.0, HEIGHT_M, 0)
    for duration_s in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="duration_s"):
            plan_tour(home, RADIUS_M, HEIGHT_M, 0, duration_s)


def test_a_robot_lower_than_a_table_has_more_floor() -> None:
    home = generate_home(0)
    low, high = (drivable_floor(home, RADIUS_M, height).nodes.max() for height in (0.3, 1.1))
    assert low > high
