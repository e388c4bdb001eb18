"""The IMU of a simulated robot: it feels the drive, and changes nothing of the other sensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_drive import SECONDS, fake_sensors, small_rig

from slam.datasets import open_dataset
from slam.measurements import GRAVITY_M_S2, ImuReading
from slam.simulation.drive import prepare_drive
from slam.simulation.drive_faults import FAULT_PRESETS, DriveFaults
from slam.simulation.home import generate_home
from slam.simulation.imu import ImuFaults, ImuModel, MountedImu
from slam.simulation.record import record_drive
from slam.simulation.rigs import ROBOT_IMU

HOME = generate_home(0)


@pytest.fixture(autouse=True, scope="module")
def _cheap_sensors() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        fake_sensors(patch)
        yield


def test_other_sensors_stay_as_they_are_to_the_byte(tmp_path: Path) -> None:
    faults = FAULT_PRESETS["usual"]
    for name, imu in (("without", None), ("with", ROBOT_IMU)):
        record_drive(HOME, replace(small_rig(), imu=imu), 7, tmp_path / name, faults, SECONDS)
    files = {
        name: {
            str(path.relative_to(tmp_path / name)): path.read_bytes()
            for path in sorted((tmp_path / name).rglob("*"))
            if path.is_file() and path.suffix != ".mcap" and path.name != "metadata.yaml"
        }
        for name in ("without", "with")
    }
    added = {"imu0/data.csv", "imu0/calibration.yaml"}
    assert files["with"].keys() - files["without"].keys() == added
    assert all(files["with"][name] == content for name, content in files["without"].items())
    for log in ("with", "with/log.mcap"):
        said = [one for one in open_dataset(tmp_path / log) if isinstance(one, ImuReading)]
        assert len(said) == pytest.approx(200.0 * SECONDS, abs=1)
        stated = said[0].T_base_imu
        assert stated is not None and stated.equals(ROBOT_IMU.T_body_imu, 1e-6)


def test_turn_rates_integrate_to_the_drive_and_forces_to_gravity() -> None:
    faults = DriveFaults(imu=ImuFaults(gyro_excess=0.5))
    perfect = MountedImu(ImuModel(200.0), ROBOT_IMU.T_body_imu)
    drive = prepare_drive(HOME, replace(small_rig(), imu=perfect), 7, faults, 20.0)
    assert drive.imu is not None
    rates = drive.imu.gyro_rad_s @ ROBOT_IMU.T_body_imu.rotation().matrix().T
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (rates[1:, 2] + rates[:-1, 2]) * 0.005)]) / 1.5
    true = drive.tour.poses_at(drive.imu.true_s)[:, 2]
    assert np.ptp(true) > 0.5
    assert turned == pytest.approx(true - true[0], abs=2e-3)
    assert np.abs(rates[:, :2]).max() < 1e-9
    force = np.linalg.norm(drive.imu.specific_force_m_s2, axis=1)
    assert force == pytest.approx(GRAVITY_M_S2, abs=0.2)
