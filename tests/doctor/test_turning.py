"""A spinning lidar whose points have no times: its turn is found by what the lidar's motion bends."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import write_log

from slam.app.localizing import localize_log
from slam.app.mapping import map_log
from slam.config import Config, load_config
from slam.config.calibration import Calibration, CloudCorrection
from slam.datasets.corrections import corrected
from slam.datasets.corrections_in_space import corrected_cloud, retimed, turn_times
from slam.doctor import turning
from slam.doctor.cloud_samples import CloudSamples
from slam.doctor.diagnosis import diagnose
from slam.doctor.finding import remedied
from slam.doctor.in_space import cloud_findings
from slam.doctor.turning import turn_of
from slam.matching.cloud_points import at_middle_of_turn
from slam.measurements import FloatArray, PointCloud
from slam.outputs.finished_map import load_map

INTERVAL_S = 0.1
# Of a lidar that drives on and turns a little.
TWIST = np.array([0.0, 0.0, 0.12, 6.0, 0.0, 0.0])


def street(rng: np.random.Generator) -> FloatArray:
    """(N, 3) points on the ground, on houses along both sides of a way, and on walls across it."""
    walls = []
    for number in range(24):
        x, side = 4.0 * number - 20.0, (-1.0) ** number
        y = side * (6.0 + (5 * number * number) % 7)
        front = np.array([[x, y, -1.5], [3.0, 0.0, 0.0], [0.0, 0.0, 5.0]])
        end = np.array([[x, y, -1.5], [0.0, side * 4.0, 0.0], [0.0, 0.0, 5.0]])
        walls += [front, end]
    ground = np.array([[-20.0, -15.0, -1.5], [100.0, 0.0, 0.0], [0.0, 30.0, 0.0]])
    parts = [
        wall[0] + rng.random((count, 2)) @ wall[1:]
        for wall, count in [(ground, 2500), *[(wall, 200) for wall in walls]]
    ]
    return np.vstack(parts)


def clouds(turn_s: float, cut_deg: float, count: int = 84, seed: int = 0) -> list[PointCloud]:
    """Of a drive, each point as it is seen at its time; ``turn_s`` 0 sees all at once."""
    rng, found = np.random.default_rng(seed), list[PointCloud]()
    for number in range(count):
        pose = gtsam.Pose3.Expmap(number * INTERVAL_S * TWIST)
        points = street(rng)
        seen = pose.transformTo(points.T).T
        bearings = np.arctan2(seen[:, 1], seen[:, 0])
        times_s = turn_s * (np.mod(bearings / math.tau - cut_deg / 360.0, 1.0) - 0.5)
        # As seen from where it was a moment later: to first order, the turns are small.
        velocities = TWIST[3:] + np.cross(TWIST[:3], seen)
        seen = seen - times_s[:, None] * velocities + 0.01 * rng.standard_normal(seen.shape)
        found.append(PointCloud(10.0 + number * INTERVAL_S, seen.astype(np.float32), None, sensor="lidar"))
    return found


def stretches(found: list[PointCloud]) -> list[list[PointCloud]]:
    """Two seconds each."""
    return [found[begin : begin + 21] for begin in range(0, len(found), 21)]


@pytest.mark.parametrize(("turn_s", "cut_deg"), [(-0.1, 180.0), (0.1, 90.0)])
def test_a_turn_its_sense_and_its_cut_are_found(turn_s: float, cut_deg: float) -> None:
    turn = turn_of(stretches(clouds(turn_s, cut_deg)), INTERVAL_S, Config())
    assert turn is not None
    assert turn.turn_s == pytest.approx(turn_s)
    assert abs(math.remainder(turn.cut_rad - math.radians(cut_deg), math.tau)) < 0.2


def test_what_is_left_once_straightened_in_part_does_not_move_the_cut() -> None:
    found = clouds(-0.1, 60.0, count=42, seed=2)
    turn = turn_of([found[begin : begin + 10] for begin in range(0, 40, 10)], INTERVAL_S, Config())
    assert turn is not None and turn.turn_s == pytest.approx(-0.1)
    assert abs(turn.cut_rad - math.radians(60.0)) < 0.2


def test_clouds_that_were_seen_at_once_have_no_turn() -> None:
    assert turn_of(stretches(clouds(0.0, 180.0)), INTERVAL_S, Config()) is None


def test_a_turn_by_which_points_do_not_fit_better_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """As seen from a tilted lidar, planes confirm a turn that there is not."""
    monkeypatch.setattr(turning, "_gain", lambda *_: 0.4)
    assert turn_of(stretches(clouds(-0.1, 180.0)), INTERVAL_S, Config()) is None


def test_what_sees_a_part_of_the_circle_tells_its_turn_where_that_shows() -> None:
    behind = [
        replace(one, points_lidar=one.points_lidar[one.points_lidar[:, 0] < 0.0])
        for one in clouds(-0.1, 180.0, 84)
    ]
    turn = turn_of(stretches(behind), INTERVAL_S, Config())
    assert turn is not None and turn.turn_s == pytest.approx(-0.1)
    ahead = [
        replace(one, points_lidar=one.points_lidar[one.points_lidar[:, 0] > 0.0])
        for one in clouds(0.0, 180.0, 84)
    ]
    assert turn_of(stretches(ahead), INTERVAL_S, Config()) is None


def test_four_seconds_show_a_turn() -> None:
    turn = turn_of(stretches(clouds(-0.1, 180.0, 42)), INTERVAL_S, Config())
    assert turn is not None and turn.turn_s == pytest.approx(-0.1)


@pytest.mark.parametrize(("scale", "count"), [(1.0, 84), (-1.0, 84), (0.1, 168), (10.0, 84)])
def test_times_that_run_backward_or_are_of_another_unit_are_found(scale: float, count: int) -> None:
    seen = clouds(-0.1, 180.0, count)
    right = [replace(one, times_s=turn_times(one.points_lidar, -0.1, math.pi)) for one in seen]
    log = [retimed(one, scale) for one in right]
    found = [one for one in diagnose(log) if one.kind == "times of points"]
    assert [one.value for one in found] == ([] if scale == 1.0 else [pytest.approx(1.0 / scale)])
    mended = corrected(log, remedied(Calibration(), found, only_sure=True))
    for one, true in zip(mended, right, strict=True):
        assert isinstance(one, PointCloud) and one.times_s is not None and true.times_s is not None
        assert np.allclose(one.times_s, true.times_s)


def test_of_nothing_no_turn_is_reported() -> None:
    assert turn_of([], INTERVAL_S, Config()) is None
    still = clouds(-0.1, 180.0, 1)
    assert turn_of([still * 5], INTERVAL_S, Config()) is None
    empty = PointCloud(1.0, np.full((5, 3), np.nan, np.float32), None)
    assert turn_of([[empty] * 5], 0.0, Config()) is None


def test_the_doctor_shows_the_turn_and_its_remedy_times_the_points() -> None:
    samples = CloudSamples()
    for cloud in clouds(-0.1, 180.0):
        samples.add(cloud)
    samples.close(compared=False)
    assert samples.untimed_s == 0.0
    (finding,) = cloud_findings("lidar", samples)
    assert finding.kind == "turn" and finding.sure
    assert "0.100 s, clockwise" in finding.text
    stated = CloudCorrection.model_validate(finding.remedies[0]["lidars_3d"]["lidar"])
    # Its start, middle and end are equally likely.
    assert stated.clock_sigma_s == pytest.approx(0.1 * math.sqrt(2 / 3 * 0.5**2), rel=0.02)
    ahead, left, behind, odd = np.array([[5, 0, 0], [0, 5, 0], [-5, -0.1, 0], [np.nan, 1, 1]], np.float32)
    cloud = PointCloud(1.0, np.stack([ahead, left, behind, odd]), None)
    times_s = corrected_cloud(stated, cloud).times_s
    assert times_s == pytest.approx([0.0, -0.025, -0.05 + 0.1, 0.0], abs=0.006)


def test_without_an_imu_a_turn_makes_poses_uncertain_by_half_of_it(tmp_path: Path) -> None:
    config = load_config(None, ["cloud_odometry.voxel_m=0.5", "dense_map.enabled=false"])
    made = map_log(write_log(tmp_path / "log", clouds(-0.1, 180.0)), config, out=tmp_path / "map")
    assert load_map(made.path).contents.clock_sigma_s == pytest.approx(0.041, abs=0.002)


def test_localisation_straightens_clouds_as_mapping_does(tmp_path: Path) -> None:
    """A lidar that turns, in the map of one that sees all at once: as bent they lie a hand's breadth off."""
    config = load_config(None, ["cloud_odometry.voxel_m=0.5", "dense_map.enabled=false"])
    mapped = map_log(write_log(tmp_path / "mapped", clouds(0.0, 180.0)), config, out=tmp_path / "map")
    log = write_log(tmp_path / "driven", clouds(-0.1, 180.0, seed=100))
    found, driven = localize_log(mapped.path, log, config).trajectory, mapped.trajectory
    both = np.isin(driven.stamps_s.round(3), found.stamps_s.round(3))
    assert both.sum() > 0.9 * 84
    assert np.linalg.norm(found.positions_m - driven.positions_m[both], axis=1).max() < 0.04


