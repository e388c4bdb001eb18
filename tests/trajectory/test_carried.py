"""Covariances of readings are those of the keyframes at them, between by both, and past the ends grow."""

import numpy as np
import pytest

from slam.estimates import Trajectory
from slam.measurements import FloatArray
from slam.trajectory.carried import (
    bridged_covariances,
    carried_covariances,
    late_covariances,
    unseen_covariances,
)
from slam.trajectory.poses import Poses

ENDS = np.array([np.diag([1e-4, 2e-4, 1e-6]), np.diag([3e-4, 5e-4, 9e-6])])
STEP = np.array([np.diag([2e-4, 3e-4, 8e-6])])


def line(yaw: float = 0.0, first: float = 0.0, count: int = 11) -> Trajectory:
    """Poses a tenth of a metre apart along x, turned by a yaw."""
    rows = np.zeros((count, 3))
    rows[:, 0], rows[:, 2] = first + 0.1 * np.arange(count), yaw
    return Trajectory.from_planar(np.arange(float(count)), rows)


def carried(trajectory: Trajectory, first: int = 0, last: int = 10, steps: FloatArray = STEP) -> FloatArray:
    return carried_covariances(trajectory, np.array([first, last]), ENDS, steps)


def test_at_the_keyframes_they_are_the_keyframes_own() -> None:
    found = carried(line())
    assert found[[0, 10]] == pytest.approx(ENDS, abs=1e-12)


def test_axes_are_those_of_the_map() -> None:
    found = carried(line(yaw=np.pi / 2))
    assert np.diag(found[0]) == pytest.approx([2e-4, 1e-4, 1e-6], rel=1e-9)


def test_between_two_keyframes_both_count_and_a_turn_moves_what_is_far() -> None:
    middle = carried(line())[5]
    # Half a metre before and behind, the yaw of each end moves it to the side.
    expected = 0.5 * (ENDS[0] + ENDS[1])
    expected[1, 1] += 0.25 * 0.5 * (1e-6 + 9e-6)
    expected[1, 2] = expected[2, 1] = 0.5 * (0.5 * 1e-6 - 0.5 * 9e-6)
    assert middle == pytest.approx(expected, abs=1e-12)


def test_far_from_certain_ends_the_step_between_them_shows() -> None:
    wild = 100.0 * np.eye(3)[None]
    found = carried(line(), steps=wild)
    assert found[5][0, 0] == pytest.approx(25.0, rel=0.01)
    assert found[10] == pytest.approx(ENDS[1])


def test_past_both_ends_they_grow_with_the_way() -> None:
    found = carried(line(), first=2, last=8)
    x = found[:, 0, 0]
    assert x[0] == pytest.approx(1e-4 + 2e-4 * 2 / 6) and x[10] == pytest.approx(3e-4 + 2e-4 * 2 / 6)
    assert x[1] < x[0] and x[9] < x[10]
    assert (np.linalg.eigvalsh(found) > 0.0).all()


def test_one_keyframe_carries_all() -> None:
    found = carried_covariances(line(), np.array([3]), ENDS[:1], np.zeros((0, 3, 3)))
    assert found[3] == pytest.approx(ENDS[0])
    assert found[10][1, 1] == pytest.approx(2e-4 + 0.7**2 * 1e-6)


def test_space_says_the_same_as_the_plane() -> None:
    rows = np.column_stack(
        [np.linspace(0.0, 2.0, 9), np.linspace(0.0, 1.0, 9) ** 2, np.linspace(0.0, 1.2, 9)]
    )
    bent = Trajectory.from_planar(np.arange(9.0), rows)
    anchors, order = np.array([1, 7]), [3, 4, 2]  # of rotation, then translation
    ends, steps = np.zeros((2, 6, 6)), np.zeros((1, 6, 6))
    for of_space, of_plane in ((ends, ENDS), (steps, STEP)):
        for one, flat in zip(of_space, of_plane, strict=True):
            one[np.ix_(order, order)] = flat
    flat_ones = carried_covariances(bent, anchors, ENDS, STEP)
    found = carried_covariances(bent, anchors, ends, steps)
    assert found[:, [0, 1, 5]][:, :, [0, 1, 5]] == pytest.approx(flat_ones, abs=1e-12)


