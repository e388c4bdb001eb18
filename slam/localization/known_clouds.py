"""Clouds of a known map, in the forms that localisation needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import gtsam
import numpy as np

from fusion.height_band import thin_to_voxels
from slam.config import Config
from slam.errors import MapFileError
from slam.localization.cloud_space import CloudSpace, cloud_space
from slam.localization.plane_sides import SidedPlanes
from slam.matching.cloud_points import voxel_of
from slam.matching.local_cloud import LocalCloud, moved
from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import FloatArray, spatial
from slam.storage.map_contents import MapContents

# Side of a tile, in voxels: what its one map serves. The nearest keyframes make it.
TILE, _TILE_KEYFRAMES = 16.0, 24
# A place is first aligned with voxels so many times as large.
COARSENESS = 3.0
# How far a place is described by what is seen from it, as a part of how far there is a map to match to.
SIGHT = 2.0


class _Keyframe(NamedTuple):
    """The points of a keyframe in its base frame, and in the map: as dense as planes and free space need."""

    points: FloatArray
    placed: FloatArray


@dataclass(frozen=True, slots=True)
class CloudTile:
    """The map around a place.

    Attributes
    ----------
    local
        What is matched to.
    coarse
        The same with larger voxels, to arrive from afar.
    planes
        Those of ``local``, with the sides from which they were seen.
    space
        What was free, and what was wall.
    agreement
        Share of the map's own clouds that lies on its planes.
    """

    local: LocalCloud
    coarse: LocalCloud
    planes: SidedPlanes
    space: CloudSpace
    agreement: float


class CloudTiles:
    """Local maps of the keyframes nearest to a tile's middle: the map as it was seen from there.

    Raises
    ------
    MapFileError
        If no keyframe has points enough.
    """

    def __init__(self, known: MapContents, config: Config) -> None:
        assert known.clouds is not None
        self._clouds, self._poses = known.clouds, [spatial(pose) for pose in known.node_poses]
        self._T_base_lidar = known.T_base_lidar
        self._reach_voxels = config.cloud_localization.reach_voxels
        first = next((points for points in known.clouds if len(points)), None)
        if first is None:
            raise MapFileError("the map's clouds contain no point: nothing can be localised in it")
        self.voxel_m = voxel_of(first, config.cloud_odometry)
        self._thickness_m = 0.5 * config.cloud_odometry.thickness_m
        # The two faces of a thin wall are no plane together.
        thin = config.cloud_odometry.model_copy(update={"thickness_m": self._thickness_m})
        self._config = config.model_copy(update={"cloud_odometry": thin})
        self._positions = np.array([pose.translation() for pose in self._poses])
        self._frame = lru_cache(self._read)
        self._tile = lru_cache(maxsize=48)(self._made)

    @property
    def made(self) -> int:
        """Return the number of tiles made so far."""
        return self._tile.cache_info().misses

    def around(self, pose: gtsam.Pose3) -> CloudTile | None:
        """The tile that ``T_map_base`` stands in; None far from every keyframe."""
        return self._tile(*np.floor(pose.translation() / (TILE * self.voxel_m)).astype(np.int64).tolist())

    def _read(self, key: int) -> _Keyframe:
        """A keyframe."""
        points = thin_to_voxels(self._clouds.points(key), 0.5 * self.voxel_m)
        return _Keyframe(points, moved(points, self._poses[key]))

    def _made(self, x: int, y: int, z: int) -> CloudTile | None:
        """The tile of those numbers, of the keyframes nearest to its middle."""
        voxel_m, reach_m = self.voxel_m, self._reach_voxels * self.voxel_m
        middle = (np.array([x, y, z]) + 0.5) * TILE * voxel_m
        distances = np.linalg.norm(self._positions - middle, axis=1)
        nearest = np.argsort(distances, kind="stable")[:_TILE_KEYFRAMES]
        members = nearest[distances[nearest] <= reach_m].tolist()
        if not members:
            return None
        poses = [self._poses[k] for k in members]
        frames = [self._frame(k) for k in members]
        merged = PlaneVoxels(voxel_m, self._thickness_m)
        for frame in frames:
            merged.add(frame.placed)
        local = LocalCloud(merged, voxel_m, self._config)
        own = [
            local.agreement(thin_to_voxels(frame.points, voxel_m), pose)
            for frame, pose in zip(frames, poses, strict=True)
        ]
        clouds = [frame.placed for frame in frames]
        wide_m = COARSENESS * voxel_m
        wide = PlaneVoxels.build(thin_to_voxels(np.vstack(clouds), 0.5 * wide_m), wide_m, self._thickness_m)
        coarse = LocalCloud(wide, wide_m, self._config)
        lidars = np.array([pose.compose(self._T_base_lidar).translation() for pose in poses])
        planes = SidedPlanes(merged, lidars, clouds)
        space = cloud_space(lidars, clouds, planes, voxel_m, SIGHT * reach_m)
        return CloudTile(local, coarse, planes, space, float(np.median(own)))
