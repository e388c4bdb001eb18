"""The clouds of a known map, in the forms in which they are asked for."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, Protocol

import gtsam
import numpy as np

from slam.config import Config
from slam.errors import MapFileError
from slam.localization.cloud_space import CloudSpace, cloud_space
from slam.localization.plane_sides import SidedPlanes
from slam.matching.cloud_points import thinned, voxel_of
from slam.matching.local_cloud import LocalCloud, moved
from slam.matching.plane_voxels import PlaneVoxels, VoxelMoments, voxel_moments
from slam.measurements import FloatArray

# Clouds by which it is found how much of a cloud agrees with its own map.
_OWN = 3
# Keyframes kept in memory beside the tiles.
_FRAMES_KEPT = 128


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


class _Keyframe(NamedTuple):
    """The points of a keyframe in its base frame; and in the map, thinned to voxels, with their moments."""

    points: FloatArray
    placed: FloatArray
    moments: list[VoxelMoments]


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
        self._frame = lru_cache(_FRAMES_KEPT)(self._read)
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

    def _read(self, key: int) -> _Keyframe:
        """A keyframe, as dense as its planes need."""
        points = thinned(self.known.clouds.points(key), 0.5 * self.voxel_m)
        placed = moved(points, self.known.poses[key])
        return _Keyframe(points, thinned(placed, self.voxel_m), voxel_moments(placed, self.voxel_m))

    def _made(self, middle: FloatArray) -> CloudTile | None:
        """The tile of the keyframes nearest to a place (3,)."""
        settings, voxel_m = self._settings, self.voxel_m
        distances = np.linalg.norm(self._positions - middle, axis=1)
        nearest = np.argsort(distances, kind="stable")[: settings.tile_keyframes]
        members = nearest[distances[nearest] <= settings.reach_voxels * voxel_m].tolist()
        if not members:
            return None
        poses = [self.known.poses[k] for k in members]
        frames = [self._frame(k) for k in members]
        merged = PlaneVoxels.merged([frame.moments for frame in frames], voxel_m, settings.thickness_m)
        local = LocalCloud.of_planes(merged, voxel_m, self._odometry)
        own = [
            local.agreement(thinned(frame.points, voxel_m), pose)
            for frame, pose in zip(frames[:_OWN], poses[:_OWN], strict=True)
        ]
        clouds = [frame.placed for frame in frames]
        wide_m = settings.coarseness * voxel_m
        coarse = LocalCloud.of(thinned(np.vstack(clouds), 0.5 * wide_m), wide_m, self._odometry)
        lidars = np.array([pose.compose(self.known.T_base_lidar).translation() for pose in poses])
        planes = SidedPlanes(merged, lidars, clouds)
        space = cloud_space(lidars, clouds, planes, voxel_m, settings.space_voxels * voxel_m)
        return CloudTile(local, coarse, planes, space, float(np.median(own)))
