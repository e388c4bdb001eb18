"""An IMU judged by itself and beside a 3D lidar."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from cloud_world import T_BASE_LIDAR as PILLARED
from cloud_world import base, look, look_on_the_way
from imu_world import T_BASE_IMU, readings, walk

from fusion.estimation import half_interval
from slam.config.calibration import Calibration
from slam.datasets.corrections import corrected
from slam.doctor.camera_samples import SensorStep
from slam.doctor.cloud_samples import CloudSamples
from slam.doctor.diagnosis import _in_space
from slam.doctor.finding import Finding, remedied
from slam.doctor.imu import ImuSamples, clock_findings, imu_findings, turn_fit
from slam.doctor.samples import Samples
from slam.doctor.turning import Turn, stamped
from slam.measurements import GRAVITY_M_S2, ImuReading, PointCloud

T_BASE_LIDAR = gtsam.Pose3(gtsam.Rot3.Yaw(0.5), np.array([0.1, 0.0, 0.3]))


def steps() -> list[SensorStep]:
    """What a lidar matches, to a milliradian."""
    rng, found = np.random.default_rng(3), []
    for n in range(10, 110):
        ends = [walk(0.1 * k).compose(T_BASE_LIDAR) for k in (n, n + 1)]
        off = gtsam.Pose3.Expmap(1e-3 * rng.standard_normal(6))
        found.append(SensorStep(0.1 * n, 0.1 * n + 0.1, ends[0].between(ends[1]).compose(off)))
    return found


def findings(said: list[ImuReading], untimed_s: float = 0.0) -> dict[str, Finding]:
    samples = ImuSamples()
    for reading in said:
        samples.add(reading)
    return {one.kind: one for one in imu_findings("imu", samples, steps(), T_BASE_LIDAR, untimed_s)}


SAID = list(readings(walk, 12.0))


def test_nothing_is_wrong_with_a_sound_one() -> None:
    assert findings(SAID) == {}


@pytest.mark.parametrize("ahead_s", [0.04, -0.2])
def test_a_clock_is_reported_with_its_interval(ahead_s: float) -> None:
    found = findings([replace(one, stamp_s=one.stamp_s + ahead_s) for one in SAID])
    assert set(found) == {"clock"}
    low_s, high_s = found["clock"].interval or (0.0, 0.0)
    assert low_s <= ahead_s <= high_s and high_s - low_s < 0.02 and found["clock"].sure


def test_a_turn_without_times_shows_a_clock_to_half_of_it() -> None:
    late = [[replace(one, stamp_s=one.stamp_s + ahead_s) for one in SAID] for ahead_s in (0.04, 0.2)]
    assert findings(late[0], untimed_s=0.1) == {}
    low_s, high_s = findings(late[1], untimed_s=0.1)["clock"].interval or (0.0, 0.0)
    assert low_s < 0.16 < 0.24 < high_s < 0.27


@pytest.mark.parametrize(("ahead_s", "moment"), [(0.05, "beginning"), (-0.047, "end")])
def test_stamps_half_a_turn_off_are_of_an_end_of_the_turn(ahead_s: float, moment: str) -> None:
    """Of a lidar whose turn was found; what an IMU is off by otherwise is the IMU's clock."""
    samples = Samples({}, {}, {}, {}, {"imu": ImuSamples()})
    samples.clouds["lidar"] = CloudSamples([steps()], turn=Turn(-0.1, 1e-3, 0.0), T_base_lidar=T_BASE_LIDAR)
    for reading in SAID:
        samples.imus["imu"].add(replace(reading, stamp_s=reading.stamp_s + ahead_s))
    found = {one.kind: one for one in _in_space(samples, None, [], vouched=False)}
    assert moment in found["clock"].text and found["clock"].sensor == "lidar"
    half_s = math.copysign(0.05, ahead_s)
    assert found["clock"].remedies == ({"lidars_3d": {"lidar": {"clock_offset_s": -half_s}}},)
    samples.clouds["lidar"].turn = Turn(-0.2, 1e-3, 0.0)
    found = {one.kind: one for one in _in_space(samples, None, [], vouched=False)}
    assert found["clock"].sensor == "imu"
    (turn,) = (one for one in _in_space(samples, None, [], vouched=False) if one.kind == "turn")
    # What remains is the start of the revolution.
    assert 0.009 < turn.remedies[0]["lidars_3d"]["lidar"]["clock_sigma_s"] < 0.011


