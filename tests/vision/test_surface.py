"""Planes in depth images: exact normals on a slant, none in a hole, and points where they belong."""

from __future__ import annotations

import numpy as np
import pytest
from room_world import MIDDLE, SMALL, furnished, in_world, looking, off_surfaces, render

from slam.measurements import CameraIntrinsics, FloatArray
from slam.vision.surface import points_of, surface_of, working_depth


def plane_depth(normal: FloatArray, distance_m: float, camera: CameraIntrinsics) -> np.ndarray:
    """Depth of the plane normal . p = distance, seen by every pixel."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return (distance_m / (rays @ normal)).astype(np.float32)


@pytest.mark.parametrize("slant", [(0.0, 0.0), (0.7, 0.0), (0.0, -0.9), (-0.6, 0.5), (1.1, 0.3)])
@pytest.mark.parametrize("radius", [1, 3])
def test_the_normal_of_a_slanted_plane_is_exact(slant: tuple[float, float], radius: int) -> None:
    """A plane is linear in inverse depth, so no window is too wide."""
    normal = np.array([np.tan(slant[0]), np.tan(slant[1]), 1.0])
    normal /= np.linalg.norm(normal)
    depth = plane_depth(normal, 1.5, SMALL)
    depth[(depth < 0.3) | (depth > 6.0)] = 0.0
    surface = surface_of(depth, SMALL, radius, 6.0)
    seen = surface.planes[..., 0] > 0.0
    assert seen.mean() > 0.4
    normals = surface.planes[..., 1:]
    np.testing.assert_allclose(normals[seen], np.broadcast_to(-normal, (seen.sum(), 3)), atol=2e-4)
    np.testing.assert_allclose(1.0 / surface.planes[..., 0][seen], depth[seen], rtol=1e-4)
    assert not normals[~seen].any()


def test_noise_is_smoothed_as_the_window_says() -> None:
    """49 readings: the middle of their plane is seven times as certain as one."""
    rng = np.random.default_rng(0)
    inverse = 0.5 + 0.002 * rng.standard_normal((SMALL.height, SMALL.width))
    surface = surface_of((1.0 / inverse).astype(np.float32), SMALL, 3, 6.0)
    smooth = surface.planes[..., 0][surface.planes[..., 0] > 0.0]
    assert smooth.std() == pytest.approx(0.002 / 7.0, rel=0.1)


def test_a_rim_parts_two_surfaces() -> None:
    depth = np.full((SMALL.height, SMALL.width), 2.0, np.float32)
    depth[:, :70] = 1.0
    surface = surface_of(depth, SMALL, 3, 6.0)
    seen = surface.planes[..., 0] > 0.0
    assert set(np.unique(np.round(1.0 / surface.planes[..., 0][seen], 3))) == {1.0, 2.0}
    np.testing.assert_allclose(
        surface.planes[..., 1:][seen], np.tile([0.0, 0.0, -1.0], (seen.sum(), 1)), atol=1e-5
    )


def test_a_thin_thing_has_no_surface() -> None:
    depth = np.zeros((SMALL.height, SMALL.width), np.float32)
    depth[:, 80:82] = 1.0
    assert not surface_of(depth, SMALL, 3, 6.0).planes[..., 0].any()
    assert len(points_of(depth, SMALL, 3, 6.0, 500)) == 0


def test_holes_and_what_lies_too_far_are_left_out() -> None:
    depth = np.full((SMALL.height, SMALL.width), 2.0, np.float32)
    depth[40:60, 40:60] = 0.0
    depth[:, 120:] = 6.5
    seen = surface_of(depth, SMALL, 3, 6.0).planes[..., 0] > 0.0
    assert not seen[40:60, 40:60].any()
    assert not seen[:, 120:].any()
    assert seen[30, 30]


def test_no_depth_gives_nothing() -> None:
    depth = np.zeros((SMALL.height, SMALL.width), np.float32)
    assert not surface_of(depth, SMALL, 3, 6.0).planes[..., 0].any()
    assert points_of(depth, SMALL, 3, 6.0, 500).points.shape == (0, 3)


@pytest.mark.parametrize("count", [300, 2000, 10**6])
def test_points_lie_on_the_room_and_are_as_many_as_asked(count: int) -> None:
    room, pose = furnished(), looking(0.2, -0.1, 1.3, 0.4, 0.1)
    frame = render(room, pose, SMALL)
    found = points_of(frame.depth_m, SMALL, 3, 6.0, count)
    assert 0.5 * min(count, 15000) < len(found) < 1.5 * count
    off_m = off_surfaces(room, in_world(found.points, pose))
    assert np.quantile(off_m, 0.9) < 0.002
    assert off_m.max() < 0.04  # where two walls meet, the plane cuts the corner
    np.testing.assert_allclose(np.linalg.norm(found.rows[3:], axis=0), 1.0, atol=1e-5)
    assert (np.sum(found.rows[3:] * found.rows[:3], axis=0) < 0.0).all(), "towards the camera"


@pytest.mark.parametrize("width", [320, 200, 160, 100])
def test_a_reduced_image_shows_the_same_points(width: int) -> None:
    room, pose = furnished(), looking(0.2, -0.1, 1.3, 0.4, 0.1)
    frame = render(room, pose, MIDDLE)
    depth, camera = working_depth(frame.depth_m, MIDDLE, width)
    assert depth.shape == (camera.height, camera.width)
    assert camera.width <= width
    v, u = np.indices(depth.shape)
    points = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    points = (points * depth[..., None]).reshape(-1, 3)
    # Not a mean over a rim: every point is one that was read.
    assert off_surfaces(room, in_world(points, pose)).max() < 1e-5


@pytest.mark.parametrize("count", [200, 900, 4000])
def test_points_are_the_surface_at_every_so_manyth_pixel(count: int) -> None:
    frame = render(furnished(), looking(2.0, 1.8, 1.2, 0.5), SMALL)
    surface = surface_of(frame.depth_m, SMALL, 3, 6.0)
    points = points_of(frame.depth_m, SMALL, 3, 6.0, count)
    step = max(1, round(np.sqrt(np.count_nonzero(frame.depth_m) / count)))
    lattice = np.zeros(surface.planes[..., 0].shape, bool)
    lattice[3::step, 3::step] = True
    on = lattice & (surface.planes[..., 0] > 0.0)
    np.testing.assert_array_equal(points.points[:, 2], np.float32(1.0) / surface.planes[..., 0][on])
    np.testing.assert_array_equal(points.rows[3:].T, surface.planes[..., 1:][on])
