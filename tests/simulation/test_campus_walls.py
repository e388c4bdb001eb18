"""What bounds areas that overlap, in tiny worlds and turned."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.measurements import FloatArray
from slam.simulation.campus_walls import Corridor, outline, overlapping

MOTIONS = [(0.0, 0.0, 0.0), (3.0, -2.0, 0.3), (-100.0, 50.0, 2.0)]


def area(x0: float, y0: float, x1: float, y1: float, motion: tuple[float, float, float]) -> FloatArray:
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    x, y, angle = motion
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return np.asarray(corners @ turn.T + [x, y])


def length_m(segments: FloatArray) -> float:
    return float(np.linalg.norm(segments[:, 2:] - segments[:, :2], axis=1).sum())


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("way_round", [1, -1])
def test_crossing_corridors_are_open_to_each_other(
    motion: tuple[float, float, float], way_round: int
) -> None:
    along, across = area(0.0, 0.0, 10.0, 2.0, motion), area(4.0, -3.0, 5.0, 5.0, motion)
    walls = outline([along[::way_round], across], [])
    # Each loses twice what lies in the other.
    assert length_m(walls) == pytest.approx(2.0 * (10.0 + 2.0) + 2.0 * (1.0 + 8.0) - 2.0 * 1.0 - 2.0 * 2.0)
    assert len(walls) == 12


@pytest.mark.parametrize("motion", MOTIONS)
def test_windows_take_away_and_bring_no_wall(motion: tuple[float, float, float]) -> None:
    room, window = area(0.0, 0.0, 4.0, 3.0, motion), area(1.0, 2.9, 2.5, 3.1, motion)
    walls = outline([room], [window])
    assert length_m(walls) == pytest.approx(14.0 - 1.5)
    assert len(walls) == 5


def test_areas_side_by_side_keep_the_wall_between() -> None:
    rooms = [area(0.0, 0.0, 2.0, 2.0, MOTIONS[0]), area(2.0, 0.0, 5.0, 2.0, MOTIONS[0])]
    assert length_m(outline(rooms, [])) == pytest.approx(8.0 + 10.0)


def test_an_area_within_another_has_no_walls() -> None:
    walls = outline([area(0.0, 0.0, 9.0, 9.0, MOTIONS[0]), area(2.0, 2.0, 3.0, 3.0, MOTIONS[0])], [])
    assert length_m(walls) == pytest.approx(36.0)


@pytest.mark.parametrize("motion", MOTIONS)
def test_which_areas_meet(motion: tuple[float, float, float]) -> None:
    others = [
        area(2.0, 0.0, 3.0, 1.0, motion),  # touches
        area(1.9, 0.9, 3.0, 3.0, motion),  # a corner in common
        area(-1.0, 0.4, 3.0, 0.6, motion),  # across, no corner inside
        area(0.5, 0.5, 0.6, 0.6, motion),  # inside
        area(-9.0, -9.0, 9.0, 9.0, motion),  # around
        area(0.0, 5.0, 2.0, 6.0, motion),  # away
    ]
    met = overlapping(area(0.0, 0.0, 2.0, 1.0, motion), np.array(others))
    assert met.tolist() == [False, True, True, True, True, False]


@pytest.mark.parametrize(("hand", "expected"), [(1, [2.0, 5.0]), (-1, [4.0, 5.0])])
def test_a_mirrored_corridor_has_its_left_at_its_right(hand: int, expected: list[float]) -> None:
    corridor = Corridor((0, 1), np.array([[3.0, 1.0], [3.0, 9.0]]), 2.0, (), 4.0, hand)
    assert corridor.length_m == 8.0
    assert corridor.box(4.0, 5.0, 1.0, 2.0)[0].tolist() == pytest.approx(expected)
