"""The first pose at its stamp in the log: half a revolution before the cloud that gives it."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from cloud_world import SMALL, look_on_the_way
from imu_world import readings, walk

import slam
from slam.config import load_config
from slam.graph.edge import EdgeKind
from slam.mapper.first_map import first_map
from slam.matching.cloud_points import at_middle_of_turn
from slam.measurements import FloatArray
from slam.odometry.before_first import BeforeFirst
from slam.odometry.cloud_tracker import CloudTracker, FirstMap
from slam.odometry.imu_tracker import ImuTracker

CONFIG = load_config(None, [*SMALL, "sensors.imu=false"])
TWIST = np.array([0.0, 0.0, 0.6, 0.8, 0.0, 0.0])
SLOWER = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])


def turning(time_s: float) -> FloatArray:
    """Twist of a robot whose rotation slows down."""
    return TWIST + SLOWER * min(time_s, 0.4)


def way(count: int) -> list[gtsam.Pose3]:
    """Its pose each 0.1 s, from steps of a millisecond."""
    poses, pose = [], gtsam.Pose3()
    for n in range(100 * count):
        if n % 100 == 0:
            poses.append(pose)
        pose = pose.compose(gtsam.Pose3.Expmap(1e-3 * turning(1e-3 * (n + 0.5))))
    return poses


CLOUDS = [look_on_the_way(pose, turning(n / 10 + 0.05), n / 10, seed=n) for n, pose in enumerate(way(30))]


def test_without_a_gyroscope_the_twist_leads_back_and_its_change_is_the_doubt() -> None:
    before = BeforeFirst(FirstMap(TWIST, SLOWER))
    before.begin(5.0, 5.05, TWIST)
    half = gtsam.Pose3()
    for n in range(50):
        half = half.compose(gtsam.Pose3.Expmap(-1e-3 * (TWIST - 1e-3 * n * SLOWER)))
    np.testing.assert_allclose(before.offset, gtsam.Pose3.Logmap(half), atol=2e-4)
    np.testing.assert_allclose(before.off, 0.0025 * SLOWER)
    unknown = BeforeFirst(FirstMap())
    unknown.begin(5.0, 5.05, np.zeros(6))
    assert np.isnan(unknown.offset).all() and not unknown.off.any()


def test_a_gyroscope_measures_the_rotation_also_before_its_bias_is_known() -> None:
    before, imu = BeforeFirst(FirstMap(TWIST, SLOWER)), ImuTracker()
    before.begin(0.25, 0.3, TWIST)
    before.see(imu)
    np.testing.assert_allclose(before.off, 0.0025 * SLOWER)
    true, found = gtsam.Rot3.Logmap(walk(0.3).rotation().between(walk(0.25).rotation())), []
    for reading in readings(walk, 4.0):
        imu.add(reading)
        if round(200.0 * reading.stamp_s) % 20 == 0 and reading.stamp_s > 0.2:
            imu.took(reading.stamp_s, walk(reading.stamp_s), np.diag([1e-6] * 3 + [4e-6] * 3))
            before.see(imu)
            found.append(before.offset)
    assert np.linalg.norm(found[0][:3] - true) < 5e-3 and np.isnan(found[0][3:]).all()
    assert np.linalg.norm(found[-1][:3] - true) < 3e-4
    assert 0.0 < np.linalg.norm(before.off[:3]) < 0.1 * np.linalg.norm(true)


def test_the_first_cloud_shows_how_it_turns() -> None:
    """Clouds after it leave open whether its rotation has just changed."""
    first = first_map(CLOUDS, CONFIG)
    assert first.twist is not None
    for wrong_rad_s in (-0.2, 0.15):
        twist = TWIST + np.array([0.0, 0.0, wrong_rad_s, 0.0, 0.0, 0.0])
        tracker = CloudTracker(CONFIG, None, first=replace(first, twist=twist))
        found = tracker.follow(at_middle_of_turn(CLOUDS[0], CONFIG.cloud_odometry))
        assert abs(tracker.twist[2] - turning(0.05)[2]) < 0.03
        assert np.linalg.norm(found.pose.translation()) < 0.02


def test_the_first_edge_has_the_doubt_of_the_first_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    made = slam.build_map(iter(CLOUDS), CONFIG)
    edges = [one.edge for one in made.factors if one.edge.kind is EdgeKind.LIDAR]
    sigmas = [np.sqrt(edge.covariance[2, 2]) for edge in edges]
    assert sigmas[0] > 0.7 * 0.0025 * abs(SLOWER[2]) > np.max(sigmas[1:])
    first, second = made.trajectory.poses()[:2]
    error = gtsam.Pose3.Logmap(way(2)[1].between(first.between(second)))
    assert abs(error[2]) < 3e-3 and np.linalg.norm(error[3:]) < 0.02
    monkeypatch.setattr(BeforeFirst, "begin", lambda self, *_: setattr(self, "offset", -0.1 * TWIST))
    moved = slam.build_map(iter(CLOUDS), CONFIG).trajectory.poses()[0]
    np.testing.assert_allclose(gtsam.Pose3.Logmap(moved), -0.1 * TWIST, atol=5e-3)