def test_a_mounting_is_learned() -> None:
    found = findings([replace(one, T_base_imu=None) for one in SAID])
    entries = found["mounting"].remedies[0]["imus"]["imu"]["T_base_imu"]
    roll, pitch, yaw = np.degrees(T_BASE_IMU.rotation().rpy())
    assert [entries["roll_deg"], entries["pitch_deg"], entries["yaw_deg"]] == pytest.approx(
        [roll, pitch, yaw], abs=1.0
    )
    wrong = findings([replace(one, T_base_imu=gtsam.Pose3(gtsam.Rot3.Yaw(1.5), np.zeros(3))) for one in SAID])
    assert "otherwise" in wrong["mounting"].text and wrong["mounting"].sure


def test_saturation() -> None:
    found = findings([replace(one, gyro_rad_s=np.clip(one.gyro_rad_s, -0.5, 0.5)) for one in SAID])
    assert "saturates" in found["saturation"].text


def test_one_that_hangs_is_reported_and_what_it_repeats_left_out() -> None:
    hung = [*SAID[:1200], *(replace(SAID[1200], stamp_s=one.stamp_s) for one in SAID[1200:])]
    (finding,) = findings(hung).values()
    assert finding.kind == "frozen" and finding.text.startswith("1199 of 2400")
    left = list(corrected(hung, remedied(Calibration(), [finding], only_sure=True)))
    assert [one.stamp_s for one in left] == [one.stamp_s for one in SAID[:1201]]


def test_readings_that_come_twice_or_of_a_robot_that_stands_do_not_hang() -> None:
    assert findings([replace(SAID[n - n % 2], stamp_s=one.stamp_s) for n, one in enumerate(SAID)]) == {}
    samples, stood = ImuSamples(), [replace(one, motion=gtsam.Pose3()) for one in steps()]
    for reading in SAID:
        samples.add(replace(SAID[0], stamp_s=reading.stamp_s))
    assert all(one.kind != "frozen" for one in imu_findings("imu", samples, stood, T_BASE_LIDAR))


def test_turn_rates_in_degrees_beside_a_3d_lidar() -> None:
    found = findings([replace(one, gyro_rad_s=np.degrees(one.gyro_rad_s)) for one in SAID])
    (remedy,) = found["turn rates"].remedies
    assert remedy["imus"]["imu"]["gyro_scale"] == pytest.approx(np.radians(1.0), rel=1e-4)
    assert found.keys() == {"turn rates"}


def test_clouds_are_matched_for_an_imu_where_there_are_no_wheels() -> None:
    clouds = [look(walk(0.1 * n), 0.1 * n, seed=n) for n in range(4)]
    assert Samples.of([SAID[0], *clouds]).clouds["lidar"].steps[0]
    level = [replace(one, T_base_lidar=gtsam.Pose3()) for one in clouds]
    assert not Samples.of(level).clouds["lidar"].steps[0]


def test_clouds_alone_are_matched_only_if_no_floor_is_as_far_below_as_the_log_says() -> None:
    clouds = [look(base(0.05 * n, 0.0, 0.0), 0.1 * n, seed=n) for n in range(4)]
    assert not Samples.of(clouds).clouds["lidar"].steps[0]
    higher = [
        replace(one, T_base_lidar=gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 1.2]))) for one in clouds
    ]
    assert Samples.of(higher).clouds["lidar"].steps[0]


def test_the_motion_of_turns_is_between_their_middles() -> None:
    clouds = [look(walk(0.0), 0.1 * n, seed=n) for n in range(3)]
    turns = [replace(one, times_s=np.linspace(0.0, 0.1, len(one.points_lidar))) for one in clouds]
    found = Samples.of([SAID[0], *turns]).clouds["lidar"].steps[0]
    assert [step.begun_s for step in found] == pytest.approx([0.05, 0.15])


