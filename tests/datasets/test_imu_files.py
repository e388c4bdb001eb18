"""Text files of IMUs beside clouds, and IMUs in bags: columns, units, clocks, what is used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags.bag_writing import Sent, cloud, scan, write_bag
from point_files import write_ply

from slam.config.stages import SensorsConfig
from slam.datasets import open_dataset
from slam.datasets.bags.imu import NO_VALUES, NOT_BOTH, paired_halves
from slam.datasets.imu_files import BAD_ROW, NO_RATES
from slam.datasets.inspection import inspect_dataset
from slam.datasets.kitti_raw import ONCE_A_CLOUD
from slam.datasets.sensor_choice import SensorChoice
from slam.evaluation.pages import inspection_text
from slam.measurements import ImuReading, PointCloud, RgbdFrame
from tools.pack_layouts import put
from tools.pack_lidars import LIDARS, Turns

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


def test_accelerations_in_g_are_reported_and_read(tmp_path: Path) -> None:
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


WITH_IMU = sorted(set(LIDARS) - {"numbered", "oxford_spires"})


def turns(steps: int = 20) -> Turns:
    """Two clouds, and an IMU that rolls, sinks and stands still."""
    rows = np.zeros((steps, 7))
    rows[:, 0] = 0.01 * np.arange(steps)
    rows[:, 1:] = [0.1, 0.2, 0.3, 1.0, 2.0, 9.5]
    rows[:, 1] += rows[:, 0]
    clouds = [np.arange(150.0, dtype=np.float32).reshape(-1, 3)] * 2
    times = [np.linspace(0, 0.09, 50)] * 2
    return Turns([0.0, 0.1], clouds, times, [np.eye(4)] * 2, rows)


@pytest.mark.parametrize("name", WITH_IMU)
def test_the_imu_of_a_published_layout(name: str, tmp_path: Path) -> None:
    given = turns()
    dataset = open_dataset(LIDARS[name](tmp_path, given), strict=True)
    log = list(dataset)
    found = [one for one in log if isinstance(one, ImuReading)]
    first_s = next(one.stamp_s for one in log if isinstance(one, PointCloud))
    assert [one.stamp_s - first_s for one in found] == pytest.approx(given.imu[:, 0], abs=2e-6)
    np.testing.assert_allclose([one.gyro_rad_s for one in found], given.imu[:, 1:4])
    np.testing.assert_allclose([one.specific_force_m_s2 for one in found], given.imu[:, 4:7])
    uses = inspect_dataset(dataset)["uses"]
    assert [(use["readings"], use["why_not"]) for use in uses if use["kind"] == "IMU"] == [(20, "")]
    if name == "kitti_raw":
        assert found[0].T_base_imu is not None and found[0].T_base_imu.x() == pytest.approx(-0.8)
    elif name == "boreas":  # raw axes to those of the Applanix, and from there into the lidar's
        assert found[0].T_base_imu is not None
        into_lidar = found[0].T_base_imu.rotation().matrix()
        np.testing.assert_allclose(into_lidar, [[-1, 0, 0], [0, 1, 0], [0, 0, -1]], atol=1e-9)
        assert found[0].T_base_imu.z() == pytest.approx(-0.13)
    else:
        assert found[0].T_base_imu is None


def test_what_is_no_imu_is_named_with_its_reason(tmp_path: Path) -> None:
    def reasons(path: Path) -> dict[str, str]:
        dataset = open_dataset(path, strict=True)
        assert not any(isinstance(one, ImuReading) for one in dataset)
        return dataset.report.reasons

    plain = replace(turns(), imu=np.zeros((0, 7)))
    assert reasons(LIDARS["kitti_raw"](tmp_path / "kitti", plain)) == {"oxts": ONCE_A_CLOUD}
    mulran = LIDARS["mulran"](tmp_path / "mulran", plain)
    put(mulran / "sensor_data" / "xsens_imu.csv", "1561000444000000000,0,0,0,1,0,0,0\n")
    assert reasons(mulran) == {"xsens_imu.csv": NO_RATES}
    boreas = LIDARS["boreas"](tmp_path / "boreas", plain)
    put(boreas / "applanix" / "imu.csv", "GPSTime,angvel_z,angvel_y,angvel_x,accelz,accely,accelx\n")
    assert "gravity" in reasons(boreas)["imu.csv"]


def test_sensors_are_found_from_a_folder_above_or_below(tmp_path: Path) -> None:
    helipr = LIDARS["helipr"](tmp_path / "helipr", turns())
    assert len(imu_of(helipr / "LiDAR" / "Ouster")) == len(imu_of(helipr / "LiDAR")) == 20
    newer = LIDARS["newer_college"](tmp_path / "newer", turns())
    assert len(imu_of(newer / "raw_format" / "ouster_scan")) == len(imu_of(newer / "raw_format")) == 20
    mulran = LIDARS["mulran"](tmp_path / "mulran", turns())
    (mulran / "Ouster").rename(mulran / "sensor_data" / "Ouster")
    assert len(imu_of(mulran)) == 20


def test_the_second_imu_of_boreas_comes_before_that_of_its_truth(tmp_path: Path) -> None:
    path = LIDARS["boreas"](tmp_path, turns())
    rows = "".join(f"{1606417097000000000 + 10**7 * n},.1,.2,.3,0,0,-9.8\n" for n in range(3))
    put(path / "imu" / "dmu_imu.csv", "time,wx,wy,wz,ax,ay,az\n" + rows)
    put(path / "calib" / "T_applanix_dmu.txt", "1 0 0 0\n0 -1 0 0\n0 0 -1 -0.15\n0 0 0 1\n")
    first, *rest = imu_of(path)
    assert len(rest) == 2 and first.stamp_s == pytest.approx(1606417097.0)
    assert first.T_base_imu is not None and first.T_base_imu.z() == pytest.approx(-0.28)
    assert first.T_base_imu.rotation().rotate(first.specific_force_m_s2)[2] == pytest.approx(9.8)


def test_a_camera_alone_takes_an_imu_too() -> None:
    rgbd = RgbdFrame.__new__(RgbdFrame)
    object.__setattr__(rgbd, "stamp_s", 1.0)
    object.__setattr__(rgbd, "sensor", "camera")
    reading = ImuReading(1.0, np.zeros(3), np.ones(3))
    choice = SensorChoice.of([rgbd, reading], SensorsConfig())
    assert choice.spatial and choice.imu == "imu" and not choice.why_not(ImuReading, "imu")


def half(topic: str, stamp_s: float, rates: float = 0.0, forces: float = 0.0) -> Sent:
    """A message that shows one of the two, as the driver of RealSense does by default."""
    fields = {
        "angular_velocity": {"x": rates, "y": 0.0, "z": 0.0},
        "linear_acceleration": {"x": 0.0, "y": forces, "z": 0.0},
    }
    return Sent(topic, "sensor_msgs/msg/Imu", 1000.0 + stamp_s, fields, "imu")


RATES, FORCES = "/camera/gyro/sample", "/camera/accel/sample"


@pytest.mark.parametrize(
    ("rates", "forces"),
    [(RATES, FORCES), ("/device_0/sensor_2/Gyro_0/imu/data", "/device_0/sensor_2/Accel_0/imu/data")],
)
def test_an_imu_on_two_topics_is_joined(tmp_path: Path, rates: str, forces: str) -> None:
    # The gyroscope reads zero at first; accelerations rise by 1 a hundredth, turn rates by 0.1.
    sent = [half(rates, 0.0025 * n, rates=0.1 * n) for n in range(14)]
    sent += [half(forces, 0.005 + 0.01 * n, forces=9.0 + n) for n in range(3)]
    sent += [cloud(dict(zip("xyz", POINTS.T, strict=True)), 1000.0 + 0.01 * n) for n in range(4)]
    sent.sort(key=lambda one: one.stamp_s)
    dataset = open_dataset(write_bag(tmp_path / "log", "mcap", sent))
    for _ in range(2):
        found = [one for one in dataset if isinstance(one, ImuReading)]
        assert [one.stamp_s - 1000.0 for one in found] == pytest.approx(np.arange(2, 11) * 0.0025, abs=1e-6)
        assert [one.gyro_rad_s[0] for one in found] == pytest.approx(0.1 * np.arange(2, 11))
        assert [one.specific_force_m_s2[1] for one in found] == pytest.approx(
            9.0 + 0.25 * np.arange(9), abs=1e-4
        )
        assert {one.sensor for one in found} == {rates} and not dataset.report.dropped
        (note,) = [note for note in dataset.report.notes if "joined" in note]
        assert forces in note and "5 angular rates" in note
    uses = {use["sensor"]: use["why_not"] for use in inspect_dataset(dataset)["uses"]}
    assert uses[rates] == uses[forces] == ""


def test_accelerations_are_not_bridged_over_a_gap(tmp_path: Path) -> None:
    sent = [half(RATES, 0.01 * n, rates=0.1) for n in range(100)]
    sent += [half(FORCES, stamp_s, forces=9.8) for stamp_s in (0.0, 0.1, 0.8, 0.9)]
    sent.sort(key=lambda one: one.stamp_s)
    found = imu_of(write_bag(tmp_path / "log", "mcap", sent))
    assert len(found) == 22 and not any(1000.101 < one.stamp_s < 1000.799 for one in found)


@pytest.mark.parametrize("others", ["", ",userAcceleration_x,userAcceleration_y,userAcceleration_z"])
def test_a_file_without_accelerations_has_a_gyroscope(tmp_path: Path, others: str) -> None:
    rest = ",1,2,3" if others else ""
    text = f"time,gyro_x,gyro_y,gyro_z{others}\n100.5,0.1,0.2,0.3{rest}\n100.6,0.1,0.2,nan{rest}\n"
    (reading,) = imu_of(folder(tmp_path, "imu.csv", text))
    assert reading.gyro_rad_s.tolist() == [0.1, 0.2, 0.3] and not reading.specific_force_m_s2.any()


def test_half_an_imu_is_used_with_its_other_half(tmp_path: Path) -> None:
    scans = [scan(stamp_s=1000.0 + 0.1 * n) for n in range(4)]
    sent = [half(RATES, 0.1 * n, rates=0.1) for n in range(4)]
    dataset = open_dataset(write_bag(tmp_path / "alone", "mcap", [*scans, *sent]))
    alone = [one for one in dataset if isinstance(one, ImuReading)]
    assert len(alone) == 4 and all(
        one.gyro_rad_s.any() and not one.specific_force_m_s2.any() for one in alone
    )
    assert not any("in g" in note for note in dataset.report.notes)
    idle = [half(RATES, 0.1 * n) for n in range(4)]
    dataset = open_dataset(write_bag(tmp_path / "idle", "mcap", [*scans, *idle]))
    list(dataset)
    assert dataset.report.reasons[f"{RATES} (sensor_msgs/msg/Imu)"] == NO_VALUES
    sent += [half(FORCES, 0.1 * n, forces=9.8) for n in range(4)]
    both = open_dataset(
        write_bag(tmp_path / "both", "mcap", sorted([*scans, *sent], key=lambda s: s.stamp_s))
    )
    reasons = [use["why_not"] for use in inspect_dataset(both)["uses"] if use["sensor"] in (RATES, FORCES)]
    assert reasons == ["", ""]


def test_halves_are_paired_by_name_and_a_whole_imu_is_none() -> None:
    stated = {"/a/gyro": (False, False), "/b/gyro": (True, False), "/imu": (True, True)}
    stated |= {"/b/accel": (False, True), "/a/accel": (False, True)}
    assert paired_halves(stated, stated) == {"/a/gyro": "/a/accel", "/b/gyro": "/b/accel"}
    del stated["/a/accel"], stated["/b/accel"]
    assert paired_halves(stated, stated) == {"/a/gyro": "", "/b/gyro": ""}