def test_a_roll_lifts_what_lies_beside() -> None:
    rows = np.array([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    aside = Trajectory.from_planar(np.arange(2.0), rows)
    roll = np.zeros((1, 6, 6))
    roll[0, 0, 0] = 1e-4
    found = carried_covariances(aside, np.array([0]), roll, np.zeros((0, 6, 6)))[1]
    assert found[2, 2] == pytest.approx(4e-4) and found[2, 3] == pytest.approx(2e-4)


def test_stamps_that_are_off_together_move_all_that_does_not_move_as_what_is_held() -> None:
    """A way that turns now fast now slowly, 5 ms late: what it is off, laid on the pose that is held."""
    stamps_s = np.arange(0.0, 8.0, 0.02)

    def way(late_s: float) -> Poses:
        time_s = stamps_s - late_s
        return Poses.planar(np.column_stack([0.5 * time_s, np.sin(time_s), 0.3 * np.sin(0.7 * time_s)]))

    held, sigma_s = 100, 0.005
    true, late = way(0.0), way(sigma_s)
    laid = true[[held]].compose(late[[held]].between(late))
    off = np.column_stack(
        [
            (laid.positions_m - true.positions_m)[:, :2],
            (laid.rotations * true.rotations.inv()).as_rotvec()[:, 2],
        ]
    )
    trajectory = true.trajectory(stamps_s)
    found = late_covariances(trajectory, held, [(len(trajectory), sigma_s)], 3)
    inner = slice(20, -20)
    np.testing.assert_allclose(found[inner], (off[:, :, None] * off[:, None, :])[inner], atol=1e-6)
    assert found[held] == pytest.approx(np.zeros((3, 3)), abs=1e-12)
    assert np.sqrt(found[inner, 1, 1].max()) > 0.003


def test_a_clock_error_in_space_is_velocity_and_turn_rate_and_whole_at_the_first_pose() -> None:
    """A climb at 3 m/s that stops after a second, held at its first pose, with stamps 10 ms late."""
    stamps_s = np.arange(0.0, 4.0, 0.1)
    climb = np.minimum(stamps_s, 1.0)[:, None] * [2.0, 0.0, np.sqrt(5.0)]
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(stamps_s), 1))
    found = late_covariances(Trajectory(stamps_s, climb, level), 0, [(40, 0.01)], 6)
    assert found[:5] == pytest.approx(np.zeros((5, 6, 6)), abs=1e-12)
    assert found[-1, [0, 2], [0, 2]] == pytest.approx([4e-4, 5e-4]) and found[-1, 0, 2] > 0.0
    rows = np.column_stack([stamps_s, np.sin(stamps_s), 0.3 * np.sin(stamps_s)])
    bent = Trajectory.from_planar(stamps_s, rows)
    flat, whole = (late_covariances(bent, 7, [(40, 0.01)], size) for size in (3, 6))
    assert whole[:, [0, 1, 5]][:, :, [0, 1, 5]] == pytest.approx(flat, abs=1e-12)
    assert late_covariances(bent[:1], 0, [(1, 0.01)], 6) == pytest.approx(np.zeros((1, 6, 6)))


def test_a_session_on_its_own_clock_is_off_by_its_speed_and_by_what_moves_the_frame() -> None:
    """Both drive along x at 0.1 m/s, the first turned by nothing, the second the other way round."""
    there, back = line(), line(yaw=np.pi)
    both = Trajectory(
        np.concatenate([there.stamps_s, back.stamps_s]),
        np.concatenate([there.positions_m, 3.0 * back.positions_m]),
        np.concatenate([there.quaternions_xyzw, back.quaternions_xyzw]),
    )
    found = late_covariances(both, 5, [(11, 0.01), (11, 0.02)], 3)
    assert found[2:9] == pytest.approx(np.zeros((7, 3, 3)), abs=1e-15)
    assert found[13:20, 0, 0] == pytest.approx((0.1 * 0.01) ** 2 + (0.3 * 0.02) ** 2)
    assert late_covariances(both, 5, [(11, 0.0), (11, 0.0)], 3) == pytest.approx(np.zeros((22, 3, 3)))


