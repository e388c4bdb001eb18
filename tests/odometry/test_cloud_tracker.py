"""Where a 3D lidar is from turn to turn: wheels lead where it went far, and it gets over empty clouds."""

from __future__ import annotations

import dataclasses

import gtsam
import numpy as np
import pytest
from cloud_world import base, look
from imu_world import readings

from fusion.estimation import gate
from slam.config import Config
from slam.config.clouds import CloudOdometryConfig
from slam.measurements import PointCloud, WheelOdometry
from slam.odometry.cloud_tracker import CloudTracker, TrackedCloud
from slam.odometry.imu_tracker import ImuTracker
from slam.odometry.wheel_tracker import WheelMoment, WheelTracker

CONFIG = Config(cloud_odometry=CloudOdometryConfig(voxel_m=0.2))
# Two turns of the lidar before a step that no velocity shows.
PATH = [base(-1.5, -0.5, 0.0), base(-1.4, -0.5, 0.0), base(0.6, 0.5, 0.9)]


def driven(poses: list[gtsam.Pose3], *, wheels: bool, slip_m: float = 0.0) -> list[TrackedCloud]:
    """A cloud every two seconds; the wheels stand somewhere else, turned by half a radian."""
    tracker = WheelTracker(CONFIG.wheels) if wheels else None
    lidar = CloudTracker(CONFIG, tracker)
    seen = []
    for n, pose in enumerate(poses):
        if tracker is not None:
            slipped = gtsam.Pose2(7.0, -2.0, 0.5).compose(
                gtsam.Pose2(pose.x() + slip_m * n, pose.y(), pose.rotation().yaw())
            )
            tracker.add(WheelOdometry(2.0 * n, slipped))
        tracked = lidar.track(look(pose, 2.0 * n, seed=n))
        if tracked.new_keyframe:
            lidar.add_keyframe(tracked)
        seen.append(tracked)
    return seen


def error_m(tracked: TrackedCloud, poses: list[gtsam.Pose3]) -> float:
    truth = poses[0].between(poses[-1])
    return float(np.linalg.norm(truth.between(tracked.pose).translation()))


def test_wheels_lead_where_it_went_far_in_one_step() -> None:
    assert error_m(driven(PATH, wheels=True)[-1], PATH) < 0.02


def test_without_wheels_such_a_step_is_not_reported_for_sure() -> None:
    last = driven(PATH, wheels=False)[-1]
    assert error_m(last, PATH) > 0.3
    assert last.motion is None or not last.motion.converged


def test_wheels_that_slip_do_not_lead_astray() -> None:
    near = [base(-1.5 + 0.1 * n, -0.5, 0.0) for n in range(4)]
    assert error_m(driven(near, wheels=True, slip_m=0.3)[-1], near) < 0.02


def test_wheels_are_worth_what_matches_say_and_as_fast_as_they_see() -> None:
    """Theirs is a way of 5 % too much, of a robot that is faster than the setting has it."""
    config = CONFIG.model_copy(
        update={"wheels": CONFIG.wheels.model_copy(update={"greatest_speed_m_s": 0.5})}
    )
    wheels, poses = WheelTracker(config.wheels), [base(-1.5 + 0.1 * n, -0.5, 0.0) for n in range(24)]
    lidar = CloudTracker(config, wheels)
    assert not wheels.plausible(np.array([0.105, 0.0, 0.0]), 0.1)
    for n, pose in enumerate(poses):
        wheels.add(WheelOdometry(0.1 * n, gtsam.Pose2(0.105 * n, 0.0, 0.0)))
        lidar.follow(look(pose, 0.1 * n, seed=n))
    moved = wheels.motion(*(WheelMoment(np.array([x, 0.0, 0.0]), 0.0) for x in (0.0, 0.105)), 0.1)
    assert moved is not None and 0.1 < moved[0] < 0.1042
    claimed = wheels.covariance(moved)
    assert lidar.by_wheels.rescaled(moved, claimed).covariance[0, 0] < 0.6 * claimed[0, 0]


def test_a_keyframe_is_where_it_has_moved_on_or_turned() -> None:
    turned = [
        base(-1.5, -0.5, 0.0),
        base(-1.49, -0.5, 0.0),
        base(-1.49, -0.5, CONFIG.keyframes.angle_rad + 0.05),
    ]
    assert [one.new_keyframe for one in driven(turned, wheels=True)] == [True, False, True]


@pytest.mark.parametrize("blind", [1, CONFIG.match.lost_after])
def test_it_goes_on_after_clouds_without_a_point(blind: int) -> None:
    tracker = CloudTracker(CONFIG, None)
    tracker.add_keyframe(tracker.track(look(PATH[0], 0.0)))
    empty = dataclasses.replace(look(PATH[0]), points_lidar=np.zeros((0, 3), np.float32))
    for n in range(blind):
        lost = tracker.track(dataclasses.replace(empty, stamp_s=0.1 * (n + 1)))
        assert lost.motion is None
        assert not lost.new_keyframe
    found: PointCloud = look(PATH[1], 0.1 * (blind + 1), seed=1)
    assert error_m(tracker.track(found), PATH[:2]) < 0.02


def test_after_a_gap_at_speed_what_fits_nearby_is_another_place() -> None:
    tracker, driven_m = CloudTracker(CONFIG, None), 0.3
    for n in range(6):
        tracked = tracker.track(look(base(-1.5 + driven_m * n, -0.5, 0.0), 0.1 * n, seed=n))
        if tracked.new_keyframe:
            tracker.add_keyframe(tracked)
    late = tracker.track(look(base(0.3, -0.5, 0.0), 3.5, seed=9))
    assert late.motion is None
    assert late.new_keyframe
    assert late.unseen_m == pytest.approx(driven_m / 0.1 * 3.0, rel=0.05)
    tracker.add_keyframe(late)
    again = tracker.track(look(base(0.35, -0.5, 0.0), 3.6, seed=10))
    assert again.motion is not None
    assert np.linalg.norm(late.pose.between(again.pose).translation() - [0.05, 0.0, 0.0]) < 0.02


def test_what_fits_in_part_is_as_sure_as_the_imu_that_led_there() -> None:
    def way(time_s: float) -> gtsam.Pose3:
        return base(-1.5 + 0.4 * time_s, 0.5 * np.sin(0.7 * time_s), 0.6 * np.sin(0.8 * time_s))

    tracker, tracked, next_s = CloudTracker(CONFIG, None, imu=ImuTracker()), None, 0.0
    for reading in readings(way, 3.33):
        tracker.hear(reading)
        time_s = reading.stamp_s - 0.01
        if time_s < next_s - 1e-9:
            continue
        next_s, cloud = next_s + 0.1, look(way(time_s), time_s, seed=int(10 * time_s))
        if time_s > 2.5:
            cloud = dataclasses.replace(cloud, points_lidar=cloud.points_lidar[:20])
        if time_s > 3.25:
            cloud = look(way(time_s), time_s, seed=40)
            cloud.points_lidar[::3] *= np.random.default_rng(4).uniform(0.3, 0.9, (1920, 1))
        tracked = tracker.follow(cloud)
    assert tracked is not None and tracked.motion is not None and not tracked.motion.converged
    # Without the IMU it is as unsure as a voxel is wide.
    covariance = tracked.motion.covariance
    off = gtsam.Pose3.Logmap(way(0.0).between(way(next_s - 0.1)).between(tracked.pose))
    assert np.sqrt(np.diag(covariance)).max() < 0.25 * CONFIG.cloud_odometry.voxel_m
    assert off @ np.linalg.solve(covariance, off) < gate(6)
