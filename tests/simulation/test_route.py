"""Planning on tiny hand-drawn floors."""

from __future__ import annotations

import numpy as np
import pytest

from slam.simulation.route import cheapest_paths, floor_map, resample, smooth_path

ORIGIN = (-3.0, 5.0)


def drawn(*lines: str) -> np.ndarray:
    """Occupied cells, the first line at the top, each character a cell."""
    return np.array([[c == "#" for c in line] for line in lines])[::-1]


def test_clearance_is_the_distance_to_the_obstacles_edge() -> None:
    floor = floor_map(drawn("......", "......", "......", "..#...", "......"), 0.1, ORIGIN, 0.05, 0.3)
    # A cell's centre, and the edge of the obstacle two cells to the left of it.
    assert floor.clearance_m[1, 4] == pytest.approx(0.15)
    assert floor.clearance_m[1, 2] == 0.0
    # The edge of the grid is a wall: what lies beyond is not known.
    assert floor.clearance_m[3, 0] == pytest.approx(0.05)
    assert floor.clearance_at_m(np.array([[-2.55, 5.15]]))[0] == pytest.approx(0.15)
    assert floor.clearance_at_m(np.array([[50.0, 50.0]]))[0] == 0.0


def test_the_way_leads_round_a_wall_and_through_the_middle_of_a_gap() -> None:
    blocked = np.zeros((40, 40), dtype=bool)
    blocked[20] = True
    blocked[20, 25:34] = False
    floor = floor_map(blocked, 0.05, ORIGIN, 0.1, 0.3)
    stops = [floor.node_near(np.array([-2.5, 5.4])), floor.node_near(np.array([-2.5, 6.6]))]
    costs, ways = cheapest_paths(floor, stops)
    assert costs[0, 1] == pytest.approx(costs[1, 0])
    way = ways[0][1]
    assert way is not None
    path = floor.centres_m()[way]
    assert path[0] == pytest.approx([-2.5, 5.4], abs=0.04)
    crossing = path[np.argmin(np.abs(path[:, 1] - (5.0 + 20.5 * 0.05)))]
    assert crossing[0] == pytest.approx(-3.0 + 29.5 * 0.05, abs=0.06)
    assert floor.clearance_at_m(path).min() >= 0.1
    smooth = smooth_path(floor, path, 0.02)
    assert floor.clearance_at_m(smooth).min() >= 0.095
    assert np.linalg.norm(np.diff(smooth, axis=0), axis=1).max() < 0.03
    bends = np.abs(np.diff(np.unwrap(np.arctan2(*np.diff(smooth, axis=0).T[::-1]))))
    assert bends.max() < np.radians(20.0)


def test_no_way_through_a_closed_wall() -> None:
    blocked = np.zeros((20, 20), dtype=bool)
    blocked[10] = True
    floor = floor_map(blocked, 0.1, ORIGIN, 0.1, 0.3)
    stops = [floor.node_near(np.array([-2.0, 5.4])), floor.node_near(np.array([-2.0, 6.6]))]
    costs, ways = cheapest_paths(floor, stops)
    assert np.isinf(costs[0, 1])
    assert ways[0][1] is None


def test_a_floor_without_room_has_no_cells() -> None:
    floor = floor_map(np.ones((5, 5), dtype=bool), 0.1, ORIGIN, 0.1, 0.3)
    assert floor.node_near(np.array([0.0, 0.0])) == -1


def test_resampling_keeps_ends_and_length() -> None:
    path = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    even = resample(path, 0.1)
    assert len(even) == 31
    assert even[[0, 10, -1]].tolist() == [[0.0, 0.0], pytest.approx([1.0, 0.0]), [1.0, 2.0]]
