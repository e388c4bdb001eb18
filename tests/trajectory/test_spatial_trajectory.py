"""Poses at the stamps of the log, where clouds were placed by the middle of their turns."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.estimates import Trajectory
from slam.trajectory.readings import Readings, at_stamps

TWIST = np.array([0.05, 0.0, 0.7, 1.5, 0.1, -0.2])


def along(stamps_s: np.ndarray) -> Trajectory:
    frames = Readings()
    for stamp_s in stamps_s:
        frames.add_scan(float(stamp_s), gtsam.Pose3.Expmap(TWIST * stamp_s))
    frames.mark_keyframe()
    last = gtsam.Pose3.Expmap(TWIST * stamps_s[-1])
    return frames.trajectory([last])


@pytest.mark.parametrize("shift_s", [0.05, -0.05])
def test_an_even_motion_is_carried_on(shift_s: float) -> None:
    stamps_s = np.arange(12) * 0.1
    reported = at_stamps(along(stamps_s + shift_s), stamps_s)
    true = along(stamps_s)
    np.testing.assert_allclose(reported.stamps_s, stamps_s)
    np.testing.assert_allclose(reported.positions_m, true.positions_m, atol=1e-9)
    turned = np.abs(np.sum(reported.quaternions_xyzw * true.quaternions_xyzw, axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-12)


@pytest.mark.parametrize("late_s", [0.05, 0.05 - 1e-9], ids=["even", "jitter"])
def test_a_turn_that_begins_is_followed_half_a_step_before(late_s: float) -> None:
    """4 rad/s^2: as even motion the yaw is off by 5 mrad, or 15, as the stamps jitter."""
    own_s = 0.1 * np.arange(12)
    own_s[::2] += 1e-9
    yaw = 2.0 * np.square(own_s)
    turns = np.column_stack([np.zeros((12, 2)), np.sin(0.5 * yaw), np.cos(0.5 * yaw)])
    found = at_stamps(Trajectory(own_s, np.zeros((12, 3)), turns), own_s - late_s)
    stated = 2.0 * np.arctan2(found.quaternions_xyzw[:, 2], found.quaternions_xyzw[:, 3])
    np.testing.assert_allclose(stated, 2.0 * np.square(own_s - late_s), atol=1e-6)


def test_what_comes_twice_or_late_is_moved_as_its_neighbours_are() -> None:
    stamps_s = 0.1 * np.array([0, 1, 2, 2, 3, 5, 4, 6, 7])
    found, true = at_stamps(along(stamps_s + 0.05), stamps_s), along(stamps_s)
    np.testing.assert_allclose(found.positions_m, true.positions_m, atol=1e-9)


def test_stamps_that_stand_still_or_are_too_few_move_nothing() -> None:
    stamps_s = np.array([0.05, 0.05, 0.15])
    reported = at_stamps(along(stamps_s), np.array([0.0, 0.0, 0.1]))
    assert np.isfinite(reported.positions_m).all()
    one = along(np.array([0.05]))
    np.testing.assert_array_equal(at_stamps(one, np.array([0.0])).positions_m, one.positions_m)


def test_what_is_measured_before_the_first_pose_counts_more_than_the_parabola() -> None:
    stamps_s, before = np.arange(12) * 0.1, np.array([0.01, np.nan, -0.2, np.nan, 0.03, np.nan])
    path = along(stamps_s + 0.05)
    usual, found = at_stamps(path, stamps_s), at_stamps(path, stamps_s, (0, before))
    np.testing.assert_array_equal(found.positions_m[1:], usual.positions_m[1:])
    first = path.poses()[0]
    moved, smooth = (gtsam.Pose3.Logmap(first.between(one.poses()[0])) for one in (found, usual))
    np.testing.assert_allclose(moved, np.where(np.isnan(before), smooth, before), atol=1e-9)


STEP = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.05), np.array([0.1, 0.02, -0.01]))
MOUNT = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.4, 0.2, -1.0), np.array([0.1, 0.2, 0.3]))


def drifting(count: int, keyframes: tuple[int, ...]) -> tuple[Readings, list[gtsam.Pose3]]:
    """Frames 0.1 s apart on a curve, some of them keyframes; their odometry poses."""
    frames, pose, poses = Readings(), gtsam.Pose3(), []
    for n in range(count):
        frames.add_scan(0.1 * n, pose)
        if n in keyframes:
            frames.mark_keyframe()
        poses.append(pose)
        pose = pose * STEP
    return frames, poses


def matrices(frames: Readings, keyframe_poses: list[gtsam.Pose3]) -> list[gtsam.Pose3]:
    found = frames.trajectory(keyframe_poses)
    return [
        gtsam.Pose3(gtsam.Rot3.Quaternion(q[3], q[0], q[1], q[2]), p)
        for p, q in zip(found.positions_m, found.quaternions_xyzw, strict=True)
    ]


@pytest.mark.parametrize("T_map_odom", [gtsam.Pose3(), MOUNT])
def test_one_correction_moves_all_alike(T_map_odom: gtsam.Pose3) -> None:
    frames, poses = drifting(10, (0, 4, 7))
    assert frames.keyframe_scans().tolist() == [0, 4, 7]
    found = matrices(frames, [T_map_odom * poses[n] for n in (0, 4, 7)])
    for pose, odometry in zip(found, poses, strict=True):
        assert pose.equals(T_map_odom * odometry, 1e-9)
    np.testing.assert_allclose(frames.trajectory(poses[:3]).stamps_s, 0.1 * np.arange(10))


def test_a_correction_fades_in_between_two_keyframes() -> None:
    """The second keyframe is 8 cm further along: half way it is 4 cm, and behind it stays 8 cm."""
    frames, poses = drifting(10, (0, 8))
    aside = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.08, 0.0]))
    found = matrices(frames, [poses[0], aside * poses[8]])
    off = [
        pose.translation()[1] - odometry.translation()[1] for pose, odometry in zip(found, poses, strict=True)
    ]
    np.testing.assert_allclose(off, [0.01 * n for n in range(9)] + [0.08], atol=1e-9)


def test_keyframes_get_their_own_poses() -> None:
    frames, poses = drifting(10, (0, 3, 9))
    turned = [pose * gtsam.Pose3.Expmap(0.02 * n * np.arange(6.0)) for n, pose in enumerate(poses)]
    found = matrices(frames, [turned[n] for n in (0, 3, 9)])
    for n in (0, 3, 9):
        assert found[n].equals(turned[n], 1e-9)


def test_one_frame_is_a_trajectory() -> None:
    frames, poses = drifting(1, (0,))
    assert frames.scan_count == 1
    assert matrices(frames, [MOUNT])[0].equals(MOUNT * poses[0], 1e-9)
