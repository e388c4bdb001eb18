"""The local map at the first cloud, tracked backward from the first seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
from cloud_world import SMALL, look_on_the_way

from slam.config import load_config
from slam.mapper.first_map import first_map
from slam.matching.cloud_points import at_middle_of_turn
from slam.measurements import PointCloud
from slam.odometry.cloud_tracker import NO_MAP, CloudTracker, FirstMap

CONFIG = load_config(None, [*SMALL])
TWIST = np.array([0.0, 0.0, 0.6, 0.8, 0.0, 0.0])
SPREAD = 0.005  # noise of a range as its share: planes of one cloud lean by it


def noisy(cloud: PointCloud, seed: int) -> PointCloud:
    """With noise along the beams."""
    rng = np.random.default_rng(seed)
    share = 1.0 + SPREAD * rng.standard_normal((len(cloud.points_lidar), 1))
    return replace(cloud, points_lidar=(cloud.points_lidar * share).astype(np.float32))


def pose(number: int) -> gtsam.Pose3:
    return gtsam.Pose3.Expmap(TWIST * number / 10)


CLOUDS = [look_on_the_way(pose(n), TWIST, n / 10, seed=n) for n in range(40)]
NOISY = [noisy(cloud, n) for n, cloud in enumerate(CLOUDS)]


def errors_m(clouds: Sequence[PointCloud], first: FirstMap) -> list[float]:
    """The error of each position relative to the first pose."""
    tracker = CloudTracker(CONFIG, None, first=first)
    found = [tracker.follow(at_middle_of_turn(cloud, CONFIG.cloud_odometry)).pose for cloud in clouds]
    steps = [pose(n).between(found[0].between(one)) for n, one in enumerate(found)]
    return [float(np.linalg.norm(step.translation())) for step in steps]


def test_the_twist_at_the_first_cloud_is_found() -> None:
    found = first_map(CLOUDS, CONFIG)
    assert found.twist is not None
    np.testing.assert_allclose(found.twist, TWIST, atol=0.06)
    assert first_map([replace(cloud, times_s=None) for cloud in CLOUDS], CONFIG).twist is None


def test_its_planes_are_where_the_first_cloud_sees_them() -> None:
    """Without them, the first positions are several times as far off."""
    first = first_map(NOISY, CONFIG)
    assert len(first.keyframes) >= 3
    without, with_map = errors_m(NOISY, FirstMap(first.twist)), errors_m(NOISY, first)
    assert np.mean(np.square(with_map)) < 0.5 * np.mean(np.square(without))


def test_the_first_cloud_is_matched_to_it() -> None:
    """The clouds after it may have misplaced it, where the robot began to turn."""
    first, aside_m = first_map(CLOUDS, CONFIG), np.array([0.0, 0.03, 0.0])
    moved = [(points + aside_m, lidar + aside_m) for points, lidar in first.keyframes]
    tracker = CloudTracker(CONFIG, None, first=replace(first, keyframes=moved))
    found = tracker.follow(at_middle_of_turn(CLOUDS[0], CONFIG.cloud_odometry))
    assert found.new_keyframe and found.motion is not None
    np.testing.assert_allclose(found.pose.translation(), aside_m, atol=0.005)


def test_clouds_after_a_gap_or_out_of_order_are_not_used() -> None:
    late = [replace(cloud, stamp_s=cloud.stamp_s + 5.0 * (n >= 2)) for n, cloud in enumerate(CLOUDS)]
    assert first_map(late, CONFIG) is NO_MAP
    twice = [one for cloud in CLOUDS for one in (cloud, cloud)]
    assert len(first_map(twice, CONFIG).keyframes) == len(first_map(CLOUDS, CONFIG).keyframes)
    assert first_map([], CONFIG) is NO_MAP


def test_no_cloud_is_skipped_until_the_velocity_is_known() -> None:
    tracker = CloudTracker(CONFIG, None)
    standing = [look_on_the_way(pose(0), np.zeros(6), n / 10, seed=n) for n in range(3)]
    tracker.follow(standing[0])
    assert tracker.moves_on(0.1)
    for cloud in standing[1:]:
        tracker.follow(cloud)
    assert not tracker.moves_on(0.1)
