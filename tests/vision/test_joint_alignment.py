"""Surfaces and features in one least squares: true pose, true derivatives, what a bare wall leaves open."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest
from room_world import SMALL, T_BODY_CAMERA, Room, dark, error_of, furnished, hall, looking, prepared, render

from slam.config.stages import MatchConfig, RgbdOdometryConfig
from slam.measurements import FloatArray
from slam.vision.alignment_kernels import feature_part, room_for_points, surface_part
from slam.vision.joint_alignment import (
    JointAlignment,
    Landmarks,
    View,
    align,
)
from slam.vision.surface import SurfacePoints
from slam.vision.visual_match import covariance_of

CORNER = looking(-0.3, 0.2, 1.5, -0.7, 0.35)
STEP = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.02), np.array([0.05, 0.03, 0.04]))
DEFAULT, MATCH = RgbdOdometryConfig(), MatchConfig()
ROUNDS = (MATCH.coarse_iterations, MATCH.iterations - MATCH.coarse_iterations)
CAMERA = (SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy)
ELSEWHERE = [gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3.RzRyRx(0.7, -1.1, 2.0), np.array([30.0, -20.0, 5.0]))]


def settings(correlated_points: float = 60.0, correlated_features: float = 3.0) -> RgbdOdometryConfig:
    update = {"correlated_points": correlated_points, "correlated_features": correlated_features}
    return DEFAULT.model_copy(update=update)


def seen_points(pose: gtsam.Pose3, count: int = 120, sigma_px: float = 0.0, seed: int = 0) -> Landmarks:
    """Points before a camera and where it sees them."""
    rng = np.random.default_rng(seed)
    camera = rng.uniform([-1.0, -0.8, 1.0], [1.0, 0.8, 3.0], (count, 3))
    pixels = camera[:, :2] / camera[:, 2:] * [SMALL.fx, SMALL.fy] + [SMALL.cx, SMALL.cy]
    pixels += sigma_px * rng.standard_normal(pixels.shape)
    world = camera @ pose.rotation().matrix().T + pose.translation()
    return Landmarks(world, pixels, np.ones(count))


NO_POINTS = SurfacePoints(np.zeros((6, 0), np.float32))


def by_surfaces(
    room: Room,
    before: gtsam.Pose3,
    after: gtsam.Pose3,
    guess: gtsam.Pose3 | None = None,
    noise: tuple[float, float] = (0.0, 0.0),
) -> JointAlignment:
    """A frame against a keyframe by their shapes alone."""
    one = prepared(dark(render(room, before, noise=noise, seed=1)))
    other = prepared(dark(render(room, after, noise=noise, seed=2)))
    view = View(one.surface, before)
    return align(other.points, [view], Landmarks.none(), SMALL, guess or before, settings(), ROUNDS)


class TestPose:
    @pytest.mark.parametrize("frame", ELSEWHERE)
    def test_by_surfaces_alone(self, frame: gtsam.Pose3) -> None:
        room = furnished()
        moved = Room(room.inside, room.outside, frame=frame)
        before = frame * CORNER
        found = by_surfaces(moved, before, before * STEP)
        assert np.abs(error_of(found.pose, before * STEP)).max() < 4e-4
        assert found.converged
        assert found.overlap > 0.9
        assert found.point_count > 0.95 * found.point_pairs
        assert found.feature_count == 0

    @pytest.mark.parametrize("frame", ELSEWHERE)
    def test_by_features_alone(self, frame: gtsam.Pose3) -> None:
        truth = frame * CORNER
        guess = truth * gtsam.Pose3.Expmap(np.array([0.03, -0.02, 0.04, 0.05, 0.03, -0.06]))
        found = align(NO_POINTS, [], seen_points(truth), SMALL, guess, settings(math.inf), ROUNDS)
        assert np.abs(error_of(found.pose, truth)).max() < 1e-6
        assert found.converged
        assert (found.feature_count, found.feature_pairs) == (120, 120)
        assert (found.point_count, found.overlap) == (0, 0.0)

    def test_wrong_pairs_are_outvoted(self) -> None:
        good = seen_points(CORNER)
        pixels = good.pixels.copy()
        pixels[:30] += np.random.default_rng(1).uniform(15.0, 60.0, (30, 2))
        guess = CORNER * gtsam.Pose3.Expmap(np.full(6, 0.01))
        found = align(NO_POINTS, [], good._replace(pixels=pixels), SMALL, guess, settings(math.inf), ROUNDS)
        assert np.abs(error_of(found.pose, CORNER)).max() < 2e-3
        assert found.feature_count == 90

    def test_nothing_at_all_stays_where_it_was(self) -> None:
        found = align(NO_POINTS, [], Landmarks.none(), SMALL, CORNER, settings(), ROUNDS)
        assert found.pose.equals(CORNER, 1e-12)
        assert not found.converged
        assert not found.information.any()
        assert found.overlap == found.point_count == found.feature_count == 0


@pytest.mark.parametrize("seed", range(5))
def test_the_derivative_of_point_to_plane(seed: int) -> None:
    """One point of weight 1 against a slanted plane through (0, 0, 2): J'J and -J'r."""
    rng = np.random.default_rng(seed)
    normal = np.array([*rng.uniform(-0.4, 0.4, 2), -1.0])
    normal /= np.linalg.norm(normal)
    pose = gtsam.Pose3.Expmap(rng.uniform(-0.05, 0.05, 6))
    point = np.array([*rng.uniform(-0.4, 0.4, 2), 2.1])
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    rays = np.stack([(u - SMALL.cx) / SMALL.fx, (v - SMALL.cy) / SMALL.fy, np.ones(u.shape)], axis=-1)
    inverse = (rays @ normal / (2.0 * normal[2]))[..., None]
    planes = np.concatenate([inverse, np.broadcast_to(normal, rays.shape)], axis=-1)
    sums, residuals = np.zeros((2, 6, 7)), np.full(1, np.inf, np.float32)
    for informed in (False, True):
        surface_part(
            np.concatenate([point, pose.rotation().matrix().T @ normal])[:, None].astype(np.float32),
            pose.matrix().astype(np.float32),
            planes.reshape(-1, 4).astype(np.float32),
            np.array([*CAMERA, 160, 120], np.float32),
            np.array([1.0, 1e9, 1.0, 0.0], np.float32),
            *room_for_points(),
            sums[int(informed)],
            np.zeros(1, np.float32),
            residuals,
            informed,
        )
    (hessian, information), gradient = sums[:, :, :6], -sums[0, :, 6]

    def residual(tangent: FloatArray) -> float:
        moved = pose.compose(gtsam.Pose3.Expmap(tangent)).transformFrom(point)
        return float(normal @ (moved - np.array([0.0, 0.0, 2.0])))

    jacobian = np.array([(residual(1e-6 * e) - residual(-1e-6 * e)) / 2e-6 for e in np.eye(6)])
    np.testing.assert_allclose(hessian, np.outer(jacobian, jacobian), atol=1e-6)
    np.testing.assert_allclose(information, hessian, atol=2e-6)  # both normals are exact here
    np.testing.assert_allclose(gradient, -jacobian * residual(np.zeros(6)), atol=1e-6)
    np.testing.assert_allclose(residuals, abs(residual(np.zeros(6))), atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_the_derivative_of_reprojection(seed: int) -> None:
    """Of half the squared error by the pose: the gradient; of both errors: the Hessian is J'J."""
    rng = np.random.default_rng(seed)
    pose = CORNER * gtsam.Pose3.Expmap(rng.uniform(-0.1, 0.1, 6))
    landmarks = seen_points(CORNER, count=7, sigma_px=2.0, seed=seed)
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    T_camera_map, slopes = pose.inverse().matrix(), np.zeros((2, 6))
    feature_part(*landmarks, T_camera_map, *CAMERA, 1e9, slopes, hessian, gradient, np.zeros(7))

    def errors(tangent: FloatArray) -> FloatArray:
        at = pose.compose(gtsam.Pose3.Expmap(tangent)).inverse()
        camera = np.array([at.transformFrom(point) for point in landmarks.points])
        pixels = camera[:, :2] / camera[:, 2:] * [SMALL.fx, SMALL.fy] + [SMALL.cx, SMALL.cy]
        return (pixels - landmarks.pixels).ravel()

    jacobian = np.stack([(errors(1e-6 * e) - errors(-1e-6 * e)) / 2e-6 for e in np.eye(6)], axis=1)
    np.testing.assert_allclose(hessian, jacobian.T @ jacobian, rtol=1e-5, atol=1e-2)
    np.testing.assert_allclose(gradient, -jacobian.T @ errors(np.zeros(6)), rtol=1e-5, atol=1e-2)


