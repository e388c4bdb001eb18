"""Remove moving objects from the clouds of a 3D lidar: places that beams have passed through.

The idea of `slam.mapping.passers_by` in 3D: a fixed object is hit whenever the lidar looks at it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from fusion.voxel_hash import AXIS, AXIS_BITS, HALF, entries_at, first_in_voxels, index_keys, table_for
from slam.mapping.elevation import Elevation
from slam.mapping.looked_through import count_looks, look, means_around, spread
from slam.matching.local_cloud import moved
from slam.measurements import BoolArray, Float32Array, FloatArray
from slam.vision.prefetch import prefetched

IntArray = NDArray[np.int64]

_PIXEL_RAD = math.radians(0.5)  # of the range image of a cloud


@dataclass(frozen=True, slots=True)
class PassedBy:
    """Voxels of the map that beams have passed.

    Attributes
    ----------
    keys
        (V,) sorted.
    voxel_m
        Their side.
    """

    keys: IntArray
    voxel_m: float

    def holds(self, points_map: FloatArray) -> BoolArray:
        """Return (N,) whether points (N, 3) were removed."""
        entries = np.empty(len(points_map), np.int64)
        points = np.ascontiguousarray(points_map, np.float64)
        entries_at(points, self.voxel_m, _indexed(self.keys), self.keys, entries)
        return np.asarray(entries >= 0)


def passed_by(
    surface: Iterable[FloatArray],
    clouds: Iterable[FloatArray],
    poses: Sequence[gtsam.Pose3],
    T_base_lidar: gtsam.Pose3,
    ground: Elevation,
    reach_m: float,
) -> PassedBy:
    """Find passed voxels; only objects above the ground are tested.

    A keyframe hits a voxel that contains one of its points, or in which the beam through its middle ends. It
    passes a voxel if all beams through it, and those above and below, end behind it by more than the width of
    a pixel: along a wall and past a pole some end before it. A voxel is removed if, on average with its
    neighbours, it was passed before its first hit and after its last one more often than it was hit, and more
    often than its share of hits between them allows once in `FEWEST` times (Laplace's rule of succession).
    Connected voxels that were passed more than half as often as they were hit are removed, too.

    Parameters
    ----------
    surface
        Points (N, 3) of all clouds in the map, in parts.
    clouds
        (N, 3) points of each keyframe in the map; read once.
    poses
        ``T_map_base`` of each.
    reach_m
        Voxels farther from a lidar, or where a pixel is two voxels wide, are not tested.
    """
    voxel_m = 0.5 * ground.cell_m
    reach_m = min(reach_m, 2 * voxel_m / _PIXEL_RAD)
    keys = np.sort(np.concatenate([np.zeros(0, np.int64), *(_keys(part, voxel_m) for part in surface)]))
    known = keys[np.diff(keys, prepend=-1) > 0]  # what `numpy.unique` gives, in a twelfth of its time
    known = known[ground.above_m(_middles(known, voxel_m)) > voxel_m]
    if not len(known):
        return PassedBy(known, voxel_m)
    middles, table, counts = _middles(known, voxel_m), _indexed(known), np.zeros((len(known), 4), np.int32)
    newest, half_turn = np.full(len(known), -1, np.int32), round(math.pi / _PIXEL_RAD)
    along = middles[:, 0].copy()
    picture, half_m = np.empty((half_turn + 1, 2 * half_turn), np.float32), 0.5 * math.sqrt(3) * voxel_m
    lidars = [pose.compose(T_base_lidar) for pose in poses]
    views = prefetched(
        zip(clouds, lidars, strict=True), lambda view: (*view, _pixels(moved(view[0], view[1].inverse()))), 1
    )
    for number, (placed, T_map_lidar, pixels) in enumerate(views):
        picture[:] = np.inf
        look(placed, voxel_m, table, known, number, newest, *pixels, picture)
        # Their keys are sorted along x first.
        ends = T_map_lidar.translation() + np.array([[-reach_m], [reach_m]])
        first, last = np.searchsorted(along, ends[:, 0])
        around = moved(middles[first:last], T_map_lidar.inverse())
        in_reach = np.flatnonzero(np.einsum("ij,ij->i", around, around) < reach_m**2)
        pixels = _pixels(around[in_reach])
        count_looks(in_reach + first, half_m, _PIXEL_RAD, number, newest, *pixels, picture, counts)
    hits, between, since, before = counts.T
    passes = since + before
    chances = np.log1p(-(hits + 1.0) / (hits + between + 2.0)) * passes
    means = np.empty((len(known), 2))
    means_around(known, table, np.column_stack([chances, passes - hits]), means)
    is_gone = (means[:, 0] < -math.log(FEWEST)) & (means[:, 1] > 0.0)
    spread(known, table, 2 * passes > hits, is_gone)
    return PassedBy(known[is_gone], voxel_m)


def _pixels(points_lidar: FloatArray) -> tuple[NDArray[np.int32], NDArray[np.int32], Float32Array]:
    """Return rows, columns and ranges (N,) of points (N, 3) in the range image of a cloud (float32)."""
    x, y, z = np.ascontiguousarray(points_lidar.T, np.float32)
    level_m = np.sqrt(x * x + y * y)
    row = (np.arctan2(z, level_m) + 0.5 * math.pi) / _PIXEL_RAD + 0.5
    col = ((np.arctan2(y, x) + math.pi) / _PIXEL_RAD).astype(np.int32)
    col[col >= round(2 * math.pi / _PIXEL_RAD)] = 0
    return row.astype(np.int32), col, np.sqrt(level_m * level_m + z * z)


def _keys(points: FloatArray, voxel_m: float) -> IntArray:
    """Return (V,) unique keys of the voxels that contain points (N, 3)."""
    keys, first = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    return keys[: first_in_voxels(points, voxel_m, 1, table_for(len(points)), keys, first)]


def _indexed(keys: IntArray) -> NDArray[np.int32]:
    """Build a hash table of keys (V,)."""
    table = table_for(len(keys))
    index_keys(keys, table)
    return table


def _middles(keys: IntArray, voxel_m: float) -> FloatArray:
    """Return (V, 3) centres of voxels."""
    cells = (np.column_stack([keys >> 2 * AXIS_BITS, keys >> AXIS_BITS, keys]) & AXIS) - HALF
    return np.asarray((cells + 0.5) * voxel_m)
