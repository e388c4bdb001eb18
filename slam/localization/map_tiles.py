"""The walls of a known map as local maps to match to, one a tile, the latest kept."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from slam.config.localization import LocalizationConfig
from slam.config.stages import MatchConfig
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.measurements import FloatArray


class MapTiles:
    """Local maps made from the keyframes near a tile's middle: what is seen from there, as it was seen.

    Parameters
    ----------
    poses
        (K, 3) optimised poses of the keyframes.
    scans
        Oriented points of each, base frame.
    """

    def __init__(
        self,
        poses: FloatArray,
        scans: Sequence[OrientedPoints],
        config: LocalizationConfig,
        match: MatchConfig,
    ) -> None:
        self._poses = poses
        self._scans = scans
        self._config = config
        self._match = match
        self._cache: OrderedDict[tuple[int, int], LocalMap] = OrderedDict()

    def around(self, pose: FloatArray) -> LocalMap:
        """The local map of the tile that a pose (3,) stands in; without points far from every keyframe."""
        side = self._config.tile_m
        tile = math.floor(pose[0] / side), math.floor(pose[1] / side)
        if tile in self._cache:
            self._cache.move_to_end(tile)
            return self._cache[tile]
        middle = (np.array(tile) + 0.5) * side
        near = np.hypot(*(self._poses[:, :2] - middle).T) <= self._config.tile_reach_m
        parts = [self._scans[k].moved(self._poses[k]) for k in np.flatnonzero(near).tolist()]
        local_map = LocalMap.build(parts or [OrientedPoints.none()], self._match)
        self._cache[tile] = local_map
        if len(self._cache) > self._config.tiles_cached:
            self._cache.popitem(last=False)
        return local_map