class TestWhatIsOpen:
    """A flat wall: by its shape only the distance and two turns are reported."""

    FACING = looking(0.0, 0.0, 0.0, 0.1, 0.05)
    NOISE = (DEFAULT.depth_floor_m, DEFAULT.depth_share)

    @pytest.mark.parametrize("noise", [(0.0, 0.0), NOISE])
    def test_a_bare_wall_is_open_along_itself(self, noise: tuple[float, float]) -> None:
        """Noisy normals must not seem to show what the wall does not."""
        moved = self.FACING * STEP
        found = by_surfaces(hall(), self.FACING, moved, noise=noise)
        covariance, weak = covariance_of(found.information, 1.0, MATCH)
        across = moved.rotation().matrix().T @ [1.0, 0.0, 0.0]
        assert abs(weak[3:] @ across) < 0.1
        sigmas = np.sqrt(np.diag(covariance))
        sideways = T_BODY_CAMERA.rotation().matrix().T @ [0.0, 0.0, 1.0]
        assert math.sqrt(sideways @ covariance[3:, 3:] @ sideways) > 0.2 * MATCH.degenerate_sigma_m
        assert math.sqrt(across @ covariance[3:, 3:] @ across) < 0.02
        assert np.linalg.norm(weak) == pytest.approx(1.0)
        assert sigmas.max() > 0.5
        # What is reported is right all the same.
        error = found.pose.translation() - moved.translation()
        assert abs(error[0]) < 0.003
        axis = found.pose.rotation().matrix().T @ [1.0, 0.0, 0.0]
        np.testing.assert_allclose(axis, across, atol=0.003)

    def test_a_corner_leaves_nothing_open(self) -> None:
        found = by_surfaces(furnished(), CORNER, CORNER * STEP, noise=self.NOISE)
        covariance, weak = covariance_of(found.information, 1.0, MATCH)
        assert not weak.any()
        assert np.sqrt(np.diag(covariance)).max() < 0.02

    def test_texture_closes_the_wall(self) -> None:
        moved = self.FACING * STEP
        on_wall = seen_points(moved, sigma_px=0.3)
        points = on_wall.points.copy()
        view = [render(hall(), pose, noise=self.NOISE, seed=n) for n, pose in enumerate((self.FACING, moved))]
        frame, keyframe = prepared(view[1]), prepared(view[0])
        landmarks = Landmarks(points, on_wall.pixels, on_wall.sigma_px)
        views = [View(keyframe.surface, self.FACING)]
        found = align(frame.points, views, landmarks, SMALL, self.FACING, settings(), ROUNDS)
        covariance, weak = covariance_of(found.information, 1.0, MATCH)
        assert not weak.any()
        assert np.sqrt(np.diag(covariance)[3:]).max() < 0.01
        assert np.abs(error_of(found.pose, moved)).max() < 0.005

    def test_two_points_leave_much_open(self) -> None:
        landmarks = Landmarks(*(part[:2] for part in seen_points(CORNER)))
        found = align(NO_POINTS, [], landmarks, SMALL, CORNER, settings(math.inf), ROUNDS)
        covariance, weak = covariance_of(found.information, 1.0, MATCH)
        assert weak.any()
        assert np.isfinite(covariance).all()
        assert np.linalg.eigvalsh(covariance)[0] > 0.0


