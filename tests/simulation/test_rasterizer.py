"""The rasterizer sees what rays see, without a gap between triangles."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from slam.measurements import CameraIntrinsics
from slam.simulation.home import generate_home
from slam.simulation.rasterizer import rasterize
from slam.simulation.ray_caster import RayCaster

HOME = generate_home(2, rooms=2)
CAMERA = CameraIntrinsics(90.0, 85.0, 63.2, 47.9, 128, 96)
# Faces inward, for a camera in it; 2 x 2 x 2.
CORNERS = np.array([[x, y, z] for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
CUBE = np.array(
    [
        *([0, 1, 2], [1, 3, 2], [4, 6, 5], [5, 6, 7], [0, 4, 1], [1, 4, 5]),
        *([2, 3, 6], [3, 7, 6], [0, 2, 4], [2, 6, 4], [1, 5, 3], [3, 5, 7]),
    ],
    dtype=np.int32,
)


@pytest.mark.parametrize("seed", range(6))
def test_an_image_is_what_its_rays_meet(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y, _ = HOME.start_xy_yaw
    rotation = gtsam.Rot3.RzRyRx(*rng.uniform(-math.pi, math.pi, 3))
    pose = gtsam.Pose3(rotation, np.array([x, y, 0.9]) + rng.uniform(-0.1, 0.1, 3))
    seen_m, triangle = rasterize(
        (HOME.vertices - pose.translation()) @ rotation.matrix(), HOME.triangles, CAMERA
    )
    u, v = np.meshgrid(np.arange(128.0), np.arange(96.0))
    slopes = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    directions = slopes.reshape(-1, 3) @ rotation.matrix().T
    rays = np.hstack([np.broadcast_to(pose.translation(), directions.shape), directions]).astype(np.float32)
    range_m, met, _ = RayCaster(HOME.vertices, HOME.triangles).cast(rays)
    assert np.count_nonzero(triangle != met) <= 3
    same = triangle == met
    np.testing.assert_allclose(seen_m[same], range_m[same], rtol=1e-5)
    assert len(set(triangle.tolist())) > 5


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (0.25, -0.5, 0.125), (0.0, 0.999, 0.0)])
def test_edges_through_the_middle_of_pixels_leave_no_gap(at: tuple[float, float, float]) -> None:
    # Diagonals and corners of the cube meet pixels exactly.
    camera = CameraIntrinsics(16.0, 16.0, 32.0, 32.0, 65, 65)
    depth_m, triangle = rasterize(CORNERS - at, CUBE, camera)
    assert (triangle >= 0).all()
    u, v = np.meshgrid(np.arange(65.0) - 32.0, np.arange(65.0) - 32.0)
    slopes = np.stack([u / 16.0, v / 16.0, np.ones_like(u)], axis=-1).reshape(-1, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.where(slopes == 0.0, np.inf, (np.sign(slopes) - at) / slopes)
    np.testing.assert_allclose(depth_m, walls.min(axis=1), rtol=1e-6)


def test_what_is_behind_or_beside_or_on_edge_is_not_seen() -> None:
    camera = CameraIntrinsics(16.0, 16.0, 8.0, 8.0, 17, 17)
    for moved in ([0.0, 0.0, -5.0], [50.0, 0.0, 0.0], [0.0, -1.0, 0.0]):
        floor = np.array([[-1.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
        wall = np.array([[-1.0, -1.0, 2.0], [1.0, -1.0, 2.0], [0.0, 1.0, 2.0]])
        corners = wall + moved if moved[1] == 0.0 else floor
        depth_m, triangle = rasterize(corners, np.array([[0, 1, 2]], dtype=np.int32), camera)
        assert np.isinf(depth_m).all() and (triangle == -1).all()
    depth_m, triangle = rasterize(np.zeros((0, 3)), np.zeros((0, 3), np.int32), camera)
    assert np.isinf(depth_m).all() and (triangle == -1).all()
