"""Scans of a 3D lidar where little shows one direction: it stays or settles, and is claimed neither way."""

import gtsam
import numpy as np
from cloud_world import T_BASE_LIDAR, base

from fusion.estimation import FEWEST
from slam.config import Config
from slam.config.clouds import CloudOdometryConfig
from slam.measurements import FloatArray
from slam.odometry.cloud_odometry import CloudOdometry

CONFIG = Config(cloud_odometry=CloudOdometryConfig(voxel_m=0.2))


def corridor(rng: np.random.Generator, count: int) -> FloatArray:
    """Two walls and a floor, without an end."""
    along, side = rng.uniform(-8.0, 8.0, count), rng.integers(0, 3, count)
    y = np.where(side == 0, -1.0, np.where(side == 1, 1.0, rng.uniform(-1.0, 1.0, count)))
    z = np.where(side == 2, 0.0, rng.uniform(0.0, 2.0, count))
    return np.column_stack([along, y, z])


def with_a_board(rng: np.random.Generator) -> FloatArray:
    """The same with a few points across it, all noisy."""
    board = [np.full(200, 2.0), rng.uniform(-0.7, -0.1, 200), rng.uniform(0.9, 1.5, 200)]
    points = np.vstack([corridor(rng, 20000), np.column_stack(board)])
    return points + 0.04 * rng.standard_normal(points.shape)


def odometry(points: FloatArray) -> CloudOdometry:
    made = CloudOdometry(CONFIG, 0.2)
    made.add_keyframe(points, gtsam.Pose3(), T_BASE_LIDAR.translation())
    return made


def test_a_direction_of_few_points_is_followed_where_it_settles_but_claims_no_more() -> None:
    """A board hangs in the corridor: matches come to it from either side."""
    rng = np.random.default_rng(0)
    made = odometry(with_a_board(rng))
    motion = made.match(made.thinned(with_a_board(rng)), [base(0.08, 0.0, 0.0)])
    assert motion is not None
    assert motion.degenerate
    assert motion.covariance[3, 3] > 0.1
    assert isinstance(motion.T_reference_base, gtsam.Pose3)
    assert abs(motion.T_reference_base.x()) < 0.02


def test_between_two_walls_the_way_along_them_is_open() -> None:
    """x keeps the guess, its variance is inflated, the rest is exact."""
    rng = np.random.default_rng(0)

    def seen() -> FloatArray:
        return corridor(rng, 9000) + 0.005 * rng.standard_normal((9000, 3))

    guess = base(0.11, 0.05, 0.01)
    made = odometry(seen())
    motion = made.match(made.thinned(seen()), [guess])
    assert motion is not None
    assert motion.degenerate
    assert abs(abs(motion.weak_direction[3]) - 1.0) < 0.05
    assert motion.covariance[3, 3] > 0.1
    assert motion.covariance[4, 4] < 0.001
    found = motion.T_reference_base
    assert isinstance(found, gtsam.Pose3)
    assert abs(found.x() - guess.x()) < 0.02
    assert abs(found.y()) < 0.01


def test_a_tunnel_that_settles_now_and_then_by_chance_leads_nowhere() -> None:
    """A match that settles is followed only while most of the newest do; it is reported in any case."""
    rng = np.random.default_rng(0)
    made, cloud, guess = odometry(with_a_board(rng)), with_a_board(rng), base(0.08, 0.0, 0.0)
    followed = list[bool]()
    for number in range(2 * FEWEST):
        motion = made.match(made.thinned(cloud), [guess])
        assert motion is not None and motion.degenerate and made.settles
        assert isinstance(motion.T_reference_base, gtsam.Pose3)
        followed.append(abs(motion.T_reference_base.x()) < 0.02)
        made.note_open(settles=number >= FEWEST)
    # Of the ten before and itself, six must settle.
    assert followed == [number < 6 or number >= FEWEST + 5 for number in range(2 * FEWEST)]