def test_where_no_scan_was_placed_wheels_may_have_slipped_at_any_moment() -> None:
    """Scans at 0 to 1 s and again at 5 s; the wheels say 4 m between, the scans 3 m and a turn of 0.2."""
    stamps_s = np.arange(0.0, 7.01, 0.25)
    scans = np.flatnonzero((stamps_s <= 1.0) | (np.abs(stamps_s - 5.0) < 1e-9))
    wheels = Poses.planar(np.column_stack([stamps_s, 0.0 * stamps_s, 0.0 * stamps_s]))
    share = np.clip((stamps_s - 1.0) / 4.0, 0.0, 1.0)
    rows = np.column_stack([stamps_s - share, 0.0 * stamps_s, 0.2 * share])
    trajectory = Poses.planar(rows).trajectory(stamps_s)
    found = unseen_covariances(trajectory, scans, wheels, 3)
    middle = int(np.flatnonzero(stamps_s == 3.0)[0])
    assert not found[scans].any()
    assert found[middle, 0, 0] == pytest.approx(0.25 * 1.0, rel=1e-6)
    assert found[middle, 2, 2] == pytest.approx(0.25 * 0.2**2, rel=1e-6)
    # A turn at the last scan would have moved what is 1.5 m on.
    assert found[middle, 1, 1] == pytest.approx(0.25 * (1.0 + (1.5 * 0.2) ** 2), rel=1e-6)
    # After the last scan wheels are as good as they are between scans: here without a fault.
    assert not found[-1].any()
    np.testing.assert_allclose(
        unseen_covariances(trajectory, scans, wheels, 6)[middle][np.ix_([0, 1, 5], [0, 1, 5])], found[middle]
    )


def test_without_wheels_a_robot_may_be_anywhere_that_it_comes_to() -> None:
    stamps_s = np.arange(0.0, 6.01, 0.25)
    scans = np.flatnonzero((stamps_s <= 2.0) | (stamps_s >= 4.0) & (stamps_s <= 5.0))
    trajectory = Poses.planar(np.column_stack([2.0 * stamps_s, 0.0 * stamps_s, 0.0 * stamps_s])).trajectory(
        stamps_s
    )
    found = unseen_covariances(trajectory, scans, None, 3)
    assert not found[scans].any()
    # 2 m/s: a second from either end; a second after the last.
    for stamp_s in (3.0, 6.0):
        assert found[stamps_s == stamp_s][0] == pytest.approx(np.diag([4.0, 4.0, 0.0]))
    assert not unseen_covariances(trajectory, np.array([7]), None, 3).any()  # nothing shows how fast


def test_a_stamp_that_runs_backward_makes_no_variance_negative() -> None:
    stamps_s = np.array([0.0, 0.25, 0.2, 0.75, 1.25, 1.5])
    trajectory = Poses.planar(np.column_stack([2.0 * stamps_s, stamps_s, stamps_s])).trajectory(stamps_s)
    found = unseen_covariances(trajectory, np.array([0, 1, 4, 5]), None, 3)
    assert found[2, 0, 0] == 0.0 < found[3, 0, 0]


def test_where_an_imu_alone_led_poses_are_as_uncertain_along_the_map_as_it_says() -> None:
    found = bridged_covariances(line(yaw=np.pi / 2), {3: np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])})
    assert found[3] == pytest.approx(np.diag([5.0, 4.0, 6.0, 2.0, 1.0, 3.0]))
    assert not found[[0, 2, 4]].any()
