"""Stock methods on readings drawn by hand: the right readings, in the robot's frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.comparison.methods import ODOMETRIES, by_odometry, kiss_icp, open3d, wheels
from slam.comparison.run import OTHER_ODOMETRY
from slam.config import Config
from slam.datasets import ReadReport, open_dataset
from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics, LaserScan, Measurement, PointCloud, RgbdFrame, WheelOdometry
from slam.simulation.synthetic_log import write_synthetic_log

MOUNT = gtsam.Pose2(0.3, 0.1, np.pi / 2.0)
STEP_M = 0.05


class Drawn:
    """A log of given readings."""

    name, path = "drawn", Path("drawn")

    def __init__(self, readings: list[Measurement]) -> None:
        self.report, self._readings = ReadReport(), readings

    def __iter__(self) -> Iterator[Measurement]:
        return iter(self._readings)

    def groundtruth(self) -> None:
        return None


def box_points(T_map_sensor: gtsam.Pose3) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Walls, floor and ceiling of an oblong room as a sensor sees them, (N, 3)."""
    rng = np.random.default_rng(3)
    sides = np.array([[-12.0, 15.0], [-9.0, 11.0], [-2.0, 3.0]])
    points = rng.uniform(sides[:, 0], sides[:, 1], (6000, 3))
    axis, end = rng.integers(3, size=6000), rng.integers(2, size=6000)
    points[np.arange(6000), axis] = sides[axis, end]
    return np.array([T_map_sensor.transformTo(point) for point in points])


def test_kiss_icp_gives_the_robots_way_not_the_sensors() -> None:
    mount = gtsam.Pose3(MOUNT)
    truth = [gtsam.Pose3(gtsam.Rot3.Yaw(0.01 * n), np.array([STEP_M * n, 0.0, 0.0])) for n in range(12)]
    clouds = [
        PointCloud(float(n), box_points(pose.compose(mount)).astype(np.float32), T_base_lidar=mount)
        for n, pose in enumerate(truth)
    ]
    # Where there are clouds, a scan beside them is not mixed in.
    scan = LaserScan(0.5, np.full(90, 1.0, dtype=np.float32), 0.0, 0.02, 10.0)
    found = kiss_icp(Drawn([scan, *clouds])).trajectory
    assert found.stamps_s.tolist() == list(range(12))
    np.testing.assert_allclose(found.positions_m, [pose.translation() for pose in truth], atol=0.03)


@pytest.mark.open3d
def test_open3d_gives_the_robots_way_and_counts_what_failed() -> None:
    rng = np.random.default_rng(0)
    color = np.repeat(np.repeat(rng.integers(0, 255, (12, 16, 3)), 10, 0), 10, 1).astype(np.uint8)
    lens = CameraIntrinsics(150.0, 150.0, 80.0, 60.0, 160, 120)
    looks_along_x = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    mount = gtsam.Pose3(looks_along_x, np.array([0.2, 0.0, 0.5]))
    # A flat wall two metres ahead, then nearer and nearer: its picture grows.
    frames = []
    for n in range(4):
        depth = 2.0 - 0.03 * n
        v, u = np.mgrid[0:120, 0:160]
        y = np.clip((v - 60.0) * depth / 2.0 + 60.0, 0, 119).astype(int)
        x = np.clip((u - 80.0) * depth / 2.0 + 80.0, 0, 159).astype(int)
        image, other = color[y, x], np.full((120, 160), depth, dtype=np.float32)
        frames.append(RgbdFrame(float(n), image, other, lens, mount, "front"))
        frames.append(RgbdFrame(float(n), image[::-1], other, lens, mount, "second"))
    found = open3d(Drawn(list(frames))).trajectory
    assert len(found) == 4
    assert found.positions_m[-1, 0] == pytest.approx(0.09, abs=0.02)
    assert np.abs(found.positions_m[:, 1:]).max() < 0.05


def test_wheels_are_as_recorded() -> None:
    readings = [WheelOdometry(float(n), gtsam.Pose2(n, 2.0 * n, 0.1)) for n in range(3)]
    found = wheels(Drawn(list(readings))).trajectory
    np.testing.assert_allclose(found.to_planar(), [[n, 2.0 * n, 0.1] for n in range(3)], atol=1e-12)


@pytest.mark.parametrize("method", [wheels, kiss_icp, pytest.param(open3d, marks=pytest.mark.open3d)])
def test_a_log_without_its_sensor_is_named(
    method: Callable[[Drawn], object],
) -> None:
    with pytest.raises(DatasetError, match=f"drawn holds no .*'{method.__name__}'"):
        method(Drawn([]))


def test_our_mapper_runs_by_the_odometry_of_others(tmp_path: Path) -> None:
    """It closes loops and draws a plan as ever; only the motion is estimated by another."""
    assert set(ODOMETRIES) == OTHER_ODOMETRY
    log = write_synthetic_log(tmp_path, seed=1, duration_s=10.0)
    made = by_odometry(open_dataset(log.log_path), Config(), ODOMETRIES["kiss_matching"])
    assert made.plane is not None and made.loops is not None and len(made.keyframe_stamps_s) > 5
