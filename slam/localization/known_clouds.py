"""The clouds of a known map, in the forms in which they are asked for."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np

from slam.config import Config
from slam.errors import MapFileError
from slam.localization.cloud_space import CloudSpace, cloud_space
from slam.localization.plane_sides import SidedPlanes
from slam.matching.cloud_points import thinned, voxel_of
from slam.matching.local_cloud import LocalCloud, moved
from slam.measurements import FloatArray

# Clouds by which it is found how much of a cloud agrees with its own map.
_OWN = 3


class Clouds(Protocol):
    """Where the clouds of keyframes are kept."""

    def __len__(self) -> int: ...

    def points(self, key: int) -> FloatArray:
        """The points (N, 3) of a keyframe, base frame."""
        ...


@dataclass(frozen=True)
class KnownClouds:
    """The keyframes of a 3D lidar.

    Attributes
    ----------
    clouds
        Their points, base frame, read when they are asked for.
    poses
        ``T_map_base`` of each.
    T_base_lidar
        Where their beams begin.
    """

    clouds: Clouds
    poses: Sequence[gtsam.Pose3]
    T_base_lidar: gtsam.Pose3


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
        Where no keyframe has points enough.
    """

    def __init__(self, known: KnownClouds, config: Config) -> None:
        self.known = known
        self._settings = config.cloud_localization
        first = next(
            (points for key in range(len(known.clouds)) if len(points := known.clouds.points(key))), None
        )
        if first is None:
            raise MapFileError("the map's clouds hold no point: nothing can be localised in it")
        self.voxel_m = voxel_of(first, config.cloud_odometry)
        # The two faces of a thin wall are no plane together.
        self._odometry = config.cloud_odometry.model_copy(update={"thickness_m": self._settings.thickness_m})
        self._positions = np.array([pose.translation() for pose in known.poses])
        self._cache: OrderedDict[tuple[int, ...], CloudTile] = OrderedDict()

    def around(self, pose: gtsam.Pose3) -> CloudTile | None:
        """The tile that ``T_map_base`` stands in; None far from every keyframe."""
        side_m = self._settings.tile_voxels * self.voxel_m
        key = tuple(np.floor(np.asarray(pose.translation()) / side_m).astype(np.int64).tolist())
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        tile = self._made((np.array(key) + 0.5) * side_m)
        if tile is None:
            return None
        self._cache[key] = tile
        if len(self._cache) > self._settings.tiles_cached:
            self._cache.popitem(last=False)
        return tile

    def _made(self, middle: FloatArray) -> CloudTile | None:
        """The tile of the keyframes nearest to a place (3,)."""
        settings, voxel_m = self._settings, self.voxel_m
        distances = np.linalg.norm(self._positions - middle, axis=1)
        nearest = np.argsort(distances, kind="stable")[: settings.tile_keyframes]
        members = nearest[distances[nearest] <= settings.reach_voxels * voxel_m].tolist()
        if not members:
            return None
        poses = [self.known.poses[k] for k in members]
        clouds = [thinned(self.known.clouds.points(k), 0.5 * voxel_m) for k in members]
        points = [moved(cloud, pose) for cloud, pose in zip(clouds, poses, strict=True)]
        every = np.vstack(points)
        local = LocalCloud.of(every, voxel_m, self._odometry)
        own = [
            local.agreement(thinned(cloud, voxel_m), pose)
            for cloud, pose in zip(clouds[:_OWN], poses[:_OWN], strict=True)
        ]
        wide_m = settings.coarseness * voxel_m
        coarse = LocalCloud.of(thinned(every, 0.5 * wide_m), wide_m, self._odometry)
        lidars = np.array([pose.compose(self.known.T_base_lidar).translation() for pose in poses])
        thin = [thinned(cloud, voxel_m) for cloud in points]
        planes = SidedPlanes(local.planes, lidars, thin)
        space = cloud_space(lidars, thin, planes, voxel_m, settings.space_voxels * voxel_m)
        return CloudTile(local, coarse, planes, space, float(np.median(own)))
