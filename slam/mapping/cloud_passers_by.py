"""Remove moving objects from the clouds of a 3D lidar: places that beams have passed through.

The idea of `slam.mapping.passers_by` in 3D: a fixed object is hit whenever the lidar looks at it.
Compiled kernels find the voxels that a cloud hits, and the voxels that its beams pass.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from fusion.kernel import NONE, ZERO, kernel
from fusion.voxel_hash import (
    AXIS,
    AXIS_BITS,
    HALF,
    entries_at,
    entry_of,
    first_in_voxels,
    index_keys,
    key_of,
    table_for,
)
from slam.mapping.elevation import Elevation
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


@kernel(nogil=True)
def look(points, size_m, table, keys, number, newest, rows, cols, ranges_m, picture):  # type: ignore[no-untyped-def]
    """Draw the range image of a cloud (N, 3), and store its number in the voxels that contain its points.

    Parameters
    ----------
    points
        In the map.
    table, keys
        Slots of the voxels, and their keys (V,).
    newest
        (V,) the newest cloud that has a point in each voxel.
    rows, cols, ranges_m
        (N,) pixel and range of each point.
    picture
        (rows, cols) of ranges, infinite before.
    """
    before = NONE
    for i in range(points.shape[0]):
        key = key_of(points[i, 0], points[i, 1], points[i, 2], size_m)
        if key != before:  # neighbours in a cloud are neighbours in space
            before = key
            k = entry_of(key, table, keys)
            if k >= 0:
                newest[k] = number
        row = rows[i]
        col = cols[i]
        picture[row, col] = min(picture[row, col], ranges_m[i])


@kernel(nogil=True)
def count_looks(which, half_m, pixel_rad, number, newest, pixels_row, pixels_col, aways_m, picture, counts):  # type: ignore[no-untyped-def]
    """Count hits and passes of the voxels near a lidar by its range image.

    Parameters
    ----------
    which
        (M,) their numbers.
    half_m
        A point so near to a middle hits the voxel.
    pixel_rad
        Side of a pixel; at its poles they are narrower.
    number, newest, picture
        As of `look`.
    pixels_row, pixels_col, aways_m
        (M,) pixel and range of their centres.
    counts
        (V, 4) hits, passes between hits, passes since the newest hit, passes before the first.
    """
    rows = picture.shape[0]
    cols = picture.shape[1]
    for n in range(which.shape[0]):
        k = which[n]
        row = pixels_row[n]
        col = pixels_col[n]
        away_m = aways_m[n]
        if newest[k] == number or abs(picture[row, col] - away_m) <= half_m:
            counts[k, 0] += 1
            counts[k, 1] += counts[k, 2]
            counts[k, 2] = 0
            continue
        if away_m <= half_m:
            continue
        behind_m = away_m * (1.0 + pixel_rad) + half_m
        if picture[row, col] <= behind_m:  # most are hidden, which their own pixel shows
            continue
        span = math.ceil(half_m / (away_m * pixel_rad))
        wide = min(math.ceil(span / max(math.sin(row * pixel_rad), pixel_rad)), cols // 2)
        # Between distant rings, it is unknown what beams between them would have hit.
        margin = max(span, 2)
        behind = True
        above = below = False
        for level in range(max(row - margin, 0), min(row + margin + 1, rows)):
            in_span = abs(level - row) <= span
            side = col - wide if col >= wide else col - wide + cols
            for _ in range(2 * wide + 1):
                range_m = picture[level, side]
                side += 1
                if side == cols:
                    side = ZERO
                if math.isinf(range_m):
                    continue
                if in_span and range_m <= behind_m:
                    behind = False
                    break
                above = above or level < row
                below = below or level > row
                if not in_span:  # one beam shows that the direction was observed
                    break
            if not behind:
                break
        if behind and above and below:
            counts[k, 2 if counts[k, 0] else 3] += 1


@kernel
def means_around(keys, table, values, means):  # type: ignore[no-untyped-def]
    """Return means (V, D) of the values (V, D) of voxels with keys (V,) and their neighbours."""
    for i in range(keys.shape[0]):
        for column in range(values.shape[1]):
            means[i, column] = 0.0
        count = ZERO
        for neighbour in range(27):
            k = entry_of(keys[i] + _key_offset(neighbour), table, keys)
            if k >= 0:
                for column in range(values.shape[1]):
                    means[i, column] += values[k, column]
                count += 1
        for column in range(values.shape[1]):
            means[i, column] /= count


@kernel
def spread(keys, table, may, chosen):  # type: ignore[no-untyped-def]
    """Also choose voxels with keys (V,) that ``may`` be chosen (V,) and touch a chosen one."""
    queue = np.empty(keys.shape[0], np.int64)
    done = end = ZERO
    for k in range(keys.shape[0]):
        if chosen[k]:
            queue[end] = k
            end += 1
    while done < end:
        for neighbour in range(27):
            k = entry_of(keys[queue[done]] + _key_offset(neighbour), table, keys)
            if k >= 0 and may[k] and not chosen[k]:
                chosen[k] = True
                queue[end] = k
                end += 1
        done += 1


@kernel
def _key_offset(cell):  # type: ignore[no-untyped-def]
    """Return the key offset to one of the 27 voxels in and around a voxel."""
    return ((cell // 9 - 1) << 2 * AXIS_BITS) + ((cell // 3 % 3 - 1) << AXIS_BITS) + cell % 3 - 1
