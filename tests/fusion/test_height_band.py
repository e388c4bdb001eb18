import math

import numpy as np
import pytest

from fusion.curves import Intrinsics
from fusion.height_band import (
    ArmJoint,
    HeightBand,
    LensDistortion,
    back_project,
    camera_on_arm,
    count_in_cells,
    dense_enough,
    distort,
    obstacle_points,
    pixel_rays,
    thin_to_voxels,
    to_frame,
)

CAMERA = Intrinsics(100.0, 110.0, 31.5, 23.5)


def moved(x, y, z):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def test_back_projection_is_the_inverse_of_projection():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 4.0, (48, 64)).astype(np.float32)
    depth[3, 5], depth[7, 9] = 0.0, np.nan
    points = back_project(depth, pixel_rays(depth.shape, CAMERA))
    rows, cols = np.nonzero(np.isfinite(depth) & (depth > 0))
    assert len(points) == 48 * 64 - 2
    # Yang2021 Eq. (13).
    np.testing.assert_allclose(CAMERA.fx * points[:, 0] / points[:, 2] + CAMERA.cx, cols, atol=1e-9)
    np.testing.assert_allclose(CAMERA.fy * points[:, 1] / points[:, 2] + CAMERA.cy, rows, atol=1e-9)
    np.testing.assert_allclose(points[:, 2], depth[rows, cols])


def test_distortion_is_taken_off_as_opencv_does():
    import cv2

    lens = LensDistortion(-0.2, 0.05, 0.002, -0.001, 0.01)
    rays = pixel_rays((48, 64), CAMERA, lens)
    np.testing.assert_allclose(distort(rays, lens), pixel_rays((48, 64), CAMERA), atol=1e-7)
    pixels = np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), axis=-1).reshape(-1, 1, 2)
    matrix = np.array([[100.0, 0, 31.5], [0, 110.0, 23.5], [0, 0, 1]])
    theirs = cv2.undistortPoints(pixels, matrix, np.array([-0.2, 0.05, 0.002, -0.001, 0.01]))
    np.testing.assert_allclose(rays.reshape(-1, 1, 2), theirs, atol=2e-4)


def test_the_chain_of_an_arm_in_closed_form():
    # Shoulder at 0.3 m turns about z, a slide goes out along x, the camera sits 0.1 m above its end.
    joints = [ArmJoint(moved(0, 0, 0.3)), ArmJoint(np.eye(4), (1.0, 0.0, 0.0), "slide")]
    T = camera_on_arm(joints, [math.pi / 2, 0.4], moved(0, 0, 0.1))
    np.testing.assert_allclose(T[:3, 3], [0.0, 0.4, 0.4], atol=1e-12)
    np.testing.assert_allclose(T[:3, 0], [0.0, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(camera_on_arm([], [], moved(1, 2, 3)), moved(1, 2, 3))
    np.testing.assert_allclose(to_frame(np.array([[1.0, 0, 0]]), T), [[0.0, 1.4, 0.4]], atol=1e-12)
    with pytest.raises(ValueError, match="zip"):
        camera_on_arm(joints, [0.0], np.eye(4))


def test_the_band_is_open_at_both_ends():
    band = HeightBand(0.1, 0.2, 0.03)
    assert band.high_m == pytest.approx(0.33)
    z = np.array([0.0, 0.03, 0.031, 0.2, 0.329, band.high_m, 0.5])
    assert band.holds(z).tolist() == [False, False, True, True, True, False, False]
    assert band.holds(z, 0.01).tolist() == [False, False, False, True, True, False, False]
    with pytest.raises(ValueError, match="empty"):
        HeightBand(0.0, 0.0, 0.03)


def test_the_radius_filter_drops_the_lone_and_keeps_the_dense():
    patch = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0), [0.0]), axis=-1).reshape(-1, 3) * 0.01
    points = np.concatenate([patch, [[1.0, 1.0, 1.0], [1.0, 1.0, 1.005]]])
    assert dense_enough(points, 0.025, 4).tolist() == [True] * 100 + [False] * 2
    assert dense_enough(points[:0], 0.025, 4).size == 0
    # A voxel's own doubles do not vouch for it once it is thinned.
    double = np.repeat(points[-1:], 50, axis=0)
    assert len(obstacle_points(double, HeightBand(0.0, 2.0, 0.0), voxel_m=0.01)) == 0
    assert len(thin_to_voxels(np.concatenate([double, patch]), 0.01)) == 101


def test_cells_and_their_counts():
    xy = np.array([[0.01, 0.01], [0.04, 0.02], [-0.01, 0.0], [0.06, 0.11]])
    cells, counts = count_in_cells(xy, 0.05)
    assert dict(zip(map(tuple, cells.tolist()), counts.tolist(), strict=True)) == {
        (0, 0): 2,
        (-1, 0): 1,
        (1, 2): 1,
    }
    assert count_in_cells(np.zeros((0, 3)), 0.05)[0].shape == (0, 2)
