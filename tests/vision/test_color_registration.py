"""A colour camera beside the depth camera: known shifts, and the estimate from matches alone."""

from __future__ import annotations

from dataclasses import replace

import cv2
import gtsam
import numpy as np
import pytest

from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array, FloatArray
from slam.simulation.home import generate_home
from slam.simulation.rigs import camera_pose
from slam.simulation.scene import Scene
from slam.simulation.sensor_models import KINECT_V1
from slam.simulation.sensors import render_rgbd
from slam.vision.color_registration import (
    ColorRegistration,
    identity_registration,
    register_color,
    register_features,
)
from slam.vision.color_registration_fit import FramePair, estimate_registration
from slam.vision.color_registration_kernels import settle_motions

HOME = generate_home(1)
_FULL = KINECT_V1.intrinsics
KINECT = replace(
    KINECT_V1,
    intrinsics=CameraIntrinsics(0.5 * _FULL.fx, 0.5 * _FULL.fy, 159.5, 119.5, 320, 240),
)
DEPTH = CameraIntrinsics(100.0, 100.0, 40.0, 30.0, 80, 60)
COLOR = CameraIntrinsics(80.0, 80.0, 42.0, 29.0, 80, 60)
SHIFT_M = 0.1
BESIDE = ColorRegistration(
    COLOR, DEPTH, gtsam.Pose3(gtsam.Rot3(), np.array([SHIFT_M, 0.0, 0.0])), accepted=True, reason="test"
)


def flat(depth_m: float) -> Float32Array:
    return np.full((60, 80), depth_m, dtype=np.float32)


def test_a_registered_pixel_stays_where_it_is() -> None:
    pixels = np.array([[0.0, 0.0], [12.25, 40.5], [79.0, 59.0]])
    depth = np.arange(4800, dtype=np.float32).reshape(60, 80) / 4800.0 + 2.0
    found, z = register_features(pixels, depth, identity_registration(DEPTH, "test"))
    np.testing.assert_allclose(found, pixels, atol=1e-5)
    # Row 40.5, column 12.25 of a plane that is linear in both.
    assert z[1] == pytest.approx(2.0 + (40.5 * 80 + 12.25) / 4800.0, abs=1e-5)


def test_a_pixel_before_a_wall_by_the_pinhole_model() -> None:
    # Colour pixel (58, 37): ray (0.2, 0.1); at 2 m (0.4, 0.2, 2); in the depth frame 0.1 m right of it.
    found, z = register_features(np.array([[58.0, 37.0]]), flat(2.0), BESIDE)
    np.testing.assert_allclose(found, [[100.0 * 0.5 / 2.0 + 40.0, 100.0 * 0.2 / 2.0 + 30.0]], atol=1e-4)
    np.testing.assert_allclose(z, [2.0])


def test_the_nearer_of_two_surfaces_on_a_ray_wins() -> None:
    # The ray of the colour camera's centre: over column 40 + 10 / z of the depth image.
    depth = flat(4.0)
    depth[:, 48:53] = 1.0
    found, z = register_features(np.array([[42.0, 29.0]]), depth, BESIDE)
    assert z[0] == pytest.approx(1.0)
    assert found[0, 0] == pytest.approx(50.0)
    # Left of the post's rim the ray passes by, and meets the wall at column 42.5.
    depth = flat(4.0)
    depth[:, 53:58] = 1.0
    assert register_features(np.array([[42.0, 29.0]]), depth, BESIDE)[1][0] == pytest.approx(4.0)


def test_no_surface_and_no_reading_give_no_depth() -> None:
    found, z = register_features(np.array([[42.0, 29.0], [-400.0, 0.0]]), flat(0.0), BESIDE)
    np.testing.assert_array_equal(z, 0.0)
    assert np.isnan(found).all()
    found, z = register_features(np.empty((0, 2)), flat(1.0), BESIDE)
    assert found.shape == (0, 2) and z.shape == (0,)


