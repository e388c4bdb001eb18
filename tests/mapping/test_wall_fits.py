"""Lines through points of walls: how they, and what scans differ by, follow from poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.mapping.room_outline import Face
from slam.mapping.wall_fits import Contrast, WallFit, fit_wall
from slam.mapping.wall_segments import WallPoints
from slam.measurements import FloatArray
from slam.outputs.floorplan import unit_variance

POSES = np.column_stack([np.linspace(0.5, 3.5, 8), np.linspace(1.0, 1.6, 8), np.linspace(-0.3, 0.4, 8)])


def fitted(poses: FloatArray) -> WallFit:
    """A wall along x, of 4 m, that eight scans have met in the same places of their own frames."""
    rng = np.random.default_rng(2)
    owners = np.repeat(np.arange(len(poses)), 40)
    true = np.column_stack([rng.uniform(0.1, 3.9, len(owners)), rng.normal(0.0, 0.001, len(owners))])
    points = np.empty_like(true)
    for keyframe, (one, other) in enumerate(zip(POSES, poses, strict=True)):
        own = (true[owners == keyframe] - one[:2]) @ turn(one[2])
        points[owners == keyframe] = own @ turn(other[2]).T + other[:2]
    up = np.tile([0.0, 1.0], (len(points), 1))
    seen = WallPoints(points, up, owners, np.ones(len(points)))
    found = fit_wall(Face(np.zeros(2), np.array([0.0, 1.0]), True, 4.0), (0.0, 4.0), seen, poses, cell_m=0.05)
    assert found is not None
    return found


def turn(yaw_rad: float) -> FloatArray:
    return np.array([[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]])


def test_line_and_drift_follow_from_the_poses_as_the_jacobians_say() -> None:
    before, step = fitted(POSES), 1e-5
    for keyframe in range(len(POSES)):
        for axis in range(3):
            own = np.eye(3)
            own[:2, :2] = turn(POSES[keyframe, 2])
            moved = POSES.copy()
            moved[keyframe] += step * own[:, axis]
            after, column = fitted(moved), 3 * keyframe + axis
            change = [after.offset_m - before.offset_m, after.slope - before.slope]
            assert np.array(change) / step == pytest.approx(before.jacobian[:, column], abs=2e-3)
            drift = (after.drift.value - before.drift.value) / step
            assert drift == pytest.approx(before.drift.jacobian[column], abs=2e-3)


def test_the_drift_is_how_far_later_scans_saw_the_wall_elsewhere() -> None:
    later = POSES.copy()
    later[4:, 1] += 0.004
    assert abs(fitted(POSES).drift.value) < 1e-3
    assert fitted(later).drift.value == pytest.approx(0.002, abs=1e-3)


def test_the_walls_show_how_large_errors_of_poses_are() -> None:
    wall, rng = fitted(POSES), np.random.default_rng(1)
    variances = rng.uniform(0.5, 2.0, 400)
    fits = [
        replace(wall, drift=Contrast(float(value), wall.drift.jacobian))
        for value in 0.3 * np.sqrt(variances) * rng.normal(size=400)
    ]
    assert unit_variance(fits, variances) == pytest.approx(0.09, rel=0.2)
    # A wall says as much as the claim, and one that was not seen twice nothing.
    one = unit_variance(fits[:1], variances[:1])
    assert one == pytest.approx(0.5 + 0.5 * fits[0].drift.value ** 2 / variances[0])
    assert unit_variance(fits, np.zeros(400)) == 1.0
