"""What only passed by in a 3D lidar's clouds: places that beams have gone through, taken out of the map.

The idea of `slam.mapping.passers_by` in space: what is fixed is hit whenever somebody looks.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fusion.estimation import FEWEST
from fusion.height_band import thin_to_voxels
from slam.mapping.elevation import BATCH, Elevation
from slam.matching.local_cloud import moved
from slam.measurements import BoolArray, FloatArray

IntArray = NDArray[np.int64]

_PIXEL_RAD = math.radians(1.0)  # of the picture in which a cloud tells how far it sees


@dataclass(frozen=True, slots=True)
class PassedBy:
    """Voxels of the map that were looked through.

    Attributes
    ----------
    keys
        (V,) sorted.
    voxel_m
        Their side.
    """

    keys: IntArray
    voxel_m: float

    def parts(
        self, clouds: Iterable[FloatArray], poses: Sequence[gtsam.Pose3], *, gone: bool
    ) -> Iterator[FloatArray]:
        """The points of each keyframe's cloud (N, 3), base frame, that have gone, or those that stay."""
        for points, pose in zip(clouds, poses, strict=True):
            if not len(self.keys):
                yield points[: 0 if gone else None]
                continue
            _, there = _found(self.keys, _keys(moved(points, pose), self.voxel_m))
            yield points[there == gone]


def passed_by(
    clouds: Iterable[FloatArray],
    poses: Sequence[gtsam.Pose3],
    T_base_lidar: gtsam.Pose3,
    ground: Elevation,
    reach_m: float,
) -> PassedBy:
    """Find them; asked is only what stands on the ground.

    A keyframe hits a voxel that holds a point of it, or where the beam through its middle ends; it passes one
    where that beam and all beside it end behind, for along a wall they end before and behind. A voxel has
    gone where it was passed before its first hit and after its last one more often than its own share of hits
    between them allows (Laplace's rule of succession) once in `FEWEST` times, in the mean with the voxels
    that it touches.

    Parameters
    ----------
    clouds
        (N, 3) points of each keyframe, base frame; read twice.
    poses
        ``T_map_base`` of each.
    reach_m
        Voxels farther from a lidar are not asked, nor where a pixel is four of them wide.
    """
    voxel_m = 0.5 * ground.cell_m
    reach_m = min(reach_m, 4 * voxel_m / _PIXEL_RAD)
    known, waiting = np.zeros(0, np.int64), list[IntArray]()
    for points, pose in zip(clouds, poses, strict=True):
        waiting.append(_keys(thin_to_voxels(moved(points, pose), voxel_m), voxel_m))
        if len(waiting) == BATCH:
            known, waiting = np.unique(np.concatenate([known, *waiting])), []
    known = np.unique(np.concatenate([known, *waiting]))
    known = known[ground.above_m(_middles(known, voxel_m)) > voxel_m]
    if not len(known):
        return PassedBy(known, voxel_m)
    hits, between, since, before = (np.zeros(len(known), np.int32) for _ in range(4))
    for points, pose in zip(clouds, poses, strict=True):
        T_map_lidar = pose.compose(T_base_lidar)
        near = _near(known, T_map_lidar.translation(), reach_m, voxel_m)
        middles = moved(_middles(known[near], voxel_m), T_map_lidar.inverse())
        met, passed = _looked(moved(points, T_base_lidar.inverse()), middles, voxel_m)
        own = np.zeros(len(known), np.bool_)
        at, there = _found(known, _keys(thin_to_voxels(moved(points, pose), voxel_m), voxel_m))
        own[at[there]] = True
        met, passed = met | own[near], passed & ~own[near]
        hits[near] += met
        between[near] += np.where(met, since[near], 0)
        before[near] += passed & (hits[near] == 0)
        since[near] = np.where(met, 0, since[near] + (passed & (hits[near] > 0)))
    chances = np.log1p(-(hits + 1.0) / (hits + between + 2.0)) * (since + before)
    return PassedBy(known[_mean_around(known, chances) < -math.log(FEWEST)], voxel_m)


def _found(known: IntArray, keys: IntArray) -> tuple[IntArray, BoolArray]:
    """Where keys (N,) are among those known, which are sorted and some, and whether they are, (N,) each."""
    at = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    return at, known[at] == keys


def _near(known: IntArray, place: FloatArray, reach_m: float, voxel_m: float) -> IntArray:
    """(M,) numbers of the voxels around a place; they are sorted along x first."""
    ends = place + reach_m * np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    first, last = np.searchsorted(known, _keys(ends, voxel_m))
    away = _middles(known[first:last], voxel_m)[:, :2] - place[:2]
    return np.asarray(first + np.flatnonzero(np.einsum("ij,ij->i", away, away) < reach_m**2))


def _looked(
    points_lidar: FloatArray, middles_lidar: FloatArray, voxel_m: float
) -> tuple[BoolArray, BoolArray]:
    """Which voxels a cloud's picture hits, and which it passes, (V,) each."""
    rows_cols, range_m = _pixels(points_lidar)
    half_turn = round(math.pi / _PIXEL_RAD)
    picture = np.full((half_turn + 1, 2 * half_turn + 1), np.inf)
    np.minimum.at(picture, rows_cols, range_m)
    rows_cols, away_m = _pixels(middles_lidar)
    ends, half_m = picture[rows_cols], 0.5 * math.sqrt(3) * voxel_m
    nearest = ndimage.minimum_filter(picture, 3, mode="nearest")[rows_cols]
    # Between rings far apart nobody knows what the beams beside would have met.
    known = ndimage.maximum_filter(np.isfinite(picture), (1, 3), mode="nearest")
    known[1:-1] = known[:-2] & known[2:]
    told = np.isfinite(ends) & known[rows_cols]
    return np.abs(ends - away_m) <= half_m, told & (nearest > away_m + half_m)


def _pixels(points: FloatArray) -> tuple[tuple[IntArray, IntArray], FloatArray]:
    """Rows and columns, and ranges, of points (N, 3)."""
    level = np.hypot(points[:, 0], points[:, 1])
    row = np.rint((np.arctan2(points[:, 2], level) + 0.5 * math.pi) / _PIXEL_RAD)
    col = np.rint((np.arctan2(points[:, 1], points[:, 0]) + math.pi) / _PIXEL_RAD)
    return (row.astype(np.int64), col.astype(np.int64)), np.hypot(level, points[:, 2])


def _mean_around(known: IntArray, values: FloatArray) -> FloatArray:
    """(V,) means of the values of voxels and of those that they touch."""
    total, count = values.copy(), np.ones(len(known))
    around = _keys(np.array(list(itertools.product((-1, 0, 1), repeat=3))), 1.0)
    for away in (around - around[len(around) // 2]).tolist():
        beside = known + away
        at, there = _found(known, beside)
        there &= beside != known
        total += np.where(there, values[at], 0.0)
        count += there
    return total / count


def _keys(points: FloatArray, voxel_m: float) -> IntArray:
    """(N,) one number for the voxel of each point (N, 3): 21 bits an axis."""
    x, y, z = (np.floor(points / voxel_m).astype(np.int64) + (1 << 20)).T
    return np.asarray(x << 42 | y << 21 | z)


def _middles(keys: IntArray, voxel_m: float) -> FloatArray:
    """(N, 3) middles of voxels."""
    cells = (np.column_stack([keys >> 42, keys >> 21, keys]) & (1 << 21) - 1) - (1 << 20)
    return np.asarray((cells + 0.5) * voxel_m)
