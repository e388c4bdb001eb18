from dataclasses import replace

import gtsam
import numpy as np
import pytest
from box_world import (
    BOX_HIGH,
    BOX_LOW,
    BOX_RGB,
    CAMERA,
    WALL_RGB,
    box_frame,
    box_frames,
    camera_poses,
    distances,
)

from slam.errors import ScanweaveError
from slam.mapping.dense_map import DenseMapSettings, fuse_keyframes
from slam.mapping.voxel_blocks import SIDE
from slam.measurements import RgbdFrame

SETTINGS = DenseMapSettings(voxel_size_m=0.02, depth_max_m=4.0, minimum_views=2)
ELSEWHERE = gtsam.Pose3(gtsam.Rot3.Ypr(0.7, -0.4, 1.1), [12.3, -7.1, 2.9])


@pytest.fixture(scope="module", params=[gtsam.Pose3(), ELSEWHERE], ids=["at the origin", "elsewhere"])
def fused(request):
    """The map of the box before the wall, and T_world_map back to where the truth is known."""
    return fuse_keyframes(box_frames(), camera_poses(request.param), SETTINGS), request.param.inverse()


def in_world(T_world_map, points_map):
    return points_map @ T_world_map.rotation().matrix().T + T_world_map.translation()


def on_box_front(points_world):
    inside = (points_world[:, :2] > BOX_LOW[:2] + 0.05) & (points_world[:, :2] < BOX_HIGH[:2] - 0.05)
    return inside.all(axis=1) & (np.abs(points_world[:, 2] - BOX_LOW[2]) < 0.02)


def test_vertices_lie_on_the_wall_and_the_box(fused):
    dense, T_world_map = fused
    for points_map in (dense.vertices_map, dense.cloud.points_map):
        points = in_world(T_world_map, points_map)
        to_wall, to_box = distances(points)
        to_surface = np.minimum(to_wall, to_box)
        # What is left lies on the silhouettes of the box, where a view along the surface decides.
        assert np.mean(to_surface < SETTINGS.voxel_size_m) > 0.99
        assert to_surface.max() < SIDE / 2 * SETTINGS.voxel_size_m
        assert np.mean(to_surface < 0.1 * SETTINGS.voxel_size_m) > 0.9
        assert on_box_front(points).sum() > 400
        assert np.sum((to_wall < SETTINGS.voxel_size_m) & (np.abs(points[:, 0]) > 0.6)) > 2000


def test_colours_are_those_of_the_surfaces(fused):
    dense, T_world_map = fused
    for points_map, colors in (
        (dense.vertices_map, dense.colors),
        (dense.cloud.points_map, dense.cloud.colors),
    ):
        points = in_world(T_world_map, points_map)
        assert colors.dtype == np.uint8
        np.testing.assert_array_equal(np.unique(colors[on_box_front(points)], axis=0), [BOX_RGB])
        on_wall = (np.abs(points[:, 0]) > 0.9) & (distances(points)[0] < 0.02)
        np.testing.assert_array_equal(np.unique(colors[on_wall], axis=0), [WALL_RGB])


