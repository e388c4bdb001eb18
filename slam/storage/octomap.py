"""OctoMap's binary tree (``.bt``): occupied, free and unknown space, for 3D planners.

Hornung et al., "OctoMap: an efficient probabilistic 3D mapping framework based on octrees", Autonomous Robots
2013; its own library builds the tree, with its own sensor model.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import gtsam
import numpy as np

from fusion.height_band import back_project, pixel_rays
from slam.errors import ConfigError, ScanweaveError, needs
from slam.mapping.dense_map import posed_frames
from slam.measurements import FloatArray, RgbdFrame
from slam.storage.files import write_bytes

RAYS_A_VOXEL = 3  # adjacent rays on a surface at the maximal range
HALF_TREE = 32768  # voxels from the origin to the end of the tree, which has 16 levels


def write_octomap(
    path: Path,
    frames: Iterable[RgbdFrame],
    poses: Sequence[gtsam.Pose3],
    resolution_m: float = 0.05,
    range_max_m: float = 4.0,
) -> None:
    """Write the occupancy seen by frames as a pruned ``.bt`` file; ``poses`` are T_map_camera in order.

    Each reading frees the voxels between camera and surface and fills its own; one beyond ``range_max_m``
    frees the voxels up to there.

    Raises
    ------
    ConfigError
        If the resolution or the range is not above 0.
    ScanweaveError
        If the extra is not installed, a pose is not finite or outside the tree, or nothing was seen.
    MapFileError
        If the file cannot be written.
    """
    views = (
        (_points_camera(frame, resolution_m, range_max_m), T_map_camera)
        for frame, T_map_camera in posed_frames(frames, poses)
    )
    write_octree(path, views, resolution_m, range_max_m)


def write_octree(
    path: Path, views: Iterable[tuple[FloatArray, gtsam.Pose3]], resolution_m: float, range_max_m: float
) -> None:
    """Write the occupancy seen by a sensor: points (N, 3) in its frame, and ``T_map_sensor``; same errors.

    All points must be finite.
    """
    if not (resolution_m > 0.0 and range_max_m > 0.0):
        raise ConfigError(
            f"OctoMap with a resolution of {resolution_m:g} m and a range of {range_max_m:g} m; "
            "both must be above 0"
        )
    with needs("OctoMap files need octomap-python", "octomap"):
        import octomap
    tree = octomap.OcTree(resolution_m)
    reach_m = HALF_TREE * resolution_m - range_max_m
    for points, T_map_sensor in views:
        origin_map = T_map_sensor.translation()
        if np.abs(origin_map).max() > reach_m:
            raise ScanweaveError(
                f"sensor at {np.round(origin_map, 1).tolist()} m; an OctoMap of {resolution_m:g} m voxels "
                f"ends {reach_m:.0f} m from the origin: use a larger resolution"
            )
        points_map = points @ T_map_sensor.rotation().matrix().T + origin_map
        tree.insertPointCloud(points_map, origin_map, maxrange=range_max_m, lazy_eval=True, discretize=True)
    if tree.size() == 0:
        raise ScanweaveError(f"nothing for {path}: no keyframe has depth in range; is the depth scale right?")
    tree.updateInnerOccupancy()
    write_bytes(path, tree.writeBinary())  # it prunes first


def _points_camera(frame: RgbdFrame, resolution_m: float, range_max_m: float) -> FloatArray:
    """Return (N, 3) readings in the camera frame, thinned to `RAYS_A_VOXEL` at the maximal range."""
    camera = frame.intrinsics
    stride = max(1, math.floor(resolution_m * min(camera.fx, camera.fy) / (range_max_m * RAYS_A_VOXEL)))
    rays = pixel_rays(frame.depth_m.shape, camera)
    return back_project(frame.depth_m[::stride, ::stride], rays[::stride, ::stride])
