"""Whether alignments are as certain as they say: normalised squared errors over a hundred noisy trials."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from room_world import SMALL, error_of, furnished, looking, prepared, render

from slam.config import Config
from slam.config.stages import MatchConfig, RgbdConfig, RgbdOdometryConfig
from slam.measurements import FloatArray, RgbdFrame
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.joint_alignment import Landmarks, View, align
from slam.vision.surface import SurfacePoints, points_of, surface_of
from slam.vision.visual_match import VisualKeyframe

CORNER = looking(-0.3, 0.2, 1.5, -0.7, 0.35)
# Neither floor nor ceiling is seen: only a cupboard's rim shows the height.
LEVEL = looking(0.0, 0.0, 1.3, 0.3, 0.05)
STEP = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.02), np.array([0.05, 0.03, 0.04]))
ODOMETRY, IMAGES, MATCH = RgbdOdometryConfig(), RgbdConfig(), MatchConfig()
ROUNDS = (MATCH.coarse_iterations, 40 - MATCH.coarse_iterations)

# Readings whose errors are independent share them only by the windows of the plane fits: at 160 columns each
# reading is in about twelve. The default of 60 is for real cameras, whose neighbouring errors are alike.
INDEPENDENT_POINTS = 13.0


def settings(correlated_points: float, correlated_features: float) -> RgbdOdometryConfig:
    update = {"correlated_points": correlated_points, "correlated_features": correlated_features}
    return ODOMETRY.model_copy(update=update)


def noisy(frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
    """By the noise that the settings assume, independent from pixel to pixel."""
    sigma_m = ODOMETRY.depth_floor_m + ODOMETRY.depth_share * frame.depth_m**2
    depth_m = frame.depth_m + sigma_m * rng.standard_normal(frame.depth_m.shape)
    color = np.clip(frame.color + 4.0 * rng.standard_normal(frame.color.shape), 0.0, 255.0)
    return replace(frame, depth_m=depth_m.astype(np.float32), color=color.astype(np.uint8))


def guess_near(pose: gtsam.Pose3, rng: np.random.Generator) -> gtsam.Pose3:
    return pose * gtsam.Pose3.Expmap(rng.normal(0.0, [0.005] * 3 + [0.01] * 3))


def squares(error: FloatArray, information: FloatArray) -> float:
    """Normalised squared error a degree of freedom: 1 on average for an honest covariance."""
    return float(error @ information @ error) / 6.0


@pytest.mark.parametrize("place", [CORNER, LEVEL], ids=["all is reported", "height is hardly reported"])
def test_surfaces_are_as_sure_as_they_say(place: gtsam.Pose3) -> None:
    images = [render(furnished(), pose) for pose in (place, place * STEP)]
    found = []
    for trial in range(100):
        rng = np.random.default_rng(trial)
        before, after = (noisy(image, rng).depth_m for image in images)
        surface = surface_of(before, SMALL, IMAGES.plane_radius, IMAGES.farthest_m)
        points = points_of(after, SMALL, IMAGES.plane_radius, IMAGES.farthest_m, IMAGES.points)
        guess = guess_near(place * STEP, rng)
        views = [View(surface, place)]
        result = align(
            points, views, Landmarks.none(), SMALL, guess, settings(INDEPENDENT_POINTS, math.inf), ROUNDS
        )
        found.append(squares(error_of(result.pose, place * STEP), result.information))
    assert 0.5 < np.mean(found) < 2.0


def test_features_are_as_sure_as_they_say() -> None:
    """Independent errors of half to two pixels: the measured residual sets the scale."""
    nothing = SurfacePoints(np.zeros((6, 0), np.float32))
    for sigma_px in (0.5, 2.0):
        found, residuals = [], []
        for trial in range(100):
            rng = np.random.default_rng(trial)
            camera = rng.uniform([-1.0, -0.8, 1.0], [1.0, 0.8, 3.0], (150, 3))
            pixels = camera[:, :2] / camera[:, 2:] * [SMALL.fx, SMALL.fy] + [SMALL.cx, SMALL.cy]
            pixels += sigma_px * rng.standard_normal(pixels.shape)
            world = camera @ CORNER.rotation().matrix().T + CORNER.translation()
            marks = Landmarks(world, pixels, np.ones(len(world)))
            result = align(
                nothing, [], marks, SMALL, guess_near(CORNER, rng), settings(math.inf, 1.0), ROUNDS
            )
            found.append(squares(error_of(result.pose, CORNER), result.information))
            residuals.append(result.residual_px)
        assert np.mean(residuals) == pytest.approx(sigma_px, rel=0.1)
        assert 0.5 < np.mean(found) < 2.0


def test_a_match_claims_no_more_than_it_knows() -> None:
    """Both parts, floors and all, by the defaults: these are for a worse camera than this one."""
    images = [render(furnished(), pose) for pose in (CORNER, CORNER * STEP)]
    matcher = FrameMatcher(Config())
    found = []
    for trial in range(30):
        rng = np.random.default_rng(trial)
        before, after = (prepared(noisy(image, rng)) for image in images)
        local = [VisualKeyframe(before, CORNER)]
        match = matcher.match(after, local, guess_near(CORNER * STEP, rng))
        assert match is not None
        error = error_of(match.pose, CORNER * STEP)
        found.append(squares(error, np.linalg.inv(match.motion.covariance)))
    assert 0.05 < np.mean(found) < 1.0