class TestCovarianceOf:
    def test_certainty_has_a_floor(self) -> None:
        covariance, weak = covariance_of(np.eye(6) * 1e20, 1.0, MATCH)
        expected = [0.25 * MATCH.floor_rad**2] * 3 + [0.25 * MATCH.floor_m**2] * 3
        np.testing.assert_allclose(covariance, np.diag(expected), atol=1e-12)
        assert not weak.any()

    def test_readings_that_disagree_cost_trust(self) -> None:
        full, _ = covariance_of(np.eye(6) * 1e4, 1.0, MATCH)
        half, _ = covariance_of(np.eye(6) * 1e4, 0.5, MATCH)
        assert (np.diag(half)[3:] - 0.25 * MATCH.floor_m**2) / (
            np.diag(full)[3:] - 0.25 * MATCH.floor_m**2
        ) == pytest.approx(4.0)

    @pytest.mark.parametrize("axis", range(3))
    def test_the_weak_axis_is_named_and_inflated(self, axis: int) -> None:
        information = np.eye(6) * 1e6
        information[3 + axis, 3 + axis] = 1.0 / 0.2**2
        covariance, weak = covariance_of(information, 1.0, MATCH)
        assert abs(weak[3 + axis]) == pytest.approx(1.0)
        assert covariance[3 + axis, 3 + axis] > MATCH.degenerate_sigma_m**2
        assert np.delete(np.diag(covariance), 3 + axis).max() < 1e-5

    def test_no_information_is_wide_and_finite(self) -> None:
        covariance, weak = covariance_of(np.zeros((6, 6)), 0.0, MATCH)
        assert np.isfinite(covariance).all()
        assert np.linalg.eigvalsh(covariance)[0] > 1.0
        assert weak.any()
