"""The gyroscope of a robot on a floor, judged beside its 2D lidar."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import gtsam
import numpy as np
import pytest
from gyro_world import beside, imu_of
from imu_world import T_BASE_IMU

from slam.config.calibration import Calibration
from slam.datasets import open_dataset
from slam.datasets.corrections import corrected
from slam.doctor.diagnosis import diagnose
from slam.doctor.finding import Finding, remedied
from slam.measurements import GRAVITY_M_S2, ImuReading, LaserScan, Measurement, WheelOdometry
from slam.simulation.synthetic_log import write_synthetic_log

Change = Callable[[ImuReading], ImuReading]


@cache
def drive() -> tuple[list[Measurement], list[ImuReading]]:
    with TemporaryDirectory() as folder:
        log = write_synthetic_log(Path(folder), seed=1, duration_s=45.0)
        return list(open_dataset(log.log_path)), imu_of(log.truth)


def turned(factor: float) -> Change:
    return lambda one: replace(one, gyro_rad_s=factor * one.gyro_rad_s)


def with_imu(change: Change, *, wheels: bool = True) -> list[Measurement]:
    log, said = drive()
    return beside([one for one in log if wheels or not isinstance(one, WheelOdometry)], said, change)


def of_imu(log: list[Measurement]) -> list[Finding]:
    found = diagnose(log)
    assert {one.sensor for one in found} <= {"imu"}
    return found


@pytest.mark.parametrize("wheels", [True, False])
def test_nothing_is_wrong_with_a_sound_one(wheels: bool) -> None:
    assert of_imu(with_imu(lambda one: one, wheels=wheels)) == []


@pytest.mark.parametrize(
    ("change", "said", "scale"),
    [
        (turned(-1.0), "wrong sign", -1.0),
        (turned(180.0 / np.pi), "degrees", np.pi / 180.0),
        (turned(-180.0 / np.pi), "degrees and of the wrong sign", -np.pi / 180.0),
        (turned(2.0), "2.0. times too large", 0.5),
    ],
)
@pytest.mark.parametrize("wheels", [True, False])
def test_turn_rates_are_mended(change: Change, said: str, scale: float, wheels: bool) -> None:
    wrong = with_imu(change, wheels=wheels)
    (finding,) = of_imu(wrong)
    assert finding.kind == "turn rates" and finding.value == pytest.approx(scale, rel=0.03)
    # Without wheels nobody shows whether the lidar is upside down instead.
    assert finding.sure == (wheels or scale > 0.0) and len(finding.remedies) == (1 if finding.sure else 2)
    assert re.search(said, finding.text)
    assert of_imu(list(corrected(wrong, remedied(Calibration(), [finding], only_sure=False)))) == []


def upside_down(one: Measurement) -> Measurement:
    return replace(one, ranges_m=one.ranges_m[::-1].copy()) if isinstance(one, LaserScan) else one


def left_for_right(one: Measurement) -> Measurement:
    if not isinstance(one, WheelOdometry):
        return one
    pose = one.T_odom_base
    return replace(one, T_odom_base=gtsam.Pose2(pose.x(), -pose.y(), -pose.theta()))


@pytest.mark.parametrize(("mirrored", "kind"), [(upside_down, "lidars"), (left_for_right, "wheels")])
def test_an_imu_shows_who_is_mirrored(mirrored: Callable[[Measurement], Measurement], kind: str) -> None:
    wrong = [mirrored(one) for one in with_imu(lambda one: one)]
    (finding,) = diagnose(wrong)
    (remedy,) = finding.remedies
    assert finding.kind == "mirrored" and finding.sure and list(remedy) == [kind]
    assert diagnose(list(corrected(wrong, remedied(Calibration(), [finding], only_sure=True)))) == []
    # One that nobody understands is no witness.
    (finding, _) = diagnose([mirrored(one) for one in with_imu(turned(0.0))])
    assert finding.kind == "mirrored" and len(finding.remedies) == 2


@pytest.mark.parametrize("ahead_s", [0.05, -0.2])
def test_a_clock_is_reported_and_mended(ahead_s: float) -> None:
    wrong = with_imu(lambda one: replace(one, stamp_s=one.stamp_s + ahead_s))
    (finding,) = of_imu(wrong)
    low_s, high_s = finding.interval or (0.0, 0.0)
    assert finding.kind == "clock" and low_s <= ahead_s <= high_s and high_s - low_s < 0.03
    assert of_imu(list(corrected(wrong, remedied(Calibration(), [finding], only_sure=True)))) == []


def without_gravity(one: ImuReading) -> ImuReading:
    rest = T_BASE_IMU.rotation().unrotate(np.array([0.0, 0.0, GRAVITY_M_S2]))
    return replace(one, specific_force_m_s2=one.specific_force_m_s2 - rest)


def weightless(one: ImuReading) -> ImuReading:
    return replace(one, specific_force_m_s2=np.zeros(3))


def test_without_gravity_the_vertical_is_that_of_the_mounting() -> None:
    wrong = with_imu(without_gravity)
    (finding,) = of_imu(wrong)
    assert finding.kind == "forces" and finding.sure
    assert of_imu(list(corrected(wrong, remedied(Calibration(), [finding], only_sure=True)))) == []
    assert of_imu(with_imu(weightless)) == []
    (finding,) = of_imu(with_imu(lambda one: turned(-1.0)(weightless(one))))
    assert finding.kind == "turn rates" and finding.value == pytest.approx(-1.0, rel=0.03)
    (finding,) = of_imu(with_imu(lambda one: replace(weightless(one), gyro_rad_s=np.roll(one.gyro_rad_s, 1))))
    assert finding.kind == "axes" and "mounting" in finding.text
    aside = gtsam.Pose3(gtsam.Rot3(np.roll(np.eye(3), 1, axis=0).T), np.zeros(3))
    told = with_imu(
        lambda one: replace(weightless(one), gyro_rad_s=np.roll(one.gyro_rad_s, 1), T_base_imu=aside)
    )
    assert of_imu(told) == []


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (lambda one: replace(one, gyro_rad_s=np.array([0.001, 0.0, 0.002])), "no agreement"),
        (lambda one: replace(one, gyro_rad_s=np.roll(one.gyro_rad_s, 1)), "axes"),
        (
            lambda one: replace(one, gyro_rad_s=np.sin(np.array([3.0, 7.0, 11.0]) * one.stamp_s)),
            "no agreement",
        ),
    ],
    ids=["frozen", "axes", "noise"],
)
def test_what_nothing_mends_is_left_out(change: Change, kind: str) -> None:
    (finding,) = of_imu(with_imu(change))
    assert finding.kind == kind and finding.sure
    assert finding.remedies == ({"imus": {"imu": {"use": False}}},)
