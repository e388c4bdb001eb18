"""The coloured points of camera keyframes as they were seen, for machines where no surface can be fused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.curves import Intrinsics
from fusion.height_band import back_project, pixel_rays, to_frame
from fusion.voxel_hash import AXIS_BITS
from slam.mapping.dense_map import ColoredCloud, DenseMapSettings
from slam.mapping.posed_frames import posed_frames
from slam.matching.plane_voxels import surface_normals
from slam.measurements import FloatArray, RgbdFrame

# What frames saw is added up by so many, so that no more than these and the map are held.
_BATCH = 32


@dataclass(frozen=True, slots=True)
class _VoxelSums:
    """Sums over what was seen in each voxel; those of two frames add up.

    Attributes
    ----------
    keys
        (V,) of the voxels, in order.
    sums
        (V, 10) one row a voxel: views, and sums of place, colour, and way to the camera.
    """

    keys: NDArray[np.int64]
    sums: FloatArray


def camera_cloud(
    frames: Iterable[RgbdFrame], poses: Sequence[gtsam.Pose3], settings: DenseMapSettings
) -> ColoredCloud:
    """One point a voxel, the mean of what frames saw in it; ``poses`` are T_map_camera in their order.

    Raises
    ------
    ScanweaveError
        Where a pose is not finite, or the memory limit is met.
    """
    seen = [_VoxelSums(np.empty(0, np.int64), np.empty((0, 10)))]
    for frame, T_map_camera in posed_frames(frames, poses):
        seen.append(_seen(frame, T_map_camera.matrix(), settings))
        if len(seen) > _BATCH:
            seen = [_added(seen)]
            if seen[0].sums.nbytes > 1e6 * settings.memory_limit_mb:
                raise settings.too_large()
    sums = _added(seen).sums
    sums = sums[sums[:, 0] >= settings.minimum_views]
    points, colors, to_camera = np.split(sums[:, 1:] / sums[:, :1], 3, axis=1)
    normals = surface_normals(points, settings.voxel_size_m)
    away = np.einsum("ij,ij->i", normals, to_camera) < 0.0
    return ColoredCloud(
        points.astype(np.float32),
        np.rint(colors).astype(np.uint8),
        np.where(away[:, None], -normals, normals).astype(np.float32),
    )


def _seen(frame: RgbdFrame, T_map_camera: FloatArray, settings: DenseMapSettings) -> _VoxelSums:
    """What a frame saw in each voxel, once a voxel however many pixels show it."""
    camera = frame.intrinsics
    # At the farthest depth pixels lie no farther apart than voxels.
    step = max(1, int(settings.voxel_size_m * camera.fx / settings.depth_max_m))
    depth_m, color = frame.depth_m[::step, ::step], frame.color[::step, ::step]
    rays = pixel_rays(frame.depth_m.shape, Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy))
    usable = (depth_m > 0.0) & (depth_m >= settings.depth_min_m) & (depth_m <= settings.depth_max_m)
    points = to_frame(back_project(np.where(usable, depth_m, 0.0), rays[::step, ::step]), T_map_camera)
    rows = np.column_stack([np.ones(len(points)), points, color[usable], T_map_camera[:3, 3] - points])
    keys = _voxel_keys(points, settings.voxel_size_m)
    order = np.argsort(keys, kind="stable")
    voxels = _summed(keys[order], rows[order])
    return _VoxelSums(voxels.keys, voxels.sums / voxels.sums[:, :1])


def _added(parts: Sequence[_VoxelSums]) -> _VoxelSums:
    """The sums of several frames together."""
    if len(parts) == 1:
        return parts[0]
    keys, sums = np.concatenate([part.keys for part in parts]), np.vstack([part.sums for part in parts])
    order = np.argsort(keys, kind="stable")
    return _summed(keys[order], sums[order])


def _summed(keys: NDArray[np.int64], rows: FloatArray) -> _VoxelSums:
    """Rows of equal keys, which stand together, added up."""
    if not len(keys):
        return _VoxelSums(keys, rows)
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    return _VoxelSums(keys[starts], np.add.reduceat(rows, starts))


def _voxel_keys(points: FloatArray, size_m: float) -> NDArray[np.int64]:
    """One integer for the voxel of each point."""
    whole = np.floor(points / size_m).astype(np.int64) + (1 << AXIS_BITS - 1)
    return (whole[:, 0] << 2 * AXIS_BITS) | (whole[:, 1] << AXIS_BITS) | whole[:, 2]
