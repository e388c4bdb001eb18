"""A camera in the hand with an IMU beside it: its map stands upright."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest
from imu_world import T_BASE_IMU, readings
from room_world import LESS, furnished, render, write_tum_folder
from scipy.spatial.transform import Rotation

from slam.app.mapping import Measured
from slam.config import load_config
from slam.datasets import open_dataset
from slam.mapper.map_result import MapResult
from slam.mapper.pipeline import build_map
from slam.measurements import FloatArray
from slam.odometry.imu_tracker import alike
from slam.simulation.imu import ImuRecord, write_euroc
from slam.simulation.rigs import camera_pose

RATE_HZ, SECONDS = 15.0, 8.0
T_DEVICE_CAMERA = camera_pose((0.0, 0.0, 0.0))


def way(time_s: float) -> gtsam.Pose3:
    """Somebody turns on the spot and sways; the device is held askew from the beginning."""
    turn = gtsam.Rot3.Ypr(
        0.6 * time_s, 0.15 + 0.1 * np.sin(1.9 * time_s), 0.1 + 0.08 * np.sin(2.3 * time_s + 0.4)
    )
    place = np.array(
        [0.3 * np.cos(0.6 * time_s), 0.3 * np.sin(0.6 * time_s), 1.2 + 0.03 * np.sin(5 * time_s)]
    )
    return gtsam.Pose3(turn, place)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames with the camera as the robot's frame, and an IMU whose place in it is stated."""
    folder, stamps_s = tmp_path_factory.mktemp("hand") / "log", np.arange(0.5, SECONDS - 0.5, 1.0 / RATE_HZ)
    folder.mkdir()
    poses = [way(float(stamp_s)).compose(T_DEVICE_CAMERA) for stamp_s in stamps_s]
    room = furnished()
    frames = [
        render(room, pose, LESS, stamp_s=float(stamp_s), noise=(0.001, 0.0012), seed=n, smooth=False)
        for n, (stamp_s, pose) in enumerate(zip(stamps_s, poses, strict=True))
    ]
    write_tum_folder(folder / "rgbd_camera", frames, poses)
    said = list(readings(way, SECONDS))
    times_s = np.array([one.stamp_s for one in said])
    rates = np.array([one.gyro_rad_s for one in said])
    record = ImuRecord(times_s, times_s, rates, np.array([one.specific_force_m_s2 for one in said]))
    write_euroc(folder / "imu0", record, T_DEVICE_CAMERA.inverse().compose(T_BASE_IMU))
    return folder


def run(log: Path, *settings: str, until_s: float = SECONDS) -> MapResult:
    dataset = Measured([one for one in open_dataset(log) if one.stamp_s < until_s])
    return build_map(dataset, load_config(None, ["dense_map.enabled=false", *settings]))  # type: ignore[arg-type]


def lean_degrees(result: MapResult) -> FloatArray:
    """Of the map's upright, by each pose."""
    found = result.map.trajectory
    true = Rotation.from_matrix(
        [way(float(stamp_s)).compose(T_DEVICE_CAMERA).rotation().matrix() for stamp_s in found.stamps_s]
    )
    up = (true * Rotation.from_quat(found.quaternions_xyzw).inv()).apply([0.0, 0.0, 1.0])
    return np.asarray(np.degrees(np.arccos(up[:, 2])))


def test_the_map_stands_upright(log: Path) -> None:
    result = run(log)
    lean = lean_degrees(result)
    assert lean.mean() < 0.2 and lean.max() < 0.6
    assert any("gravity to" in note for note in result.notes)
    assert {use.sensor: use.why_not for use in result.uses}["imu"] == ""


def test_without_the_imu_it_leans_as_the_first_image_does(log: Path) -> None:
    assert lean_degrees(run(log, "sensors.imu=false", until_s=3.0)).min() > 5.0


def test_turns_that_differ_are_distinguished_from_errors_of_a_match() -> None:
    turn = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.zeros(3))
    assert alike(turn, gtsam.Pose3(gtsam.Rot3.Yaw(0.34), np.ones(3)))
    assert not alike(turn, gtsam.Pose3(gtsam.Rot3.Yaw(0.36), np.zeros(3)))
