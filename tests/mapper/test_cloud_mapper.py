"""A 3D lidar end to end: once round a room with pillars, its files, its mishaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import ELEVATIONS, PILLARS, ROOM, SMALL, T_BASE_LIDAR, look, way_round, write_log

from slam.config import load_config
from slam.config.stages import GraphConfig
from slam.datasets import open_dataset
from slam.datasets.sensor_choice import SensorChoice
from slam.errors import DatasetError
from slam.evaluation.trajectory_error import absolute_error
from slam.graph.cloud_loops import CloudLoopCloser
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.mapper.first_map import first_map
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.matching.cloud_points import at_middle_of_turn
from slam.measurements import LaserScan, Measurement, PointCloud, WheelOdometry
from slam.odometry.cloud_tracker import CloudTracker
from slam.outputs.exports import Exports
from slam.storage.map_clouds import MapClouds
from slam.storage.map_file import MapFile
from slam.storage.ply import read_cloud_ply

COUNT = 36


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    poses = way_round(COUNT)
    clouds = [look(pose, 0.1 * number, seed=number) for number, pose in enumerate(poses)]
    return write_log(tmp_path_factory.mktemp("room") / "log", clouds, poses)


@pytest.fixture(scope="module")
def mapped(log: Path) -> MapResult:
    return build_map(open_dataset(log), load_config(None, SMALL))


def test_once_round_the_room(mapped: MapResult, log: Path) -> None:
    truth = open_dataset(log).groundtruth()
    assert truth is not None
    assert len(mapped.map.trajectory) == COUNT
    assert absolute_error(mapped.map.trajectory, truth).translation_m.rmse < 0.02
    assert np.abs(mapped.map.trajectory.positions_m[:, 2]).max() < 0.02
    assert not mapped.warnings


def test_every_second_cloud_of_the_local_map_is_a_keyframe(mapped: MapResult, log: Path) -> None:
    """A step is as unsure as the two matches of it; the first one has that of the first cloud, too."""
    config = load_config(None, SMALL)
    clouds = [one for one in open_dataset(log) if isinstance(one, PointCloud)]
    tracker = CloudTracker(config, None, first=first_map(clouds, config))
    tracked = [tracker.follow(at_middle_of_turn(cloud, config.cloud_odometry)) for cloud in clouds]
    local = [number for number, one in enumerate(tracked) if one.new_keyframe]
    assert mapped.map.readings.tolist() == local[:1] + local[1::2] and len(local) > 12
    steps = [factor.edge for factor in mapped.map.factors if factor.edge.kind is EdgeKind.LIDAR]
    for edge in steps:
        ends = [tracked[number].motion for number in local[2 * edge.source : 2 * edge.target]]
        assert len(ends) == 2
        sigmas = [np.sqrt(np.trace(end.covariance)) for end in ends if end is not None]
        assert np.sqrt(np.trace(edge.covariance)) > 0.99 * np.hypot(*sigmas)


def test_the_way_back_closes_a_loop(mapped: MapResult) -> None:
    assert all(bool(loop.reason) != loop.accepted for loop in mapped.map.loops)
    assert any(loop.accepted and loop.place < 5 < loop.keyframe for loop in mapped.map.loops)
    kinds = {factor.edge.kind for factor in mapped.map.factors}
    assert kinds == {EdgeKind.LIDAR, EdgeKind.LOOP}


def test_the_plan_shows_what_stands_in_the_way(mapped: MapResult) -> None:
    """Pillars and walls are obstacles, the floor between them is free."""
    grid = mapped.map.grid
    assert grid is not None
    start = way_round(COUNT)[0]

    def occupied(x: float, y: float) -> bool:
        place = start.inverse().transformFrom(np.array([x, y, 0.0]))
        column, row = (np.array([place[0], place[1]]) - grid.T_map_grid.translation()) / grid.resolution_m
        rows, columns = (slice(max(int(n) - 1, 0), int(n) + 2) for n in (row, column))
        return bool((grid.log_odds[rows, columns] > 0.0).any())

    for box in PILLARS:
        faces = [(box[0, side], box[1].mean()) for side in (0, 1)]
        assert any(occupied(*face) for face in faces)
    assert occupied(ROOM[0, 1], 0.5)
    assert not any(occupied(x, y) for x, y in [(0.0, 0.4), (1.6, 0.4), (0.5, -2.0), (-0.5, 2.5)])


def test_the_files(mapped: MapResult, log: Path, tmp_path: Path) -> None:
    config = load_config(None, SMALL)
    exports = Exports(mapped.map, config)
    names = {path.name for path in exports.write_files(tmp_path)}
    of_all = {"trajectory.tum", "trajectory_covariance.csv", "graph.g2o", "map.yaml", "map.pgm"}
    assert names == {*of_all, "elevation.yaml", "slope.yaml"}
    written = exports.write_surfaces(tmp_path)
    cloud = read_cloud_ply(written[0])
    inside = way_round(COUNT)[0].matrix()
    points = cloud.points_map @ inside[:3, :3].T + inside[:3, 3]
    off = np.minimum(np.abs(points - ROOM[:, 0]), np.abs(points - ROOM[:, 1])).min(axis=1)
    assert np.median(off) < 0.03
    assert np.all(points > ROOM[:, 0] - 0.3)
    assert np.all(points < ROOM[:, 1] + 0.3)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals_map, axis=1), 1.0, atol=1e-3)


def test_no_loops_where_none_are_wanted(log: Path) -> None:
    result = build_map(open_dataset(log), load_config(None, [*SMALL, "loops.enabled=false"]))
    assert not result.map.loops


def test_one_loop_joins_no_map_across_clouds_that_matched_nothing(tmp_path: Path) -> None:
    """A street that looks the same fits once, too."""
    rng, fog, config = (
        np.random.default_rng(1),
        slice(14, 22),
        load_config(None, [*SMALL, "match.lost_after=4"]),
    )
    clouds = [look(pose, 0.1 * number, seed=number) for number, pose in enumerate(way_round(COUNT))]
    clouds[fog] = [replace(one, points_lidar=3.0 * rng.normal(size=(4000, 3))) for one in clouds[fog]]
    result = build_map(open_dataset(write_log(tmp_path / "log", clouds)), config)
    assert not any(loop.accepted for loop in result.map.loops)
    assert any(loop.reason == "no other loop across the unobserved gap agrees" for loop in result.map.loops)
    assert any("pieces whose relative poses are only a guess" in warning for warning in result.warnings)


def test_a_place_too_far_to_be_the_same_is_not_tried() -> None:
    """There and nowhere near: identical clouds, 40 m apart, all steps sure."""
    config, kept = load_config(None, SMALL), MapClouds(MapFile.temporary())
    closer = CloudLoopCloser(config, 0.25, kept.points)
    points = look(gtsam.Pose3()).points_lidar.astype(np.float64)
    graph = KeyframeGraph(gtsam.Pose3(), GraphConfig())
    step = gtsam.Pose3(gtsam.Rot3(), np.array([4.0, 0.0, 0.0]))
    for key in range(11):
        if key:
            graph.add_keyframe(step, [Edge(key - 1, key, step, np.eye(6) * 1e-6, EdgeKind.LIDAR, True)])
        kept.add(float(key), points, T_BASE_LIDAR)
        closer.add_keyframe(points, gtsam.Pose3(graph.poses()[-1]), 0.01)
        tried = closer.close(key, graph.poses(), graph.rows(), graph.uncertainty)
    assert not tried


def test_an_unknown_mounting_finds_the_ground_by_sight(tmp_path: Path) -> None:
    clouds = [look(pose, 0.1 * number, seed=number) for number, pose in enumerate(way_round(COUNT)[:4])]
    folder = write_log(tmp_path / "log", clouds)
    (folder / "points" / "calibration.yaml").unlink()
    result = build_map(open_dataset(folder), load_config(None, SMALL))
    assert any("ground: -0.70 m" in note or "ground: -0.69 m" in note for note in result.notes)
    assert result.map.grid is not None


@pytest.mark.parametrize(
    ("clouds", "fault"),
    [
        (
            [PointCloud(0.1 * n, np.ones((5, 3), np.float32)) for n in range(3)],
            "none of 3 clouds has 60 usable",
        ),
        (
            [look(gtsam.Pose3(), 0.1 * n, seed=n, elevations=ELEVATIONS[7:8]) for n in range(21)],
            "none of 21 clouds matched",
        ),
    ],
    ids=["five points", "one ring"],
)
def test_what_cannot_be_mapped_is_reported(tmp_path: Path, clouds: list[PointCloud], fault: str) -> None:
    with pytest.raises(DatasetError, match=fault):
        build_map(open_dataset(write_log(tmp_path / "log", clouds)), load_config(None, SMALL))


def test_clouds_choose_the_mapper() -> None:
    cloud, scan = look(gtsam.Pose3()), LaserScan(0.0, np.ones(3, np.float32), 0.0, 0.1, 10.0)
    wheels = WheelOdometry(0.0, gtsam.Pose2())
    settings = load_config().sensors

    def choice(*log: Measurement, **changes: object) -> SensorChoice:
        return SensorChoice.of(log, settings.model_copy(update=changes))

    assert choice(cloud, wheels).cloud
    assert not choice(cloud, scan).cloud
    assert choice(cloud, scan, motion="spatial").cloud
    assert not choice(cloud, wheels, lidar=False).cloud
    assert not choice(cloud, wheels, motion="planar").cloud
