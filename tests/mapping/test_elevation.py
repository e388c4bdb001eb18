"""The ground under a map of clouds: ramps, kerbs, what stands on it; and the plan that is cut over it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.mapping.elevation import Elevation, elevation
from slam.measurements import FloatArray

LIDAR_M = 1.5


def ground(rise: float, kerb_m: float = 0.0) -> FloatArray:
    """Ground that rises along x, with a kerb along y = 3."""
    x, y = np.meshgrid(np.arange(-10.0, 10.0, 0.1), np.arange(-6.0, 6.0, 0.1))
    z = rise * x + np.where(y > 3.0, kerb_m, 0.0)
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def block(x: float, y: float, low_m: float, high_m: float) -> FloatArray:
    """The sides and the top of a box of a metre, and no ground under it."""
    rng = np.random.default_rng(1)
    return np.array([x, y, low_m]) + rng.uniform(0.0, 1.0, (4000, 3)) * [1.0, 1.0, high_m - low_m]


def seen(world: FloatArray, lean: gtsam.Rot3 | None = None) -> Elevation:
    """By a lidar over the origin that may lean."""
    pose = gtsam.Pose3(lean or gtsam.Rot3(), np.array([0.0, 0.0, LIDAR_M]))
    points = (world - pose.translation()) @ pose.rotation().matrix()
    found = elevation([points], [pose], -LIDAR_M, 15.0)
    assert found is not None
    return found


@pytest.mark.parametrize("rise", [0.0, 0.15, -0.15])
def test_a_ramp_is_ground(rise: float) -> None:
    found = seen(ground(rise))
    inner = np.array([[x, y, rise * x] for x in (-8.0, 0.3, 7.0) for y in (-4.0, 2.0)])
    assert np.abs(found.above_m(inner)).max() < 0.04 + 0.1 * abs(rise)
    assert np.median(found.slope()) == pytest.approx(abs(rise), abs=0.01)


def test_a_lidar_that_leans_sees_the_same_ground() -> None:
    leaning = seen(ground(0.05), gtsam.Rot3.Ypr(0.3, 0.0, 0.1))
    assert np.abs(leaning.above_m(ground(0.05))).max() < 0.05


def test_behind_a_kerb_there_is_ground_and_a_box_is_none() -> None:
    world = ground(0.0, kerb_m=0.14)
    free = world[~((np.abs(world[:, 0] - 4.5) < 0.6) & (np.abs(world[:, 1]) < 0.6))]
    found = seen(np.vstack([free, block(4.0, -0.5, 0.3, 1.4)]))
    pavement, road, top = np.array([[0.0, 5.0, 0.14], [0.0, 0.0, 0.0], [4.5, 0.0, 1.4]])
    assert np.abs(found.above_m(np.array([pavement, road]))).max() < 0.01
    assert found.above_m(top[None])[0] > 1.2
    row, col = np.floor((np.array([0.0, 4.5]) - found.origin_xy[::-1]) / found.cell_m).astype(int)
    assert not found.seen[row, col]


def test_without_ground_there_is_none() -> None:
    above = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 9.0]))
    assert elevation([ground(0.0) - [0.0, 0.0, 9.0]], [above], -LIDAR_M, 15.0) is None
    assert elevation([np.zeros((0, 3))], [above], -LIDAR_M, 15.0) is None
