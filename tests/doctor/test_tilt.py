"""The tilt of a 3D lidar by its floor, by wheels or by an IMU."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from slam.config.calibration import Calibration
from slam.datasets.corrections_in_space import mounted
from slam.doctor.camera_samples import SensorStep
from slam.doctor.cloud_samples import CloudSamples
from slam.doctor.finding import remedied
from slam.doctor.imu import ImuSamples
from slam.doctor.in_space import Base, seen_by
from slam.doctor.paired_motions import BaseTrack
from slam.doctor.tilt import stood_up
from slam.measurements import ImuReading
from tests.driven_arcs import base_rows

PLACE = (0.2, -0.1, 0.7)


def tilted_samples(stated: gtsam.Pose3, true: gtsam.Pose3, noise_rad: float = 0.0) -> CloudSamples:
    """A lidar of a robot in a room with a floor, its mounting in the log and the true one."""
    rows, rng = base_rows(), np.random.default_rng(3)
    poses = [gtsam.Pose3(gtsam.Pose2(*row[1:])).compose(true) for row in rows[:100]]
    samples = CloudSamples(T_base_lidar=stated)
    samples.steps = [[]]
    for row, new, one, other in zip(rows, rows[1:], poses[:-1], poses[1:], strict=False):
        noise = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0.0, noise_rad, 3)), np.zeros(3))
        samples.steps[0].append(SensorStep(row[0], new[0], one.between(other).compose(noise)))
    floor = np.column_stack([rng.uniform(-4, 4, (3000, 2)), rng.normal(0.0, 0.01, 3000)])
    wall = np.column_stack([np.full(3000, 4.0), rng.uniform(-4, 4, 3000), rng.uniform(0.0, 2.0, 3000)])
    seen = np.array([true.transformTo(point) for point in np.concatenate([floor, wall])])
    body = rng.normal(0.0, 0.01, (300_000, 3)) + np.array([0.0, 0.4, 0.0])
    samples.points = [np.concatenate([seen, body])]
    return samples


TILTS = [gtsam.Rot3.Pitch(0.6), gtsam.Rot3.Roll(-0.3), gtsam.Rot3.Pitch(0.07), gtsam.Rot3.Roll(math.pi)]


@pytest.mark.parametrize("turn", TILTS)
def test_a_tilted_lidar_is_mended_by_its_rotations_and_the_floor(turn: gtsam.Rot3) -> None:
    stated = gtsam.Pose3(gtsam.Rot3(), np.array(PLACE))
    true = gtsam.Pose3(turn, np.array(PLACE))
    samples = tilted_samples(stated, true, noise_rad=0.005)
    (finding,) = stood_up("lidar", samples)
    assert finding.sure
    assert samples.T_base_lidar.equals(true, 0.003)  # of the floor: the rotations have an error of 0.01
    given = remedied(Calibration(), [finding], only_sure=True).lidars_3d["lidar"].T_base_lidar
    assert given is not None
    assert mounted(given).equals(true, 0.003)


def test_a_lidar_in_order_or_without_a_floor_is_not_stood_up() -> None:
    true = gtsam.Pose3(gtsam.Rot3.Pitch(0.6), np.array(PLACE))
    assert not stood_up("lidar", tilted_samples(true, true))
    higher = gtsam.Pose3(gtsam.Rot3(), np.array([*PLACE[:2], 1.2]))
    assert not stood_up("lidar", tilted_samples(higher, true))


def turning_imu(T_base_imu: gtsam.Pose3 | None, about: gtsam.Rot3) -> ImuSamples:
    """A gyroscope that rotates with the robot about the vertical of ``about`` in its own frame."""
    imu, rows = ImuSamples(), base_rows()
    axis = np.asarray(about.matrix())[2].copy()
    rates = np.gradient(rows[:, 3], rows[:, 0])
    for stamp_s, rate in zip(rows[:, 0].tolist(), rates.tolist(), strict=True):
        imu.add(ImuReading(stamp_s, rate * axis, 9.81 * axis, T_base_imu, "imu"))
    return imu


@pytest.mark.parametrize("by", ["wheels", "imu", "mirrored wheels", "tilted imu", "unknown imu"])
def test_without_a_floor_wheels_or_an_imu_show_the_tilt(by: str) -> None:
    stated = gtsam.Pose3(gtsam.Rot3(), np.array([*PLACE[:2], 1.2]))
    true = gtsam.Pose3(gtsam.Rot3.Ypr(0.4, 0.3, 0.0), np.array([*PLACE[:2], 1.2]))
    if by == "mirrored wheels":
        true = stated
    samples, sits = tilted_samples(stated, true), gtsam.Rot3.Ypr(1.0, 0.2, 2.0)
    samples.points = [np.zeros((0, 3))]
    imus, fit = [], None
    if "wheels" in by:
        rows = base_rows() * (1.0, 1.0, -1.0, -1.0) if by == "mirrored wheels" else base_rows()
        fit = seen_by("lidars_3d", "lidar", samples, stated, Base("odometry", BaseTrack(rows), False)).fit
        assert fit is not None
    else:
        imus = [turning_imu(None if by == "unknown imu" else gtsam.Pose3(sits, np.zeros(3)), sits)]
        if by == "tilted imu":
            imus = [turning_imu(gtsam.Pose3(sits, np.zeros(3)), gtsam.Rot3.Pitch(0.3).compose(sits))]
    found = stood_up("lidar", samples, imus, fit)
    assert bool(found) == (by in ("wheels", "imu"))
    if by == "wheels":  # with the yaw, which an IMU does not know
        assert samples.T_base_lidar.equals(true, 0.003)
    up = np.asarray(samples.T_base_lidar.rotation().matrix())[2]
    assert not found or up @ np.asarray(true.rotation().matrix())[2] > math.cos(0.003)