def test_normals_and_faces_look_at_the_camera(fused):
    mesh, T_world_map = fused
    front = on_box_front(in_world(T_world_map, mesh.vertices_map))
    towards_camera = T_world_map.inverse().rotation().matrix() @ [0.0, 0.0, -1.0]
    assert (mesh.normals_map[front] @ towards_camera > 0.99).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.cloud.normals_map, axis=1), 1.0, atol=1e-3)
    a, b, c = (mesh.vertices_map[mesh.faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    inward = np.sum(area * mesh.normals_map[mesh.faces[:, 0]], axis=1) < 0.0
    # Where a wall lies on voxels to the bit, slivers of triangles fold over.
    assert np.linalg.norm(area[inward], axis=1).sum() < 0.002 * np.linalg.norm(area, axis=1).sum()


def test_a_slanted_wall_is_not_shifted_by_half_a_pixel():
    # z = 1.5 + 0.8 x falls by 8 mm a pixel; cutting pixels off instead of rounding moves it by half of that.
    u = np.arange(CAMERA.width)
    row_m = 1.5 / (1.0 - 0.8 * (u - CAMERA.cx) / CAMERA.fx)
    depth_m = np.tile(row_m.astype(np.float32), (CAMERA.height, 1))
    frame = RgbdFrame(0.0, np.full((*depth_m.shape, 3), 99, np.uint8), depth_m, CAMERA)
    settings = replace(SETTINGS, minimum_views=1)
    points = fuse_keyframes([frame], [gtsam.Pose3()], settings).cloud.points_map
    offsets = (points[:, 2] - 1.5 - 0.8 * points[:, 0]) / np.hypot(1.0, 0.8)
    assert len(points) > 2000
    assert abs(offsets.mean()) < 0.0005


def test_readings_outside_the_depth_range_are_not_used():
    frame, pose = box_frame(gtsam.Pose3()), gtsam.Pose3(gtsam.Rot3(), [0.0, 0.0, 0.007])
    settings = DenseMapSettings(voxel_size_m=0.02, depth_min_m=1.7, depth_max_m=3.0, minimum_views=1)
    no_box = fuse_keyframes([frame], [pose], settings).cloud.points_map
    np.testing.assert_allclose(no_box[:, 2], 2.007, atol=1e-3)
    settings = replace(SETTINGS, depth_max_m=1.7, minimum_views=1)
    no_wall = fuse_keyframes([frame], [pose], settings).cloud.points_map
    np.testing.assert_allclose(no_wall[:, 2], 1.407, atol=1e-3)
    assert min(len(no_box), len(no_wall)) > 400


def test_what_too_few_frames_saw_and_what_has_no_depth_is_left_out():
    frame, pose = box_frame(gtsam.Pose3()), gtsam.Pose3(gtsam.Rot3(), [0.0, 0.0, 0.007])
    blind = RgbdFrame(0.0, frame.color, np.zeros_like(frame.depth_m), CAMERA)
    behind = gtsam.Pose3(gtsam.Rot3.Ypr(0.0, np.pi, 0.0), pose.translation())
    once = fuse_keyframes([frame, frame], [pose, behind], SETTINGS)
    assert once.faces.shape == once.cloud.points_map.shape == (0, 3)
    alone = fuse_keyframes([frame, blind], [pose, pose], SETTINGS)
    assert len(alone.faces) > 1000, "no other could have seen it"
    never = fuse_keyframes([blind], [pose], SETTINGS)
    assert never.vertices_map.shape == never.cloud.colors.shape == (0, 3)
    assert len(fuse_keyframes([frame, frame], [pose, pose], SETTINGS).faces) > 1000


@pytest.mark.parametrize(("row", "col"), [(6, 12), (7, 13), (121, 12), (6, 161)])
def test_a_frame_with_a_single_reading_stops_nothing(row, col):
    camera = replace(CAMERA, width=162, height=122)
    depth_m = np.zeros((122, 162), np.float32)
    depth_m[row, col] = 2.0
    frame = RgbdFrame(0.0, np.zeros((122, 162, 3), np.uint8), depth_m, camera)
    assert not len(fuse_keyframes([frame], [gtsam.Pose3()], SETTINGS).faces)


def test_the_same_frames_give_the_same_bytes():
    first, second = (fuse_keyframes(box_frames(), camera_poses(ELSEWHERE), SETTINGS) for _ in range(2))
    for name in ("vertices_map", "colors", "normals_map", "faces"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes(), name


def test_the_surface_has_no_hole_within_what_was_seen():
    """Every edge of the wall's middle belongs to two triangles."""
    pose = gtsam.Pose3(gtsam.Rot3.Ypr(0.1, 0.2, 0.3), [0.01, 0.02, 0.03])
    depth_m = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    frame = RgbdFrame(0.0, np.zeros((*depth_m.shape, 3), np.uint8), depth_m, CAMERA)
    mesh = fuse_keyframes([frame, frame], [pose, pose], SETTINGS)
    assert len(mesh.faces) > 2000
    middle = np.linalg.norm(mesh.vertices_map - pose.transformFrom([0.0, 0.0, 2.0]), axis=1) < 0.5
    edges = np.sort(np.concatenate([mesh.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]), axis=1)
    _, counts = np.unique(edges[middle[edges].all(axis=1)], axis=0, return_counts=True)
    np.testing.assert_array_equal(counts, 2)


def test_the_memory_limit_is_an_error_with_its_remedy():
    settings = replace(SETTINGS, memory_limit_mb=1.0)
    with pytest.raises(
        ScanweaveError, match=r"more than 1 MB at voxels of 0\.02 m; use a larger voxel_size_m"
    ):
        fuse_keyframes(box_frames(), camera_poses(), settings)


def test_poses_that_do_not_fit_the_frames_are_refused():
    frames, poses = box_frames(count=3), camera_poses(count=3)
    with pytest.raises(ValueError, match=r"longer|shorter"):
        fuse_keyframes(iter(frames), camera_poses(), SETTINGS)
    with pytest.raises(ValueError, match=r"longer|shorter"):
        fuse_keyframes(iter(frames), poses[:2], SETTINGS)
    poses[1] = gtsam.Pose3(gtsam.Rot3(), [0.0, np.nan, 0.0])
    with pytest.raises(ScanweaveError, match="pose 1 of 3 keyframes is not finite"):
        fuse_keyframes(frames, poses, SETTINGS)