def test_straight_ways_show_nothing_of_a_clock() -> None:
    """Where a car turns the matches are off by ten times as much as on its straight way."""
    rows = np.zeros((4000, 7))
    rows[:, 0] = 0.005 * np.arange(4000)
    rows[:, 3] = 0.6 * np.exp(-((rows[:, 0] - 9.0) ** 2)) + 0.5 * np.exp(-((rows[:, 0] - 14.0) ** 2))
    turned = np.concatenate([[0.0], np.cumsum(0.0025 * (rows[1:, 3] + rows[:-1, 3]))])
    rows[:, 1:4] += 1e-4 * np.random.default_rng(1).standard_normal((4000, 3))
    within = 0
    for seed in range(20):
        rng, said = np.random.default_rng(seed), []
        for begun_s in np.arange(1.0, 19.0, 0.1):
            first, last = np.interp([begun_s, begun_s + 0.1], rows[:, 0], turned)
            off = (2e-4 + 0.05 * (last - first)) * rng.standard_normal(3)
            turn = gtsam.Rot3.Expmap(np.array([0.0, 0.0, last - first]) + off)
            said.append(SensorStep(begun_s, begun_s + 0.1, gtsam.Pose3(turn, np.zeros(3))))
        fit = turn_fit(rows, said)
        assert fit is not None
        within += abs(fit.ahead_s) <= half_interval(fit.ahead_sigma_s)
    assert within >= 14  # with the spread of all steps for that of those with information, 2


def test_one_corner_on_a_straight_way_shows_the_clock() -> None:
    """What is left over of most steps is the same at any time."""
    rows = np.zeros((3000, 7))
    rows[:, 0] = 0.005 * np.arange(3000)
    rows[:, 3] = 1.3 * np.exp(-(((rows[:, 0] - 12.0) / 0.6) ** 4))
    turned = np.cumsum(0.005 * rows[:, 3])
    rows[:, 1:4] += 3e-3 * np.random.default_rng(1).standard_normal((3000, 3))
    for seed in range(10):
        rng, said = np.random.default_rng(seed), []
        for begun_s in np.arange(1.0, 14.0, 0.1):
            turn_rad = float(np.diff(np.interp([begun_s, begun_s + 0.1], rows[:, 0], turned))[0])
            turn = gtsam.Rot3.Expmap(np.array([0.0, 0.0, turn_rad]) + 5e-4 * rng.standard_normal(3))
            said.append(SensorStep(begun_s, begun_s + 0.1, gtsam.Pose3(turn, np.zeros(3))))
        fit = turn_fit(rows, said)
        assert fit is not None and abs(fit.ahead_s) < 0.005


def test_a_clock_that_three_turns_show_is_as_uncertain_as_three_are() -> None:
    """Nearly all steps turn evenly and reveal no time."""
    rng, within = np.random.default_rng(1), 0
    stamps_s = np.arange(0.0, 30.0, 0.005)
    rate = np.interp(
        stamps_s, [0.0, 5.0, 5.3, 15.0, 15.3, 22.0, 22.3, 30.0], [0, 0, 0.8, 0.8, 0, 0, -0.8, -0.8]
    )
    rows = np.column_stack(
        [stamps_s, np.zeros((len(rate), 2)), rate, np.tile([0.0, 0.0, 9.8], (len(rate), 1))]
    )
    angle = np.cumsum(rate) * 0.005
    for _ in range(40):
        said = []
        for begun_s in np.arange(1.0, 29.0, 0.3):
            turn = float(np.diff(np.interp([begun_s, begun_s + 0.3], stamps_s, angle))[0])
            off = 2e-3 * rng.standard_normal(3)
            said.append(
                SensorStep(
                    begun_s,
                    begun_s + 0.3,
                    gtsam.Pose3(gtsam.Rot3.Rz(turn) * gtsam.Rot3.Expmap(off), np.zeros(3)),
                )
            )
        fit = turn_fit(rows, said)
        assert fit is not None
        within += abs(fit.ahead_s) <= half_interval(fit.ahead_sigma_s)
    assert within >= 24  # as a normal interval 20: errors of so few are still estimated a little too small


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_that_hardly_turns_reports_no_mounting(seed: int) -> None:
    rng = np.random.default_rng(seed)
    swaying = 3e-3 * np.cumsum(rng.standard_normal((110, 3)), axis=0)
    straight = [
        SensorStep(
            0.1 * n, 0.1 * n + 0.1, gtsam.Pose3.Expmap(np.array([*(1e-3 * rng.standard_normal(3)), 0, 0, 0]))
        )
        for n in range(10, 110)
    ]
    samples = ImuSamples()
    for one in SAID:
        turn = 0.1 * swaying[min(int(10 * one.stamp_s), 109)] + 0.01 * rng.standard_normal(3)
        samples.add(replace(one, gyro_rad_s=turn))
    found = imu_findings("imu", samples, straight, T_BASE_LIDAR)
    assert "mounting" not in {one.kind for one in found}


