import numpy as np
import pytest

from fusion.curves import Intrinsics
from fusion.height_band import (
    HeightBand,
    back_project,
    dense_enough,
    obstacle_points,
    pixel_rays,
    thin_evenly,
    thin_to_voxels,
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
    filters = {"radius_m": 0.04, "least_neighbours": 6, "voxel_m": 0.01}
    assert len(obstacle_points(double, HeightBand(0.0, 2.0, 0.0), **filters)) == 0
    assert len(thin_to_voxels(np.concatenate([double, patch]), 0.01)) == 101


def test_a_thinned_wall_that_noise_makes_thick_stays_where_it_is():
    """Seen aslant from one bearing to the next, the first point of each voxel is off by 13 cm."""
    offs = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        bearings = np.radians(np.linspace(20.0, 70.0, 20_000))
        ranges = 8.0 / np.sin(bearings) * (1.0 + 0.02 * rng.standard_normal(20_000))
        x, y = ranges * np.cos(bearings), ranges * np.sin(bearings)
        wall = np.column_stack([x, y, rng.uniform(0.0, 2.0, 20_000)])
        offs.append([np.mean(thin(wall, 0.5)[:, 1]) - 8.0 for thin in (thin_to_voxels, thin_evenly)])
    first, evenly = np.mean(offs, axis=0)
    assert first < -0.1
    assert abs(evenly) < 0.02


def test_thinned_evenly_each_voxel_keeps_one_point():
    """Whatever their number, which the steps must not divide."""
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (3000, 3))
    for count in (*range(40), 987, 1597, 3000):
        some = points[:count]
        cells, kept = (np.floor(each / 0.5).astype(int) for each in (some, thin_evenly(some, 0.5)))
        assert len(kept) == len(np.unique(kept, axis=0)) == len(np.unique(cells, axis=0))
