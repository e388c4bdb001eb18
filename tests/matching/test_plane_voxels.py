"""Planes in voxels: points that remember their voxels find the same planes."""

from __future__ import annotations

import numpy as np
from cloud_world import base, points_at

from slam.matching.plane_voxels import PlaneVoxels


def test_points_that_remember_their_voxels_find_the_same_planes() -> None:
    planes = PlaneVoxels.build(points_at(base(0.0, 0.0, 0.0)), 0.2, 0.02, rough=1)
    points, rng = points_at(base(0.1, 0.0, 0.0), 1), np.random.default_rng(0)
    last_at, changed = np.full((2, len(points)), -1), list[int]()
    for shift_m in (0.0, 0.3, 0.01, 0.001):
        pose = base(*rng.normal(0.0, shift_m, 2), 0.0).matrix()
        before = last_at.copy()
        found, fresh = planes.residuals(points, pose, last_at), planes.residuals(points, pose)
        changed.append(np.count_nonzero(last_at[0] != before[0]))
        np.testing.assert_array_equal(found.which, fresh.which)
        np.testing.assert_array_equal(found.voxels, fresh.voxels)
        np.testing.assert_array_equal(found.distances_m, fresh.distances_m)
    assert changed[0] == len(points) and changed[1] > 0.2 * len(points) and len(found.which) < len(points)