def test_a_depth_image_of_another_size_is_refused() -> None:
    with pytest.raises(DatasetError, match="80 x 60"):
        register_features(np.zeros((1, 2)), np.zeros((30, 40), dtype=np.float32), BESIDE)
    with pytest.raises(DatasetError, match="40 x 30"):
        register_color(np.zeros((60, 80, 3), dtype=np.uint8), np.zeros((30, 40), dtype=np.float32), BESIDE)


def test_colour_lands_on_the_pixel_of_its_point() -> None:
    # A ramp in the colour image shows the column from which each depth pixel took its colour.
    ramp = np.repeat(np.tile(np.arange(80, dtype=np.uint8), (60, 1))[..., None], 3, axis=2)
    warped, known = register_color(ramp, flat(2.0), BESIDE)
    expected = ((np.arange(80) - 40.0) / 100.0 - SHIFT_M / 2.0) * 80.0 + 42.0
    assert known[30].all()
    np.testing.assert_allclose(warped[30, :, 0], expected, atol=0.6)
    warped, known = register_color(ramp, flat(0.0), BESIDE)
    assert not known.any() and not warped.any()


def test_what_a_post_hides_from_the_colour_camera_gets_no_colour() -> None:
    image = np.full((60, 80, 3), 200, dtype=np.uint8)
    depth = flat(4.0)
    depth[:, 40:50] = 1.0
    # A wall point of depth column c lies at colour column ((c - 40) / 100 - 0.025) * 80 + 42, the post from
    # 34 to 41.2: it hides the wall of columns 32.5 to 41.5 from the colour camera.
    _, known = register_color(image, depth, BESIDE)
    assert known[30, 40:50].all()
    assert not known[30, 34:40].any()
    assert known[30, 5:31].all() and known[30, 50:].all()


DEPTH_VGA = CameraIntrinsics(585.0, 585.0, 320.0, 240.0, 640, 480)
COLOR_VGA = replace(DEPTH_VGA, fx=525.0, fy=525.0)


BESIDE_VGA = replace(
    BESIDE,
    intrinsics_color=COLOR_VGA,
    intrinsics_depth=DEPTH_VGA,
    T_depth_color=gtsam.Pose3(gtsam.Rot3(), np.array([0.025, 0.0, 0.0])),
)


def rough_wall(seed: int) -> Float32Array:
    """Boxes at 1 to 3 m before a wall: depth as a camera with DEPTH_VGA sees it."""
    rng = np.random.default_rng(seed)
    depth = np.full((480, 640), 3.0, dtype=np.float32)
    for _ in range(30):
        c, r = rng.integers(0, 600), rng.integers(0, 440)
        depth[r : r + rng.integers(40, 160), c : c + rng.integers(40, 160)] = rng.uniform(1.0, 3.0)
    return depth


def matched_pair(seed: int, beside: ColorRegistration, sigma_px: float) -> FramePair:
    """Matches between two frames at a random motion; the second frame's depth image is empty."""
    rng = np.random.default_rng(seed)
    depth = rough_wall(seed)
    pixels = rng.uniform([20.0, 20.0], [620.0, 460.0], (200, 2))
    _, z = register_features(pixels, depth, beside)
    pixels, z = pixels[z > 0.0], z[z > 0.0].astype(np.float64)
    camera = beside.intrinsics_color
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    points = np.column_stack([(pixels - centre) / focal * z[:, None], z])
    motion = gtsam.Pose3.Expmap(np.r_[rng.normal(0.0, 0.06, 3), rng.normal(0.0, 0.1, 3)])
    moved: FloatArray = motion.transformFrom(points.T).T
    other = moved[:, :2] / moved[:, 2:] * focal + centre
    wrong = rng.random(len(other)) < 0.2
    other[wrong] += rng.normal(0.0, 60.0, (int(wrong.sum()), 2))
    noise = rng.normal(0.0, sigma_px, (2, *other.shape))
    return FramePair(pixels + noise[0], other + noise[1], depth, np.zeros_like(depth))


