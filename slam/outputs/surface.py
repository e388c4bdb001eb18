"""The surface that the camera keyframes of a map show."""

from __future__ import annotations

from dataclasses import dataclass

from slam.config import Config
from slam.errors import LibraryError
from slam.mapping.camera_points import camera_cloud
from slam.mapping.dense_map import ColoredCloud, ColoredMesh, DenseMapSettings, fuse_keyframes
from slam.storage.map_contents import MapContents


@dataclass(frozen=True, slots=True)
class Surface:
    """The surface of the camera keyframes.

    Attributes
    ----------
    mesh
        None without Open3D.
    cloud
        Its points, or without Open3D those that were seen.
    missing
        Why there is no mesh.
    """

    mesh: ColoredMesh | None
    cloud: ColoredCloud
    missing: list[str]


def surface_of(found: MapContents, config: Config) -> Surface:
    """See `Surface`; both empty where the images show none."""
    settings = DenseMapSettings(
        voxel_size_m=config.dense_map.voxel_m,
        depth_min_m=config.dense_map.nearest_m,
        depth_max_m=config.layers.depth_max_m,
    )
    frames, poses = found.frames or (), found.frame_poses()
    try:
        dense = fuse_keyframes(frames, poses, settings)
    except LibraryError as error:
        return Surface(None, camera_cloud(frames, poses, settings), [str(error)])
    return Surface(dense.mesh, dense.cloud, [])
