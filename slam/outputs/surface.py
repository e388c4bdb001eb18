"""The surface that the camera keyframes of a map show."""

from __future__ import annotations

from slam.config import Config
from slam.mapping.dense_map import DenseMap, DenseMapSettings, fuse_keyframes
from slam.storage.map_contents import MapContents


def surface_of(found: MapContents, config: Config) -> DenseMap:
    """Mesh and cloud; both empty where the images show none."""
    settings = DenseMapSettings(
        voxel_size_m=config.dense_map.voxel_m,
        depth_min_m=config.dense_map.nearest_m,
        depth_max_m=config.layers.depth_max_m,
    )
    return fuse_keyframes(found.frames or (), found.frame_poses(), settings)
