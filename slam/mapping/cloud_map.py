"""The cloud of the whole map from the clouds of its keyframes, coloured by height."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from fusion.height_band import thin_to_voxels
from slam.errors import ScanweaveError
from slam.mapping.dense_map import ColoredCloud, Colors
from slam.matching.local_cloud import moved
from slam.matching.plane_voxels import surface_normals
from slam.measurements import FloatArray

# What keyframes saw is thinned together by so many, so that no more than these and the map are held.
BATCH = 32
# Side of a cell of neighbours: wider than what a lidar is off by.
_NORMAL_VOXELS = 1.5
# Blue, green, yellow, red from the lowest to the highest usual height.
_RAMP = np.array([[40, 60, 160], [40, 160, 120], [230, 210, 60], [200, 60, 40]], dtype=np.float64)
_USUAL_PERCENT = (1.0, 99.0)


def map_cloud(clouds: Iterable[FloatArray], poses: Sequence[gtsam.Pose3], voxel_m: float) -> ColoredCloud:
    """One point a voxel, with normals towards the robot.

    Parameters
    ----------
    clouds
        (N, 3) points of each keyframe, base frame.
    poses
        ``T_map_base`` of each.

    Raises
    ------
    ScanweaveError
        Where a pose is not finite.
    """
    batches: list[FloatArray] = []
    waiting: list[FloatArray] = []
    for number, (points, pose) in enumerate(zip(clouds, poses, strict=True)):
        if not np.isfinite(pose.matrix()).all():
            raise ScanweaveError(f"pose {number} of {len(poses)} keyframes is not finite; see the report")
        waiting.append(moved(points, pose))
        if len(waiting) == BATCH:
            batches.append(thin_to_voxels(np.vstack(waiting), voxel_m))
            waiting = []
    gathered = [*batches, *waiting]
    points_map = thin_to_voxels(np.vstack(gathered), voxel_m) if gathered else np.zeros((0, 3))
    normals = _towards_the_path(points_map, surface_normals(points_map, _NORMAL_VOXELS * voxel_m), poses)
    return ColoredCloud(points_map.astype(np.float32), by_height(points_map), normals.astype(np.float32))


def _towards_the_path(points: FloatArray, normals: FloatArray, poses: Sequence[gtsam.Pose3]) -> FloatArray:
    """Normals turned to the nearest keyframe, from where a surface was most likely seen."""
    from scipy.spatial import cKDTree

    if not len(points):
        return normals.reshape(0, 3)
    path = np.array([pose.translation() for pose in poses])
    nearest = cKDTree(path[:, :2]).query(points[:, :2])[1]
    away = np.einsum("ij,ij->i", normals, path[nearest] - points) < 0.0
    return np.where(away[:, None], -normals, normals)


def by_height(points: FloatArray) -> Colors:
    """(N, 3) RGB of the heights."""
    if not len(points):
        return np.zeros((0, 3), dtype=np.uint8)
    low, high = np.percentile(points[:, 2], _USUAL_PERCENT)
    share = np.clip((points[:, 2] - low) / max(high - low, 1e-6), 0.0, 1.0) * (len(_RAMP) - 1)
    channels = [np.interp(share, np.arange(len(_RAMP)), _RAMP[:, channel]) for channel in range(3)]
    return np.column_stack(channels).astype(np.uint8)
