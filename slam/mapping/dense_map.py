"""Coloured mesh and point cloud from RGB-D images at known poses, by a signed distance field."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.curves import NEAREST_M
from slam.errors import ScanweaveError
from slam.mapping.surface_nets import surface_of_blocks
from slam.mapping.voxel_blocks import VoxelBlocks
from slam.measurements import Float32Array, RgbdFrame
from slam.vision.prefetch import prefetched

Colors: TypeAlias = NDArray[np.uint8]
Faces: TypeAlias = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class DenseMapSettings:
    """How frames become a dense map.

    Attributes
    ----------
    voxel_size_m
        Side of a voxel; details below two of them are lost.
    depth_min_m, depth_max_m
        Readings outside are not used.
    minimum_views
        Least number of frames (or all, if there are fewer) that must see a surface; more removes fragments,
        and surfaces that were seen only briefly.
    memory_limit_mb
        Memory the voxels may take, in 10^6 bytes.
    """

    voxel_size_m: float
    depth_max_m: float
    depth_min_m: float = NEAREST_M
    minimum_views: int = 3
    memory_limit_mb: float = 2000.0


@dataclass(frozen=True, slots=True)
class ColoredCloud:
    """Points on surfaces.

    Attributes
    ----------
    points_map
        (N, 3) metres, in the map frame.
    colors
        (N, 3) RGB.
    normals_map
        (N, 3) unit vectors towards where the surface was seen from.
    intensities
        (N,) of a lidar's points, in the lidar's steps, NaN if unknown; None if none is known.
    """

    points_map: Float32Array
    colors: Colors
    normals_map: Float32Array
    intensities: Float32Array | None = None


@dataclass(frozen=True, slots=True)
class ColoredMesh:
    """A triangle mesh.

    Attributes
    ----------
    vertices_map
        (N, 3) metres, in the map frame.
    colors
        (N, 3) RGB of the vertices.
    normals_map
        (N, 3) unit vectors of the vertices, towards where the surface was seen from.
    faces
        (M, 3) indices of vertices, counter-clockwise seen from the side of the normals.
    """

    vertices_map: Float32Array
    colors: Colors
    normals_map: Float32Array
    faces: Faces

    @property
    def cloud(self) -> ColoredCloud:
        """The vertices as a cloud."""
        return ColoredCloud(self.vertices_map, self.colors, self.normals_map)


def fuse_keyframes(
    frames: Iterable[RgbdFrame], poses: Sequence[gtsam.Pose3], settings: DenseMapSettings
) -> ColoredMesh:
    """Fuse frames into one surface; ``poses`` are T_map_camera in the order of the frames.

    Frames are taken one at a time: memory grows with the surface, not with their number. A frame with
    hardly any depth within the range is skipped. If no surface was seen often enough, the arrays are
    empty.

    Raises
    ------
    ScanweaveError
        If a pose is not finite, or the memory limit is reached.
    """
    blocks = VoxelBlocks(settings.voxel_size_m)
    # A frame is integrated in another thread while the next one is decoded.
    integrated = prefetched(
        posed_frames(frames, poses), lambda posed: _integrate(blocks, settings, *posed), most_waiting=1
    )
    return ColoredMesh(*surface_of_blocks(blocks, min(settings.minimum_views, sum(integrated))))


def _integrate(
    blocks: VoxelBlocks, settings: DenseMapSettings, frame: RgbdFrame, T_map_camera: gtsam.Pose3
) -> bool:
    """Add one frame; False if it has no depth within the range."""
    k, seen_m = frame.intrinsics, frame.depth_m
    usable = (seen_m >= settings.depth_min_m) & (seen_m <= settings.depth_max_m)
    depth_m, camera = np.where(usable, seen_m, np.float32(0.0)), (k.fx, k.fy, k.cx, k.cy)
    keys = blocks.touched(depth_m, camera, T_map_camera.matrix())
    new = keys[blocks.find(keys) < 0]
    if (len(blocks) + len(new)) * VoxelBlocks.bytes_each() > 1e6 * settings.memory_limit_mb:
        raise ScanweaveError(
            f"the dense map needs more than {settings.memory_limit_mb:g} MB at voxels of "
            f"{settings.voxel_size_m:g} m; use a larger voxel_size_m, a smaller depth_max_m or a "
            "larger memory_limit_mb"
        )
    blocks.add(new)
    blocks.integrate(blocks.find(keys), depth_m, frame.color, camera, T_map_camera.inverse().matrix())
    return len(keys) > 0


def posed_frames(
    frames: Iterable[RgbdFrame], poses: Sequence[gtsam.Pose3]
) -> Iterator[tuple[RgbdFrame, gtsam.Pose3]]:
    """Yield (frame, T_map_camera) pairs; ``poses`` are T_map_camera in the order of the frames.

    Raises
    ------
    ScanweaveError
        Before the first pair, if a pose is not finite.
    """
    refuse_lost(poses)
    yield from zip(frames, poses, strict=True)


def refuse_lost(poses: Sequence[gtsam.Pose3]) -> None:
    """Raise a `ScanweaveError` if a keyframe pose is not finite."""
    for index, pose in enumerate(poses):
        if not np.isfinite(pose.matrix()).all():
            raise ScanweaveError(f"pose {index} of {len(poses)} keyframes is not finite; see the report")