def matched_pairs(beside: ColorRegistration, count: int = 20, sigma_px: float = 0.5) -> list[FramePair]:
    return [matched_pair(seed, beside, sigma_px) for seed in range(count)]


@pytest.mark.parametrize("shift", [(0.025, 0.0), (-0.05, 0.0)])
def test_a_camera_beside_is_found_from_matches_alone(shift: tuple[float, float]) -> None:
    truth = replace(BESIDE_VGA, T_depth_color=gtsam.Pose3(gtsam.Rot3(), np.array([*shift, 0.0])))
    found = estimate_registration(matched_pairs(truth), DEPTH_VGA, seed=0)
    assert found.accepted, found.reason
    assert found.inlier_share_after > found.inlier_share_before + 0.05
    assert found.intrinsics_color.fx == pytest.approx(525.0, abs=4.0)
    np.testing.assert_allclose(found.T_depth_color.translation(), [*shift, 0.0], atol=0.01)
    # What counts is the place in the depth image.
    pixels, depth = np.random.default_rng(5).uniform(100.0, 380.0, (200, 2)), rough_wall(99)
    off = register_features(pixels, depth, found)[0] - register_features(pixels, depth, truth)[0]
    assert np.nanmedian(np.linalg.norm(off, axis=1)) < 1.5


def as_registered(intrinsics: CameraIntrinsics) -> ColorRegistration:
    return identity_registration(intrinsics, "test")


@pytest.mark.parametrize("sigma_px", [0.3, 1.5])
def test_a_registered_log_stays_registered(sigma_px: float) -> None:
    found = estimate_registration(
        matched_pairs(as_registered(DEPTH_VGA), sigma_px=sigma_px), DEPTH_VGA, seed=0
    )
    assert not found.accepted
    assert found.reason.startswith("taken as registered")
    assert found.intrinsics_color == DEPTH_VGA
    assert found.T_depth_color.equals(gtsam.Pose3(), 1e-12)
    assert found.inlier_share_before > 0.0


def test_wrong_intrinsics_of_a_registered_log_are_not_taken_for_a_second_camera() -> None:
    pairs = matched_pairs(as_registered(COLOR_VGA))
    found = estimate_registration(pairs, DEPTH_VGA, seed=0)
    assert not found.accepted, found.reason


def test_too_few_pairs_and_pairs_without_a_motion_decide_nothing() -> None:
    few = estimate_registration(matched_pairs(BESIDE_VGA, count=5), DEPTH_VGA, seed=0)
    assert not few.accepted and "5 frame pairs" in few.reason
    rng = np.random.default_rng(0)
    noise = [
        replace(pair, pixels_b=rng.uniform(0.0, 480.0, pair.pixels_b.shape))
        for pair in matched_pairs(BESIDE_VGA)
    ]
    assert "0 frame pairs" in estimate_registration(noise, DEPTH_VGA, seed=0).reason
    assert "0 frame pairs" in estimate_registration([], DEPTH_VGA, seed=0).reason


def test_the_same_seed_gives_the_same_registration() -> None:
    pairs = matched_pairs(BESIDE_VGA, count=10)
    one, two = (estimate_registration(pairs, DEPTH_VGA, seed=3) for _ in range(2))
    assert one.intrinsics_color == two.intrinsics_color and one.reason == two.reason


