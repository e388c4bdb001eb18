"""A fixed-lag graph of straight steps is a Kalman filter; and what is added to it in closed form."""

import math

import gtsam
import numpy as np
import pytest

from slam.localization.pose_smoother import PoseSmoother
from slam.localization.poses import Measured, after, same_place, separation, squared_mahalanobis
from slam.measurements import composed, motion_between


def test_straight_steps_are_a_kalman_filter() -> None:
    start, step, seen = np.diag([0.04, 0.05, 1e-8]), np.diag([0.01, 0.02, 1e-10]), np.diag([0.03, 0.06, 1e-6])
    smoother = PoseSmoother(Measured(gtsam.Pose2(), start))
    mean, variance = np.zeros(2), np.diag(start)[:2].copy()
    rng, ahead = np.random.default_rng(3), np.array([0.5, 0.0])
    for _ in range(20):
        z = mean + ahead + rng.normal(0.0, 0.2, 2)
        smoother.add(
            Measured(gtsam.Pose2(0.5, 0.0, 0.0), step), [Measured(gtsam.Pose2(z[0], z[1], 0.0), seen)]
        )
        mean, variance = mean + ahead, variance + np.diag(step)[:2]
        gain = variance / (variance + np.diag(seen)[:2])
        mean, variance = mean + gain * (z - mean), (1.0 - gain) * variance
        found = smoother.newest
        assert isinstance(found.pose, gtsam.Pose2)
        np.testing.assert_allclose([found.pose.x(), found.pose.y()], mean, atol=2e-3)
        np.testing.assert_allclose(np.diag(found.covariance)[:2], variance, rtol=1e-2)
    assert smoother.sigma_m == pytest.approx(math.sqrt(variance.max()), rel=1e-2)


@pytest.mark.parametrize("pose", [gtsam.Pose2(1.0, 2.0, 0.3), gtsam.Pose3(gtsam.Pose2(1.0, 2.0, 0.3))])
def test_dead_reckoning_grows_and_a_sight_of_the_map_ends_it(pose: gtsam.Pose2 | gtsam.Pose3) -> None:
    size = 3 if isinstance(pose, gtsam.Pose2) else 6
    confident = np.eye(size) * 1e-4
    smoother = PoseSmoother(Measured(pose, confident))
    still = pose.between(pose)  # type: ignore[arg-type]
    sigmas = [smoother.sigma_m]
    for _ in range(6):
        predicted = after(smoother.newest, Measured(still, confident))
        smoother.add(Measured(still, confident), [])
        np.testing.assert_allclose(smoother.newest.covariance, predicted.covariance, rtol=1e-6, atol=1e-9)
        sigmas.append(smoother.sigma_m)
    assert np.all(np.diff(sigmas) > 0.0)
    assert sigmas[-1] == pytest.approx(0.01 * math.sqrt(7.0), rel=1e-3)
    smoother.add_seen(Measured(pose, confident))
    assert smoother.sigma_m < 0.01


def test_distance_in_sigmas_counts_both_covariances() -> None:
    one = Measured(gtsam.Pose2(0.0, 0.0, 0.0), np.diag([0.09, 1.0, 1.0]))
    other = Measured(gtsam.Pose2(1.0, 0.0, 0.0), np.diag([0.16, 1.0, 1.0]))
    assert squared_mahalanobis(one, other) == pytest.approx(4.0)


def test_trust_is_the_share_of_a_round_gaussian_within_the_same_place() -> None:
    draws = np.hypot(*np.random.default_rng(0).normal(0.0, 0.2, (2, 200_000)))
    smoother = PoseSmoother(Measured(gtsam.Pose2(), np.diag([0.04, 0.04, 0.01])))
    assert smoother.trust == pytest.approx(np.mean(draws < 0.3), abs=0.005)


@pytest.mark.parametrize("turned", [gtsam.Pose2(1.0, -2.0, 3.0), gtsam.Pose3(gtsam.Pose2(1.0, -2.0, 3.0))])
def test_steps_lead_back_and_show_metres_and_radians(turned: gtsam.Pose2 | gtsam.Pose3) -> None:
    origin = motion_between(turned, turned)
    assert motion_between(origin, composed(turned, motion_between(turned, origin))).equals(origin, 1e-9)  # type: ignore[arg-type]
    assert separation(origin, turned) == pytest.approx((math.sqrt(5.0), 3.0))
    assert same_place(turned, turned) and not same_place(origin, turned)
