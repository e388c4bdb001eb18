"""Text files of IMUs beside clouds, and IMUs in bags: columns, units, clocks, what is used."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags.bag_writing import Sent, write_bag
from point_files import write_ply

from slam.config.stages import SensorsConfig
from slam.datasets import open_dataset
from slam.datasets.bags.imu import NOT_BOTH
from slam.datasets.imu_files import BAD_ROW
from slam.datasets.inspection import inspect_dataset
from slam.datasets.sensor_choice import SensorChoice
from slam.evaluation.pages import inspection_text
from slam.measurements import ImuReading, PointCloud

POINTS = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.float32)
EUROC = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
EUROC += "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"


def folder(path: Path, name: str, text: str, first_s: float = 100.0) -> Path:
    """Three clouds, a second apart, and the file of an IMU."""
    for n in range(3):
        write_ply(path / f"{n}.ply", {name: POINTS[:, k] for k, name in enumerate("xyz")})
    (path / "times.txt").write_text("".join(f"{first_s + n}\n" for n in range(3)))
    (path / name).parent.mkdir(exist_ok=True)
    (path / name).write_text(text)
    return path


def imu_of(path: Path) -> list[ImuReading]:
    return [one for one in open_dataset(path) if isinstance(one, ImuReading)]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("imu0/data.csv", EUROC + "100500000000,0.1,0.2,0.3,1,2,9.5\n"),
        ("imu0/data.csv", "1403636579500000000,0.1,0.2,0.3,1,2,9.5\n"),
        (
            "imu.csv",
            "counter,sec,nsec,ang_x,ang_y,ang_z,lin_x,lin_y,lin_z\n7,100,500000000,.1,.2,.3,1,2,9.5\n",
        ),
        ("imu.csv", "time,acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z\n100.5,1,2,9.5,0.1,0.2,0.3\n"),
        ("imu.txt", "# timestamp gx gy gz ax ay az\n100.5 0.1 0.2 0.3 1 2 9.5\n"),
        (
            "imu.csv",
            "t,wx [deg/s],wy [deg/s],wz [deg/s],ax,ay,az\n100.5,5.729578,11.459156,17.188734,1,2,9.5\n",
        ),
    ],
)
def test_the_columns_of_published_files(tmp_path: Path, name: str, text: str) -> None:
    (reading,) = imu_of(folder(tmp_path, name, text))
    assert reading.stamp_s in (pytest.approx(100.5), pytest.approx(1403636579.5, abs=1e-6))
    assert reading.gyro_rad_s == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)
    assert reading.specific_force_m_s2 == pytest.approx([1.0, 2.0, 9.5])
    assert reading.T_base_imu is None


def test_accelerations_in_g_are_told_and_read(tmp_path: Path) -> None:
    path = folder(tmp_path, "imu.csv", "100.5,0,0,0,0,0,1.01\n100.6,0,0,0,0,0,2.5\n")
    assert [one.specific_force_m_s2[2] for one in imu_of(path)] == pytest.approx([9.905, 24.517], abs=1e-3)
    assert "in g" in inspection_text(inspect_dataset(open_dataset(path)))


def test_damaged_lines_are_counted_and_the_mounting_is_beside(tmp_path: Path) -> None:
    path = folder(
        tmp_path, "imu/data.csv", EUROC + "1005,x\n100500000000,0,0,nan,0,0,9.8\n100500000000,0,0,0,0,0,9.8\n"
    )
    mounting = "T_base_imu: {translation_m: [0.1, 0, 0.2], quaternion_xyzw: [0, 0, 0, 1]}\n"
    (path / "imu" / "calibration.yaml").write_text(mounting)
    dataset = open_dataset(path)
    (reading,) = [one for one in dataset if isinstance(one, ImuReading)]
    assert dataset.report.dropped[BAD_ROW].count == 2
    assert reading.T_base_imu is not None and reading.T_base_imu.x() == pytest.approx(0.1)


def test_readings_come_before_the_cloud_whose_turn_they_cover(tmp_path: Path) -> None:
    rows = "".join(f"{100.0 + 0.01 * n:.2f},0,0,0,0,0,9.8\n" for n in range(210))
    log = list(open_dataset(folder(tmp_path, "imu.csv", rows)))
    newest_s = 0.0
    for one in log:
        if isinstance(one, ImuReading):
            newest_s = one.stamp_s
        elif isinstance(one, PointCloud):
            assert newest_s >= min(one.stamp_s + 0.2, 102.09)
    choice = SensorChoice.of(log, SensorsConfig())
    assert choice.cloud and choice.imu == "imu" and not choice.why_not(ImuReading, "imu")
    assert "sensors.imu" in SensorChoice.of(log, SensorsConfig(imu=False)).why_not(ImuReading, "imu")


def test_an_imu_of_a_bag(tmp_path: Path) -> None:
    def sent(n: int, up: float, covariance: float = 0.0) -> Sent:
        fields = {
            "angular_velocity": {"x": 0.1, "y": 0.2, "z": 0.3},
            "linear_acceleration": {"x": 0.0, "y": 0.0, "z": up},
            "linear_acceleration_covariance": np.array([covariance, *[0.0] * 8]),
        }
        return Sent("/imu", "sensor_msgs/msg/Imu", 1000.0 + 0.01 * n, fields, "imu")

    path = write_bag(tmp_path / "log", "mcap", [sent(0, 1.0), sent(1, 0.98), sent(2, 1.0, -1.0)])
    dataset = open_dataset(path)
    found = [one for one in dataset if isinstance(one, ImuReading)]
    assert [one.specific_force_m_s2[2] for one in found] == pytest.approx([9.80665, 9.6105], abs=1e-3)
    assert found[0].gyro_rad_s == pytest.approx([0.1, 0.2, 0.3]) and found[0].sensor == "/imu"
    assert dataset.report.dropped[NOT_BOTH].count == 1
    assert any("in g" in note for note in dataset.report.notes)