def test_a_stretch_begins_as_fast_as_the_robot_is() -> None:
    """Clouds taken on the way: the first step is as true as those after it."""
    twist, samples = np.array([0.0, 0.0, 1.5, 0.4, 0.0, 0.0]), CloudSamples()
    for n in range(5):
        pose = base(-1.2, -0.8, 0.3).compose(gtsam.Pose3.Expmap(0.1 * n * twist))
        samples.add(look_on_the_way(pose, twist, 0.1 * n, seed=n))
    samples.close(compared=True)
    true = PILLARED.inverse().compose(gtsam.Pose3.Expmap(0.1 * twist)).compose(PILLARED)
    (stretch,) = samples.steps
    offs = [gtsam.Pose3.Logmap(true.between(step.motion)) for step in stretch]
    assert len(offs) == 4 and max(np.linalg.norm(off[:3]) for off in offs) < 0.002


def test_only_stretches_that_are_kept_are_matched() -> None:
    """Of a long log every second stretch is given up, and no cloud is kept whole."""
    samples, points = CloudSamples(), np.zeros((32_000, 3), np.float32)
    for n in range(300):
        points = points + np.float32(1.0)
        samples.add(PointCloud(0.1 * n, points))
    kept = [cloud for stretch in samples.clouds for cloud in stretch]
    assert len(samples.clouds) == len(samples.points) < 10 and len(kept) < 200
    assert all(cloud.points_lidar.base is None for cloud in kept)
    samples.close(compared=True)
    assert len(samples.steps) == len(samples.points) and not samples.clouds


def test_no_clock_is_reported_for_turns_that_nothing_explains() -> None:
    assert "clock" not in findings([replace(one, stamp_s=one.stamp_s + 1.0) for one in SAID])


@pytest.mark.parametrize("unit", [1e-3, 1.0 / GRAVITY_M_S2])
def test_accelerations_without_gravity_or_in_another_unit_are_found(unit: float) -> None:
    found = findings([replace(one, specific_force_m_s2=unit * one.specific_force_m_s2) for one in SAID])
    assert found["forces"].sure and found["forces"].remedies == ({"imus": {"imu": {"force_scale": 0.0}}},)


@pytest.mark.parametrize("scale", [0.88, 1.15])
def test_turn_rates_some_percent_too_large_are_found(scale: float) -> None:
    found = findings([replace(one, gyro_rad_s=scale * one.gyro_rad_s) for one in SAID])
    assert set(found) == {"turn rates"} and found["turn rates"].value == pytest.approx(1.0 / scale, rel=0.02)


def test_an_imu_without_accelerations_is_a_sound_gyroscope() -> None:
    weightless = [replace(one, specific_force_m_s2=np.zeros(3)) for one in SAID]
    assert findings(weightless) == {}
    assert set(findings([replace(one, gyro_rad_s=np.degrees(one.gyro_rad_s)) for one in weightless])) == {
        "turn rates"
    }


@pytest.mark.parametrize(("ahead_s", "lidar_s", "imu_s"), [(0.072, -0.05, 0.022), (-0.05, 0.05, 0.0)])
def test_an_offset_is_of_the_lidar_as_far_as_half_a_revolution_explains_it(
    ahead_s: float, lidar_s: float, imu_s: float
) -> None:
    (clock,) = clock_findings("imu", ahead_s, 0.004)
    found = {one.sensor: one for one in stamped(clock, "lidar", 0.1, timed=False)}
    assert found["lidar"].value == pytest.approx(lidar_s)
    assert ("imu" in found) == (imu_s > 0.0)
    assert not imu_s or found["imu"].value == pytest.approx(imu_s)


@pytest.mark.parametrize(("ahead_s", "of"), [(-0.098, "lidar"), (-0.08, "imu"), (0.1, "imu")])
def test_an_offset_of_a_whole_revolution_is_of_the_stamps_of_a_lidar_with_times(
    ahead_s: float, of: str
) -> None:
    (clock,) = clock_findings("imu", ahead_s, 0.002)
    (found,) = stamped(clock, "lidar", 0.1, timed=True)
    assert found.sensor == of and found.value == pytest.approx(0.1 if of == "lidar" else ahead_s)


def test_a_small_offset_is_of_the_imu() -> None:
    (clock,) = clock_findings("imu", 0.02, 0.002)
    assert stamped(clock, "lidar", 0.1, timed=False) == [clock]
