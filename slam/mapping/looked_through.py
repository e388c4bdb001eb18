"""The compiled kernels of what clouds look through: voxels that a cloud hits, and those that it passes."""

from __future__ import annotations

import math

from fusion.kernel import NONE, ZERO, kernel
from fusion.voxel_hash import AXIS_BITS, entry_of, key_of


@kernel(nogil=True)
def look(points, size_m, table, keys, number, newest, rows, cols, ranges_m, picture):  # type: ignore[no-untyped-def]
    """Draw how far a cloud (N, 3) sees, and note its number for the voxels that hold its points.

    Parameters
    ----------
    points
        In the map.
    table, keys
        Slots of the voxels, and their keys (V,).
    newest
        (V,) the newest cloud that has a point in each voxel.
    rows, cols, ranges_m
        (N,) where the lidar sees each point.
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
def count_looks(which, half_m, number, newest, pixels_row, pixels_col, aways_m, picture, counts):  # type: ignore[no-untyped-def]
    """Count for the voxels near a lidar what its picture says of each.

    Parameters
    ----------
    which
        (M,) their numbers.
    half_m
        A point so near to a middle hits the voxel.
    number, newest, picture
        As of `look`.
    pixels_row, pixels_col, aways_m
        (M,) where the lidar would see their middles.
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
        ends_m = picture[row, col]
        if newest[k] == number or abs(ends_m - away_m) <= half_m:
            counts[k, 0] += 1
            counts[k, 1] += counts[k, 2]
            counts[k, 2] = 0
            continue
        behind = ends_m > away_m and not math.isinf(ends_m)
        if not behind:
            continue
        # Between rings far apart nobody knows what the beams beside would have met.
        above = below = False
        for side in range(max(col - 1, 0), min(col + 2, cols)):
            for level in range(max(row - 1, 0), min(row + 2, rows)):
                range_m = picture[level, side]
                behind = behind and range_m > away_m + half_m
                above = above or (level < row and not math.isinf(range_m))
                below = below or (level > row and not math.isinf(range_m))
        if behind and above and below:
            counts[k, 2 if counts[k, 0] else 3] += 1


@kernel
def means_around(keys, table, values, means):  # type: ignore[no-untyped-def]
    """Means (V,) of the values of voxels with these keys (V,) and of those that they touch."""
    for i in range(keys.shape[0]):
        total = 0.0
        count = ZERO
        for near in range(27):
            away = ((near // 9 - 1) << 2 * AXIS_BITS) + ((near // 3 % 3 - 1) << AXIS_BITS) + near % 3 - 1
            k = entry_of(keys[i] + away, table, keys)
            if k >= 0:
                total += values[k]
                count += 1
        means[i] = total / count
