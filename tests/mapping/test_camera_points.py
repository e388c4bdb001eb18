"""Coloured points of frames whose world is known, without a surface fused of them."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from box_world import BOX_LOW, BOX_RGB, WALL_RGB, box_frames, camera_poses, distances

from slam.errors import ScanweaveError
from slam.mapping import camera_points
from slam.mapping.camera_points import camera_cloud
from slam.mapping.dense_map import DenseMapSettings

SETTINGS = DenseMapSettings(voxel_size_m=0.02, minimum_views=2)
ELSEWHERE = gtsam.Pose3(gtsam.Rot3.Ypr(0.7, -0.4, 1.1), [12.3, -7.1, 2.9])


@pytest.fixture(scope="module", params=[gtsam.Pose3(), ELSEWHERE], ids=["at the origin", "elsewhere"])
def seen(request):
    """The cloud in the world where the truth is known: points, colours, normals."""
    cloud = camera_cloud(box_frames(), camera_poses(request.param), SETTINGS)
    back = request.param.inverse()
    turn = back.rotation().matrix()
    return cloud.points_map @ turn.T + back.translation(), cloud.colors, cloud.normals_map @ turn.T


def test_points_lie_on_the_surfaces_one_a_voxel(seen):
    points, _, _ = seen
    to_surface = np.min(distances(points), axis=0)
    assert np.mean(to_surface < 0.002) > 0.95 and to_surface.max() < SETTINGS.voxel_size_m
    assert 5000 < len(points) < 20000
    front = np.abs(points[:, 2] - BOX_LOW[2]) < 0.005
    # 0.6 m x 0.45 m; voxels on either side of a face between them hold a point each.
    assert 0.8 < front.sum() * SETTINGS.voxel_size_m**2 / 0.27 < 2.3


def test_colours_and_normals_are_those_of_the_surfaces(seen):
    points, colors, normals = seen
    to_wall, _ = distances(points)
    wall = (to_wall < 1e-3) & (np.abs(points[:, 0]) > 0.8)
    front = (np.abs(points[:, 2] - BOX_LOW[2]) < 1e-3) & (np.abs(points[:, :2]) < 0.15).all(axis=1)
    for surface, rgb in ((wall, WALL_RGB), (front, BOX_RGB)):
        assert surface.sum() > 100
        np.testing.assert_array_equal(np.unique(colors[surface], axis=0), [rgb])
        assert (normals[surface] @ [0.0, 0.0, -1.0] > 0.99).mean() > 0.99


def test_what_too_few_frames_saw_and_what_has_no_depth_is_left_out():
    frames, poses = box_frames(count=1), camera_poses(count=1)
    blind = replace(frames[0], depth_m=np.zeros_like(frames[0].depth_m))
    assert len(camera_cloud([*frames, blind], poses * 2, SETTINGS).points_map) == 0
    assert len(camera_cloud(frames * 2, poses * 2, SETTINGS).points_map) > 1000
    near = replace(SETTINGS, depth_max_m=1.7, minimum_views=1)
    points = camera_cloud(frames, [gtsam.Pose3()], near).points_map
    assert len(points) > 0 and points[:, 2].max() <= 1.7
    assert len(camera_cloud([], [], SETTINGS).points_map) == 0


def test_how_many_frames_wait_changes_nothing_but_memory(monkeypatch):
    at_once = camera_cloud(box_frames(), camera_poses(), SETTINGS)
    monkeypatch.setattr(camera_points, "_BATCH", 1)
    one_by_one = camera_cloud(box_frames(), camera_poses(), SETTINGS)
    np.testing.assert_allclose(one_by_one.points_map, at_once.points_map, atol=1e-6)
    with pytest.raises(
        ScanweaveError, match=r"more than 0\.1 MB at voxels of 0\.02 m; use a larger voxel_size_m"
    ):
        camera_cloud(box_frames(), camera_poses(), replace(SETTINGS, memory_limit_mb=0.1))


def test_poses_that_do_not_fit_the_frames_are_refused():
    with pytest.raises(ValueError, match=r"shorter|longer"):
        camera_cloud(box_frames(count=3), camera_poses(), SETTINGS)
