"""Which directions of a cloud are open: a turn counts by how far it moves the points."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.config import load_config
from slam.matching.cloud_alignment import arms_of, levers
from slam.matching.local_cloud import LocalCloud


def street(length_m: float, rng: np.random.Generator) -> np.ndarray:
    """Ground 8 m wide with kerb-high noise, fronts with a pier every 5 m."""
    along = rng.uniform(-length_m, length_m, 6000)
    ground = np.column_stack([along, rng.uniform(-4.0, 4.0, 6000), rng.normal(0.0, 0.01, 6000)])
    side = np.where(rng.random(6000) < 0.5, -4.0, 4.0)
    front = np.column_stack([along, side + rng.normal(0.0, 0.01, 6000), rng.uniform(0.0, 6.0, 6000)])
    pier_x = 5.0 * rng.integers(-length_m // 5, length_m // 5, 3000) + rng.normal(0.0, 0.01, 3000)
    piers = np.column_stack([pier_x, np.sign(side[:3000]) * rng.uniform(3.0, 4.0, 3000), front[:3000, 2]])
    return np.vstack([ground, front, piers]) - [0.0, 0.0, 1.8]


def test_a_small_turn_moves_points_by_their_arms() -> None:
    rng = np.random.default_rng(1)
    points = rng.normal(0.0, [20.0, 3.0, 1.0], (500, 3))
    for turn in 1e-4 * rng.normal(size=(5, 3)):
        moved = np.sqrt(np.mean(np.sum(np.cross(turn, points) ** 2, axis=1)))
        np.testing.assert_allclose(np.linalg.norm(arms_of(points) @ turn), moved, rtol=1e-9)
    np.testing.assert_allclose(levers(arms_of(points))[3:, 3:], np.eye(3))


def test_the_roll_of_a_long_street_is_determined() -> None:
    """Weighed by the mean distance of all points it was not, and went on by itself."""
    cloud = street(60.0, np.random.default_rng(2))
    local = LocalCloud.of(cloud, 0.5, load_config(None, []))
    rolled = gtsam.Pose3(gtsam.Rot3.Rx(0.02), np.zeros(3))
    aligned = local.align(cloud[::5], rolled)
    assert aligned is not None
    assert not aligned.motion.degenerate
    assert np.abs(gtsam.Pose3.Logmap(aligned.found.pose)[:3]).max() < 2e-3


def test_no_turn_is_more_certain_than_the_floor_moves_the_points() -> None:
    """By an angle that is the same for all clouds 60 m of street bent as gravity wandered."""
    cloud, config = street(60.0, np.random.default_rng(3)), load_config(None, [])
    aligned = LocalCloud.of(cloud, 0.5, config).align(cloud[::5], gtsam.Pose3())
    assert aligned is not None
    levered = levers(aligned.found.arms_m)
    least = np.linalg.eigvalsh(levered @ aligned.motion.covariance @ levered)[0]
    assert least >= config.match.floor_m**2
    assert aligned.motion.covariance[2, 2] < config.match.floor_rad**2
