import math

import gtsam
import numpy as np
import pytest

from slam.errors import ScanweaveError
from slam.evaluation.figure_parts import plan_picture
from slam.mapping.navigation import clearance_m, free_space, shortest_path
from slam.mapping.occupancy_grid import FREE, OCCUPIED, UNKNOWN

STATE = {"#": OCCUPIED, "o": FREE, ".": UNKNOWN}


def drawn(*rows):
    return np.array([[STATE[cell] for cell in row] for row in rows[::-1]], dtype=np.int8)


def planned(states, start, goal, radius=0.0, T=None):
    T = T or gtsam.Pose2()
    return shortest_path(free_space(states, 1.0, T, radius), start, goal)


def test_room_is_by_the_distance_to_the_obstacle_s_edge():
    states = np.full((9, 9), FREE, dtype=np.int8)
    states[4, 4] = OCCUPIED
    states[0, 0] = UNKNOWN
    clear = clearance_m(states, 0.1)
    assert clear[4, 6] == pytest.approx(0.15)
    assert clear[6, 6] == pytest.approx(0.1 * (math.sqrt(8) - 0.5))
    allowed = free_space(states, 0.1, gtsam.Pose2(), 0.16).allowed
    assert (~allowed).sum() == 14
    assert not allowed[0, 0]
    assert free_space(np.zeros((3, 3), np.int8), 0.1, gtsam.Pose2(), 5.0).allowed.all()


def test_the_shortest_path_goes_round_and_cuts_no_corner():
    states = drawn("ooooo", "o###o", "ooo#o", "###oo", "ooooo")
    path = planned(states, (1.5, 2.5), (3.5, 1.5))
    # Diagonal from (1.5, 2.5) to (3.5, 1.5) would squeeze between two corners: it must go all the way round.
    steps = np.abs(np.diff(path.points_map, axis=0))
    assert path.length_m == pytest.approx(np.hypot(*steps.T).sum())
    assert path.length_m == pytest.approx(11.0)
    assert path.points_map[0].tolist() == [1.5, 2.5]
    assert path.points_map[-1].tolist() == [3.5, 1.5]
    open_floor = np.zeros((30, 40), dtype=np.int8)
    assert planned(open_floor, (0.5, 0.5), (20.5, 10.5)).length_m == pytest.approx(10 + 10 * math.sqrt(2))


def test_parts_that_touch_at_a_corner_only_are_apart():
    states = drawn("o#", "#o")
    assert free_space(states, 1.0, gtsam.Pose2(), 0.0).region.max() == 2
    assert planned(states, (1.5, 0.5), (0.5, 1.5)) is None
    # The unknown is no way either.
    assert planned(drawn("o.o"), (0.5, 0.5), (2.5, 0.5)) is None


def test_a_wide_robot_takes_the_wide_door():
    rows = ["o" * 21] * 20
    rows[10] = "###o" + "#" * 10 + "oooooo#"
    states = drawn(*rows)
    narrow, wide = (planned(states, (3.5, 2.5), (3.5, 17.5), radius) for radius in (0.0, 2.0))
    assert narrow.length_m == pytest.approx(15.0)
    assert wide.length_m > 25.0
    assert wide.clearance_m >= 2.0
    assert planned(states, (3.5, 2.5), (3.5, 17.5), 4.0) is None


def test_a_way_stays_off_the_unknown_where_that_costs_little():
    rows = ["o" * 21] * 11
    rows[6] = "o" * 8 + "....." + "o" * 8
    states = drawn(*rows)
    # Straight on it would touch the unknown; it gives way by its radius, and comes back.
    path = planned(states, (1.5, 5.5), (19.5, 5.5), 2.0)
    beside = path.points_map[(path.points_map[:, 0] > 9.0) & (path.points_map[:, 0] < 12.0)]
    assert beside[:, 1].min() >= 7.0
    assert path.length_m < 18.0 + 4.0 * math.sqrt(2.0)
    # What is known but for one way is taken all the same, and where all is known the way is straight.
    narrow = drawn(".....", "ooooo", ".....")
    assert planned(narrow, (0.5, 1.5), (4.5, 1.5), 2.0).length_m == pytest.approx(4.0)
    rows[6] = rows[0]
    assert planned(drawn(*rows), (1.5, 5.5), (19.5, 5.5), 2.0).length_m == pytest.approx(18.0)
    # Beyond the edge of the map nothing is known.
    assert planned(drawn(*rows), (1.5, 0.5), (19.5, 0.5), 2.0).points_map[9, 1] == 2.5


@pytest.mark.parametrize("T", [gtsam.Pose2(5.0, -3.0, 0.0), gtsam.Pose2(-2.0, 7.0, 2.2)])
def test_a_moved_and_turned_map_gives_the_same_path(T):
    states = drawn("ooooo", "o###o", "ooo#o", "###oo", "ooooo")
    ends = [tuple(T.transformFrom(np.array(end))) for end in ((1.5, 2.5), (3.5, 1.5))]
    moved, still = planned(states, *ends, T=T), planned(states, (1.5, 2.5), (3.5, 1.5))
    np.testing.assert_allclose(moved.points_map, [T.transformFrom(p) for p in still.points_map], atol=1e-9)


def test_ends_without_room_are_named():
    states = drawn("oo#", "ooo")
    for start, text in (((9.0, 0.5), "outside"), ((2.5, 1.5), "start 2.5,1.5 is occupied")):
        with pytest.raises(ScanweaveError, match=text):
            planned(states, start, (0.5, 0.5))
    with pytest.raises(ScanweaveError, match="radius"):
        free_space(states, 1.0, gtsam.Pose2(), math.nan)


def test_the_picture_shows_the_path():
    import cv2

    states = np.full((60, 90), FREE, dtype=np.int8)
    states[:, 45] = OCCUPIED
    states[50:55, 45] = FREE
    space = free_space(states, 0.05, gtsam.Pose2(), 0.05)
    path = shortest_path(space, (0.5, 0.5), (4.0, 0.5))
    picture = cv2.imdecode(np.frombuffer(plan_picture(states, space, path), np.uint8), cv2.IMREAD_COLOR_RGB)
    blue = (picture.astype(int) - [0x25, 0x63, 0xB8]).any(axis=2) == 0
    assert blue.sum() > 1000
    assert picture.shape[1] == 1000
