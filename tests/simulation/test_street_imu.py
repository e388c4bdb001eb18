"""The IMU of a street: readings integrate to the drive, faults are those asked for, readers read it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.datasets import open_dataset
from slam.measurements import GRAVITY_M_S2, FloatArray, ImuReading
from slam.simulation.drive import FIRST_STAMP_S
from slam.simulation.imu import ImuFaults, ImuModel, MountedImu, record_imu
from slam.simulation.sensor_clock import generator
from slam.simulation.street import STREET_FAULTS, STREET_RIGS, StreetFaults, record_street
from slam.simulation.street_drive import StreetDrive, drive_street
from slam.simulation.street_plan import generate_town

HOME, SEED = 2, 1
IDEAL = MountedImu(ImuModel(200.0), gtsam.Pose3(gtsam.Rot3.Ypr(1.5, 0.1, -0.2), np.array([-0.8, 0.3, -0.8])))


@pytest.fixture(scope="module")
def drive() -> StreetDrive:
    return drive_street(generate_town(HOME), generator(SEED, "street", HOME))


def standing(times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    return np.repeat(np.eye(3)[None], len(times_s), axis=0), np.zeros((len(times_s), 3))


def test_readings_without_noise_integrate_to_the_drive(drive: StreetDrive) -> None:
    stated = record_imu(IDEAL, drive.poses_at, ImuFaults(), 12.0, 0.0, SEED)
    assert np.abs(stated.gyro_rad_s).max() > 0.6  # round a corner

    def state(time_s: float) -> gtsam.NavState:
        ends = []
        for late_s in (-1e-4, 0.0, 1e-4):
            (rotation,), (position,) = drive.poses_at(np.array([time_s + late_s]))
            ends.append(gtsam.Pose3(gtsam.Rot3(rotation), position).compose(IDEAL.T_body_imu))
        return gtsam.NavState(ends[1], (ends[2].translation() - ends[0].translation()) / 2e-4)

    parameters = gtsam.PreintegrationParams.MakeSharedU(GRAVITY_M_S2)
    whole = gtsam.PreintegratedImuMeasurements(parameters, gtsam.imuBias.ConstantBias())
    rows = np.hstack([stated.specific_force_m_s2, stated.gyro_rad_s])
    for row, step_s in zip(0.5 * (rows[1:] + rows[:-1]), np.diff(stated.true_s), strict=True):
        whole.integrateMeasurement(row[:3], row[3:], float(step_s))
    end = whole.predict(state(stated.true_s[0]), gtsam.imuBias.ConstantBias())
    true = state(stated.true_s[-1])
    assert np.linalg.norm(end.pose().translation() - true.pose().translation()) < 0.05
    assert np.linalg.norm(gtsam.Rot3.Logmap(end.pose().rotation().between(true.pose().rotation()))) < 1e-3


def test_noise_and_biases_are_those_of_model_and_faults() -> None:
    model = ImuModel(200.0, 1e-3, 1e-2)
    imu = MountedImu(model, gtsam.Pose3(gtsam.Rot3.Roll(0.5 * np.pi), np.ones(3)))
    stated = record_imu(imu, standing, ImuFaults(0.02, 0.3, 0.25), 60.0, 100.0, SEED)
    assert stated.stamps_s - stated.true_s == pytest.approx(100.25, abs=1e-6)
    off = stated.specific_force_m_s2.mean(axis=0) - [0.0, GRAVITY_M_S2, 0.0]
    assert np.linalg.norm(off) == pytest.approx(0.3, rel=0.05)
    assert np.linalg.norm(stated.gyro_rad_s.mean(axis=0)) == pytest.approx(0.02, rel=0.05)
    assert stated.gyro_rad_s.std(axis=0) == pytest.approx(1e-3 * 200.0**0.5, rel=0.05)
    assert stated.specific_force_m_s2.std(axis=0) == pytest.approx(1e-2 * 200.0**0.5, rel=0.05)


def test_biases_wander_and_axes_saturate() -> None:
    imu = MountedImu(ImuModel(200.0, gyro_walk=1e-2, most_force_m_s2=5.0), gtsam.Pose3())
    ends = [record_imu(imu, standing, ImuFaults(), 4.0, 0.0, seed).gyro_rad_s[-1] for seed in range(60)]
    assert np.std(ends) == pytest.approx(1e-2 * 4.0**0.5, rel=0.2)
    assert record_imu(imu, standing, ImuFaults(), 1.0, 0.0, SEED).specific_force_m_s2[:, 2].max() == 5.0


def test_bag_and_folder_show_the_same_readings_where_the_imu_sits(tmp_path: Path) -> None:
    faults = replace(STREET_FAULTS["usual"], density=0.0)
    record_street(HOME, SEED, tmp_path / "street", STREET_RIGS["car16"], faults, 0.3)
    (tmp_path / "folder").mkdir()
    for name in ("velodyne", "imu0", "times.txt", "calib.txt", "poses.txt"):
        (tmp_path / "street" / name).rename(tmp_path / "folder" / name)
    bag, folder = (
        [reading for reading in open_dataset(path) if isinstance(reading, ImuReading)]
        for path in (tmp_path / "street" / "log.mcap", tmp_path / "folder")
    )
    assert len(bag) == len(folder) == 60
    assert FIRST_STAMP_S < bag[0].stamp_s < FIRST_STAMP_S + 0.01
    rig = STREET_RIGS["car16"].imu
    assert rig is not None
    for one, other in zip(bag, folder, strict=True):
        assert one.stamp_s == pytest.approx(other.stamp_s, abs=1e-6)
        assert one.gyro_rad_s == pytest.approx(other.gyro_rad_s)
        assert one.specific_force_m_s2 == pytest.approx(other.specific_force_m_s2)
        assert one.T_base_imu is not None and one.T_base_imu.equals(rig.T_body_imu, 1e-9)
        assert other.T_base_imu is not None and other.T_base_imu.equals(rig.T_body_imu, 1e-9)


def test_a_car_may_go_without_one(tmp_path: Path) -> None:
    rig = replace(STREET_RIGS["car16"], imu=None)
    record_street(HOME, SEED, tmp_path / "street", rig, StreetFaults(), 0.1)
    assert not (tmp_path / "street" / "imu0").exists()
    assert not any(isinstance(reading, ImuReading) for reading in open_dataset(tmp_path / "street"))