@pytest.mark.parametrize("side", ["forth", "back"])
def test_a_motion_settles_from_either_side_alone(side: str) -> None:
    rng = np.random.default_rng(3)
    T_b_a = gtsam.Pose3.Expmap(np.array([0.1, -0.2, 0.15, 0.1, -0.2, 0.3]))
    in_a = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 4.0], (40, 3))
    in_b = np.asarray(T_b_a.transformFrom(in_a.T).T)
    camera = np.array([525.0, 500.0, 320.0, 240.0])
    pixels_a, pixels_b = (p[:, :2] / p[:, 2:] * camera[:2] + camera[2:] for p in (in_a, in_b))
    nothing = np.zeros((40, 3))
    points = (in_a, nothing) if side == "forth" else (nothing, in_b)
    start = T_b_a.compose(gtsam.Pose3.Expmap(np.full(6, 0.002))).matrix()[None, :3]
    data = (*points, pixels_a, pixels_b, np.array([0, 40]))
    # Few steps: only the true derivative gets there so fast.
    settled, errors = settle_motions(*data, start, camera, 2.0, 6)
    np.testing.assert_allclose(settled[0], T_b_a.matrix()[:3], atol=1e-6)
    assert np.nanmax(errors) < 1e-6
    assert np.isnan(errors).all(axis=0).tolist() == [side == "back", side == "forth"]


def rendered_pairs(beside: CameraIntrinsics, count: int) -> tuple[list[FramePair], list[FramePair]]:
    """ORB matches in a simulated home seen by a Kinect: colour registered, and from a camera beside."""
    scene, rng = Scene(HOME), np.random.default_rng(1)
    registered: list[FramePair] = []
    apart: list[FramePair] = []
    while len(registered) < count:
        x0, y0, x1, y1 = HOME.rooms[len(registered) % len(HOME.rooms)].rectangle
        at = (rng.uniform(x0 + 0.6, x1 - 0.6), rng.uniform(y0 + 0.6, y1 - 0.6), rng.uniform(0.5, 1.4))
        pose = camera_pose(at, rng.uniform(-np.pi, np.pi), rng.uniform(-0.1, 0.4))
        motion = gtsam.Pose3.Expmap(rng.normal(0.0, 0.12, 6))
        a, b = (look(scene, view, beside, rng) for view in (pose, pose.compose(motion)))
        found = [orb_matches(a[kind], b[kind]) for kind in (0, 1)]
        if min(len(pixels) for pixels, _ in found) > 60 and np.mean(a[2] > 0.0) > 0.5:
            registered.append(FramePair(*found[0], a[2], b[2]))
            apart.append(FramePair(*found[1], a[2], b[2]))
    return registered, apart


def look(
    scene: Scene, T_world_depth: gtsam.Pose3, beside: CameraIntrinsics, rng: np.random.Generator
) -> tuple[ColorImage, ColorImage, Float32Array]:
    """Colour from the depth camera and from 2.5 cm beside, and depth."""
    image = render_rgbd(scene, T_world_depth, KINECT, rng)
    T_world_color = T_world_depth.compose(gtsam.Pose3(gtsam.Rot3(), np.array([0.025, 0.0, 0.0])))
    color = render_rgbd(scene, T_world_color, replace(KINECT, intrinsics=beside), rng).color
    return image.color, color, image.depth_m


def orb_matches(a: ColorImage, b: ColorImage) -> tuple[FloatArray, FloatArray]:
    """(N, 2) pixels in both images."""
    orb, seen = cv2.ORB_create(1000), []
    for image in (a, b):
        points, rows = orb.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        if rows is None:
            return np.empty((0, 2)), np.empty((0, 2))
        seen.append((np.array([point.pt for point in points]), rows))
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(seen[0][1], seen[1][1])
    near = np.array([(m.queryIdx, m.trainIdx) for m in matches if m.distance < 50]).reshape(-1, 2)
    return seen[0][0][near[:, 0]], seen[1][0][near[:, 1]]


def test_a_kinect_in_a_simulated_home_with_colour_registered_and_from_beside() -> None:
    depth = KINECT.intrinsics
    color = replace(depth, fx=0.85 * depth.fx, fy=0.85 * depth.fy)
    registered, apart = rendered_pairs(color, 14)
    refused = estimate_registration(registered, depth, seed=0)
    assert not refused.accepted, refused.reason
    found = estimate_registration(apart, depth, seed=0)
    assert found.accepted, found.reason
    assert found.intrinsics_color.fx == pytest.approx(color.fx, rel=0.02)
    assert found.T_depth_color.translation()[0] == pytest.approx(0.025, abs=0.02)
