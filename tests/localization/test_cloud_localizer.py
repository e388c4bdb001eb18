"""Drives of a 3D lidar in two rooms: found, tracked, carried off, found again; never sure and wrong."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from cloud_world import OTHER, WAY, drive, seen, write_log
from command_line import Scanweave, assert_one_line_error
from command_line import scanweave as scanweave

from slam.config import load_config
from slam.datasets import open_dataset
from slam.errors import MapFileError
from slam.localization.cloud_sensor import CloudSensor, CloudView
from slam.localization.localizer import Localizer
from slam.localization.output import LocalizerOutput, State
from slam.mapper.pipeline import build_map
from slam.measurements import FloatArray, PointCloud
from slam.simulation.synthetic_log import write_synthetic_log
from slam.storage.map_contents import MapContents
from slam.storage.tum import read_tum

SETTINGS = ("cloud_odometry.voxel_m=0.25", "dense_map.enabled=false")
CONFIG = load_config(None, SETTINGS)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    poses = drive(WAY)
    return write_log(tmp_path_factory.mktemp("mapped") / "log", seen(poses, 0), poses)


@pytest.fixture(scope="module")
def known_map(log: Path) -> MapContents:
    return build_map(open_dataset(log), CONFIG).map


def follow(known_map: MapContents, clouds: Iterable[PointCloud]) -> list[LocalizerOutput]:
    localizer = Localizer(known_map, CONFIG)
    outputs = [localizer.add(cloud) for cloud in clouds]
    assert all(output is not None for output in outputs)
    return [output for output in outputs if output is not None]


def offset(found: object, pose: gtsam.Pose3) -> FloatArray:
    """(2,) metres and radians of a pose of the map, whose frame is where its drive began."""
    assert isinstance(found, gtsam.Pose3)
    step = drive(WAY)[0].between(pose).between(found)
    turn_rad = np.linalg.norm(gtsam.Rot3.Logmap(step.rotation()))
    return np.array([np.linalg.norm(step.translation()), turn_rad])


def errors(outputs: Sequence[LocalizerOutput], poses: Sequence[gtsam.Pose3]) -> FloatArray:
    """(N, 2) metres and radians of the poses that are tracked."""
    pairs = zip(outputs, poses, strict=True)
    rows = [offset(output.pose, pose) for output, pose in pairs if output.state is State.TRACKING]
    return np.array(rows).reshape(-1, 2)


def test_a_drive_is_found_and_tracked(known_map: MapContents) -> None:
    poses = drive(OTHER)[2:30]
    outputs = follow(known_map, seen(poses, 100))
    found = errors(outputs, poses)
    assert len(found) > 0.6 * len(poses)
    assert np.median(found[:, 0]) < 0.03 and np.median(found[:, 1]) < np.radians(0.5)
    assert found[:, 0].max() < 0.1
    first = next(n for n, output in enumerate(outputs) if output.state is State.TRACKING)
    assert 0 < first == len(outputs[first].recovered)
    for past, pose in zip(outputs[first].recovered, poses, strict=False):
        assert offset(past.pose, pose)[0] < 0.1
    for output in outputs:
        assert (output.pose is None) == (output.state is State.SEARCHING)
        assert 0.0 <= output.confidence <= 1.0
        if output.covariance is not None:
            assert np.linalg.eigvalsh(output.covariance)[0] > 0.0


def test_every_search_finds_the_place(known_map: MapContents) -> None:
    """Neither lost to the large voxels that lead to places, nor left where those end."""
    sensor = CloudSensor(known_map, None, CONFIG)
    for pose, cloud in list(zip(drive(OTHER), seen(drive(OTHER), 1500), strict=True))[::3]:
        points = cloud.T_base_lidar.translation() + cloud.points_lidar.astype(np.float64)
        view = CloudView.of(points, cloud.T_base_lidar, sensor.voxel_m)
        assert (
            min(offset(found, pose)[0] for found in sensor.propose(view, [], None) if found is not None) < 0.1
        )


def test_no_search_before_its_candidates_can_differ(known_map: MapContents) -> None:
    """In a town, a car passes many metres before it sees other candidates; nowhere less than configured."""
    sensor = CloudSensor(known_map, None, CONFIG)
    near, beside = (
        gtsam.Pose3(gtsam.Rot3(), [share * sensor.search_every_m, 0.0, 0.0]) for share in (0.9, 1.1)
    )
    assert len(sensor._places._apart([gtsam.Pose3(), near])) == 1
    assert len(sensor._places._apart([gtsam.Pose3(), beside])) == 2
    assert sensor.search_every_m > CONFIG.localization.search_every_m
    rarely = load_config(None, [*SETTINGS, "localization.search_every_m=7"])
    assert CloudSensor(known_map, None, rarely).search_every_m == 7.0


def test_another_building_leads_to_no_pose(known_map: MapContents) -> None:
    """The same rooms, but smaller, and the other way round."""
    small = np.array([0.8, -0.8, 1.0], np.float32)
    clouds = [
        replace(cloud, points_lidar=cloud.points_lidar * small) for cloud in seen(drive(OTHER)[:14], 200)
    ]
    outputs = follow(known_map, clouds)
    assert all(output.state is State.SEARCHING and output.pose is None for output in outputs)


def test_carried_off_and_found_again(known_map: MapContents) -> None:
    """From the left room into the right one, in the midst of the log, without a gap in the stamps."""
    whole = drive(OTHER)
    poses = [*whole[:11], *whole[27:]]
    outputs = follow(known_map, seen(poses, 300))
    assert outputs[10].state is State.TRACKING
    assert any(output.state is State.LOST for output in outputs[11:])
    assert outputs[-1].state is State.TRACKING and outputs[-1].pose is not None
    assert offset(outputs[-1].pose, poses[-1])[0] < 0.05
    for output, pose in zip(outputs, poses, strict=True):
        if output.state is State.TRACKING:
            assert offset(output.pose, pose)[0] < 0.25


def test_empty_clouds_are_endured(known_map: MapContents) -> None:
    empty = [PointCloud(0.1 * n, np.zeros((n % 3, 3), np.float32)) for n in range(8)]
    assert all(output.state is State.SEARCHING for output in follow(known_map, empty))


def test_without_its_lidar_it_is_refused(known_map: MapContents) -> None:
    with pytest.raises(MapFileError, match="3D lidar"):
        Localizer(known_map, load_config(None, ["sensors.lidar=false"]))


def test_the_command(scanweave: Scanweave, log: Path, tmp_path: Path) -> None:
    """Files as of a robot on a floor; the map stays as it is; what does not fit is reported."""
    options = [part for setting in SETTINGS for part in ("--set", setting)]
    folder, out = tmp_path / "map", tmp_path / "out"
    assert scanweave("map", log, "-o", folder, *options).code == 0
    before = (folder / "map.db").read_bytes()
    poses = drive(OTHER)[3:14]
    driven = write_log(tmp_path / "driven", seen(poses, 400), poses)
    outcome = scanweave("localize", folder, driven, "-o", out, *options)
    assert outcome.code == 0 and "tracking" in outcome.out, outcome
    assert {path.name for path in out.iterdir()} == {"trajectory.tum", "trajectory.csv", "report.html"}
    assert len(read_tum(out / "trajectory.tum")) == len(poses)
    assert "cov_rx_rx" in (out / "trajectory.csv").read_text().splitlines()[0]

    flat = write_synthetic_log(tmp_path / "flat", seed=1, duration_s=10.0).log_path
    assert_one_line_error(scanweave("localize", folder, flat, "-o", out), "needs clouds of a 3D lidar")
    assert (folder / "map.db").read_bytes() == before
    assert scanweave("map", flat, "-o", tmp_path / "flat map").code == 0
    outcome = scanweave("localize", tmp_path / "flat map", driven, "-o", out)
    assert_one_line_error(outcome, "needs planar scans")


def test_a_stamp_error_counts_in_the_direction_of_motion(known_map: MapContents) -> None:
    poses = drive(OTHER)[2:20]
    clouds = seen(poses, 100)
    settings = [*SETTINGS, "sensors.calibration.lidars_3d.lidar.clock_sigma_s=0.05"]
    localizer = Localizer(known_map, load_config(None, settings))
    late = [localizer.add(cloud) for cloud in clouds]
    checked = 0
    for n, (output, exact) in enumerate(zip(late, follow(known_map, clouds), strict=True)):
        if output is None or output.covariance is None or exact.covariance is None:
            continue
        elapsed_s = clouds[n].stamp_s - clouds[n - 1].stamp_s
        moved = 0.05 / elapsed_s * gtsam.Pose3.Logmap(poses[n - 1].between(poses[n]))
        more = output.covariance - exact.covariance
        np.testing.assert_allclose(more, np.outer(moved, moved), atol=0.2 * float(moved @ moved))
        checked += 1
    assert checked > 3


def test_a_search_makes_one_tile_per_reading(known_map: MapContents) -> None:
    sensor = CloudSensor(known_map, None, CONFIG)
    pose = drive(OTHER)[4]
    (cloud,) = seen([pose], 7)
    points = cloud.T_base_lidar.translation() + cloud.points_lidar.astype(np.float64)
    made = [0]
    for place in sensor.propose(CloudView.of(points, cloud.T_base_lidar, sensor.voxel_m), [], None):
        made.append(sensor._tiles.made)
        if place is not None:
            break
    assert len(made) > 2 and max(np.diff(made)) == 1
