"""The cloud of a 3D lidar's map: one point a voxel, normals of known surfaces towards the robot."""

import tempfile

import gtsam
import numpy as np
import pytest
from scipy.spatial import cKDTree

from slam.errors import ScanweaveError
from slam.mapping.cloud_map import CloudTiles
from slam.mapping.dense_map import ColoredCloud
from slam.matching.plane_voxels import surface_normals

COLUMNS = "points_map", "colors", "normals_map"
RNG = np.random.default_rng(2)
HERE = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.1, -0.2), np.array([4.0, -1.0, 0.5]))


def wall(normal, distance_m, count=6000):
    """Points of a wall that faces the origin, and 2 mm off it."""
    normal = np.array(normal) / np.linalg.norm(normal)
    along = np.linalg.svd(normal[None])[2][1:]
    spread = RNG.uniform(-2.0, 2.0, size=(count, 2))
    return spread @ along - normal * (distance_m + 0.002 * RNG.normal(size=(count, 1))), normal


def map_cloud(clouds, poses, voxel_m):
    """All tiles."""
    with tempfile.TemporaryFile() as file:
        yield from CloudTiles(clouds, poses, voxel_m, file).cloud()


def whole(clouds, poses, voxel_m):
    """All tiles of a map as one cloud."""
    parts = list(map_cloud(clouds, poses, voxel_m))
    return ColoredCloud(*(np.vstack([getattr(part, name) for part in parts]) for name in COLUMNS))


@pytest.mark.parametrize("normal", [(1, 0, 0), (0.2, -0.9, 0.3), (0, 0, 1)])
def test_normals_of_a_wall_look_at_the_robot(normal):
    points, normal = wall(normal, 3.0)
    cloud = whole([points], [HERE], 0.1)
    in_map = HERE.rotation().matrix() @ normal
    assert 800 < len(cloud.points_map) < 3000
    np.testing.assert_allclose(np.linalg.norm(cloud.normals_map, axis=1), 1.0, atol=1e-5)
    # Upright walls; of a floor the sign depends on the nearest keyframe's height alone.
    assert (cloud.normals_map @ in_map > 0.99).mean() > 0.99
    heights = (cloud.points_map - HERE.translation()) @ in_map
    np.testing.assert_allclose(heights, -3.0, atol=0.02)


def test_points_without_neighbours_look_up_or_down():
    lonely = np.array([[5.0, 0, 0], [0, 5, 0], [0, 5.1, 0], [0, 0, 5]])
    cloud = whole([lonely], [gtsam.Pose3()], 0.05)
    np.testing.assert_array_equal(np.abs(cloud.normals_map), np.tile([0, 0, 1], (4, 1)))


def test_normals_near_an_edge_are_those_of_one_side():
    side = np.arange(0.0, 2.0, 0.05)
    one, other = (axis.ravel() for axis in np.meshgrid(side, side))
    floor = np.column_stack([one, other, np.zeros(one.size)])
    back = np.column_stack([one, np.zeros(one.size), other + 0.05])
    near = np.abs(np.vstack([surface_normals(floor, 0.05), surface_normals(back, 0.05)[:, [0, 2, 1]]])[:, 2])
    both = surface_normals(np.vstack([floor, back]), 0.05)
    found = np.abs(np.concatenate([both[: len(floor), 2], both[len(floor) :, 1]]))
    assert (near > 0.999).all()
    assert (found > 0.99).mean() > 0.96


def test_the_normals_are_those_of_open3d(open3d):
    walls = [wall((1, 0, 0), 3.0)[0], wall((0, 1, 0.1), 2.0)[0]]
    points = np.vstack(walls)
    apart = cKDTree(walls[0]).query(walls[1])[0] > 0.4, cKDTree(walls[1]).query(walls[0])[0] > 0.4
    found = surface_normals(points, 0.15)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamHybrid(radius=0.3, max_nn=20))
    same = np.abs(np.sum(found * np.asarray(cloud.normals), axis=1)) > 0.999
    assert same[np.concatenate(apart[::-1])].mean() > 0.998


def test_nothing_gives_nothing_and_a_bad_pose_is_named():
    assert not list(map_cloud([np.zeros((0, 3))], [gtsam.Pose3()], 0.1))
    assert not list(map_cloud([], [], 0.1))
    lost = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0, 0]))
    with pytest.raises(ScanweaveError, match="pose 1 of 2 keyframes is not finite"):
        list(map_cloud([np.ones((1, 3)), np.ones((1, 3))], [gtsam.Pose3(), lost], 0.1))


def test_tiles_keep_the_intensity_of_the_point_that_stays():
    points, _ = wall((0, 0, 1), 1.0)
    here, there = gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 3.0]))
    stated = np.column_stack([points, 1e3 * points[:, 0]])
    parts = list(map_cloud([stated, points], [here, there], 0.1))
    cloud = np.vstack([np.column_stack([part.points_map, part.intensities]) for part in parts])
    low = cloud[:, 2] < 0.5
    np.testing.assert_allclose(cloud[low, 3], 1e3 * cloud[low, 0], rtol=1e-5)
    assert np.isnan(cloud[~low, 3]).all() and low.any() and not low.all()  # the second lidar gave none
    assert all(part.intensities is None for part in map_cloud([points], [here], 0.1))


def test_tiles_make_one_cloud_with_a_point_a_voxel():
    """However many tiles: every voxel once, its first point, seen from the keyframe that saw it."""
    points, _ = wall((0, 0, 1), 1.0)
    seen = [points, points + np.array([0.0, 0.0, 6.0])]
    there = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, -5.0]))
    parts = list(map_cloud(seen, [gtsam.Pose3(), there], 0.1))
    assert len(parts) > 1
    cloud = whole(seen, [gtsam.Pose3(), there], 0.1)
    voxels = np.unique(np.floor(np.vstack([points, seen[1] + there.translation()]) / 0.1), axis=0)
    assert len(cloud.points_map) == pytest.approx(len(voxels), abs=3)
    up = cloud.normals_map[:, 2] > 0.0
    assert up[cloud.points_map[:, 2] < -0.5].all()
    assert not up[cloud.points_map[:, 2] > -0.5].any()
