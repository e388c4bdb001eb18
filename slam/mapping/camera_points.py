"""The coloured points of camera keyframes as they were seen, for machines where no surface can be fused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from fusion.curves import Intrinsics
from fusion.height_band import back_project, pixel_rays, to_frame
from slam.mapping.cloud_map import BATCH, plane_normals
from slam.mapping.dense_map import ColoredCloud, DenseMapSettings
from slam.mapping.posed_frames import posed_frames
from slam.matching.plane_voxels import VoxelMoments, added, summed, voxel_keys
from slam.measurements import FloatArray, RgbdFrame


def camera_cloud(
    frames: Iterable[RgbdFrame], poses: Sequence[gtsam.Pose3], settings: DenseMapSettings
) -> ColoredCloud:
    """One point a voxel, the mean of what frames saw in it; ``poses`` are T_map_camera in their order.

    Raises
    ------
    ScanweaveError
        Where a pose is not finite, or the memory limit is met.
    """
    # Of a voxel: views, place, colour, and the way to the camera.
    seen = [VoxelMoments(np.empty(0, np.int64), np.empty((0, 10)))]
    for frame, T_map_camera in posed_frames(frames, poses):
        seen.append(_seen(frame, T_map_camera.matrix(), settings))
        if len(seen) > BATCH:
            seen = [added(seen)]
            if seen[0].sums.nbytes > 1e6 * settings.memory_limit_mb:
                raise settings.too_large()
    sums = added(seen).sums
    sums = sums[sums[:, 0] >= settings.minimum_views]
    points, colors, to_camera = np.split(sums[:, 1:] / sums[:, :1], 3, axis=1)
    normals = plane_normals(points, settings.voxel_size_m)
    away = np.einsum("ij,ij->i", normals, to_camera) < 0.0
    return ColoredCloud(
        points.astype(np.float32),
        np.rint(colors).astype(np.uint8),
        np.where(away[:, None], -normals, normals).astype(np.float32),
    )


def _seen(frame: RgbdFrame, T_map_camera: FloatArray, settings: DenseMapSettings) -> VoxelMoments:
    """What a frame saw in each voxel, once a voxel however many pixels show it."""
    camera = frame.intrinsics
    # At the farthest depth pixels lie no farther apart than voxels.
    step = max(1, int(settings.voxel_size_m * camera.fx / settings.depth_max_m))
    depth_m, color = frame.depth_m[::step, ::step], frame.color[::step, ::step]
    rays = pixel_rays(frame.depth_m.shape, Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy))
    usable = (depth_m > 0.0) & (depth_m >= settings.depth_min_m) & (depth_m <= settings.depth_max_m)
    points = to_frame(back_project(np.where(usable, depth_m, 0.0), rays[::step, ::step]), T_map_camera)
    rows = np.column_stack([np.ones(len(points)), points, color[usable], T_map_camera[:3, 3] - points])
    keys = voxel_keys(points, settings.voxel_size_m)
    order = np.argsort(keys, kind="stable")
    voxels = summed(keys[order], rows[order])
    return VoxelMoments(voxels.keys, voxels.sums / voxels.sums[:, :1])