def test_a_lidar_that_shows_times_is_left_alone() -> None:
    times_s = np.array([0.0, 0.1])
    cloud = PointCloud(1.0, np.array([[1, 0, 0], [0, 1, 0]], np.float32), times_s)
    found = corrected_cloud(CloudCorrection(turn_s=-0.1), cloud)
    assert found.times_s is not None and found.times_s.tolist() == times_s.tolist()


def test_points_of_the_robot_itself_do_not_move_the_middle_of_a_revolution() -> None:
    """Half of a revolution sees the robot: the pose is that of the middle of the other half."""
    bearings = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    ranges_m = np.where(bearings < 0.0, 0.8, 9.0)
    points = np.column_stack([ranges_m * np.cos(bearings), ranges_m * np.sin(bearings), np.zeros(400)])
    cloud = PointCloud(
        5.0, points.astype(np.float32), np.linspace(-0.05, 0.05, 400), intensities=np.ones(400, np.float32)
    )
    found = corrected_cloud(CloudCorrection(range_min_m=1.0), cloud)
    assert found.times_s is not None and found.intensities is not None
    assert len(found.points_lidar) == len(found.times_s) == len(found.intensities) == 200
    middle = at_middle_of_turn(found, Config().cloud_odometry)
    assert middle.stamp_s == pytest.approx(5.025, abs=1e-3)
