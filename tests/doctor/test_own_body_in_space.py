"""The robot's own body around a 3D lidar is found and left out; a floor is not taken for it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.config import Config
from slam.config.calibration import Calibration
from slam.datasets.corrections import corrected
from slam.doctor.diagnosis import diagnose
from slam.doctor.finding import remedied
from slam.doctor.own_body import body_reach_m
from slam.measurements import Float32Array, PointCloud

UP = np.array([0.0, 0.0, 1.0])
BODY_M, FLOOR_M = 0.8, 0.5


def seen(number: int, *, body: bool) -> Float32Array:
    """Points of a low lidar: the floor, walls elsewhere in each place, and behind it a box it carries."""
    rng = np.random.default_rng(number)
    bearing, up = np.meshgrid(np.linspace(-math.pi, math.pi, 300), np.radians(np.arange(-40.0, 20.0, 2.0)))
    level, height = np.cos(up), np.sin(up)
    walls_m = rng.uniform(3.0, 9.0, 12)[((bearing + math.pi) / math.tau * 11.99).astype(int)]
    floor_m = np.where(height < 0.0, FLOOR_M / np.maximum(-height, 1e-9), np.inf)
    ranges_m = np.minimum(walls_m, floor_m)
    if body:
        ranges_m = np.where(np.abs(bearing) > math.pi - 0.6, np.minimum(BODY_M, floor_m), ranges_m)
    ways = np.stack([level * np.cos(bearing), level * np.sin(bearing), height], axis=-1)
    points = (ranges_m + rng.normal(0.0, 0.005, ranges_m.shape))[..., None] * ways
    return points.reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("body", [True, False])
def test_a_body_is_found_but_no_floor(body: bool) -> None:
    reach_m = body_reach_m([seen(number, body=body) for number in range(30)], UP, Config())
    assert reach_m == (pytest.approx(BODY_M + 0.05, abs=0.02) if body else 0.0)


@pytest.mark.parametrize("half_width_m", [0.6, 0.8, 1.2])
def test_the_walls_of_a_narrow_corridor_are_no_body(half_width_m: float) -> None:
    """They are as far away everywhere, too, but they go on beyond two metres."""
    clouds = []
    for number in range(30):
        rng = np.random.default_rng(number)
        bearing, up = np.meshgrid(
            np.linspace(-math.pi, math.pi, 300), np.radians(np.arange(-15.0, 16.0, 2.0))
        )
        aside_m = half_width_m + 0.01 * rng.standard_normal() * np.sign(np.sin(bearing))
        ahead_m = np.where(np.cos(bearing) > 0.0, 20.0 - 0.5 * number, 5.0 + 0.5 * number)
        walls_m = aside_m / np.abs(np.sin(bearing))
        doors = (0.5 * number + walls_m * np.cos(bearing)) % 5.0 < 0.9
        walls_m = np.where(doors, walls_m + 2.0, walls_m)
        ranges_m = np.minimum(walls_m, ahead_m / np.abs(np.cos(bearing)))
        ranges_m = (ranges_m + rng.normal(0.0, 0.005, ranges_m.shape)) / np.cos(up)
        ways = [np.cos(up) * np.cos(bearing), np.cos(up) * np.sin(bearing), np.sin(up)]
        clouds.append((ranges_m[..., None] * np.stack(ways, axis=-1)).reshape(-1, 3).astype(np.float32))
    assert body_reach_m(clouds, UP, Config()) == 0.0


def test_few_places_or_one_show_no_body() -> None:
    assert body_reach_m([], UP, Config()) == 0.0
    assert body_reach_m([np.zeros((0, 3), np.float32)], UP, Config()) == 0.0
    assert body_reach_m([seen(number, body=True) for number in range(15)], UP, Config()) == 0.0
    assert body_reach_m([seen(3, body=True)] * 30, UP, Config()) == 0.0


def test_the_doctor_leaves_out_what_the_robot_sees_of_itself() -> None:
    log = [PointCloud(0.5 * n, seen(n, body=True), None, sensor="lidar") for n in range(60)]
    found = [one for one in diagnose(log) if one.kind == "own body"]
    assert [one.sure for one in found] == [True]
    cloud = next(iter(corrected(log, remedied(Calibration(), found, only_sure=True))))
    assert isinstance(cloud, PointCloud)
    ranges_m = np.linalg.norm(cloud.points_lidar, axis=1)
    assert cloud.points_lidar.dtype == np.float32 and 0 < len(ranges_m) < len(log[0].points_lidar)
    assert (ranges_m > BODY_M).all()
