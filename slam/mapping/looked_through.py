"""The compiled kernels of what clouds look through: voxels that a cloud hits, and those that it passes."""

from __future__ import annotations

import math

from fusion.kernel import ZERO, kernel
from fusion.voxel_hash import AXIS_BITS, entry_of, key_of


@kernel(inline="always")
def _pixel(x, y, z, pixel_rad):  # type: ignore[no-untyped-def]
    """Row and column of a direction, and the range."""
    level = math.hypot(x, y)
    row = math.floor((math.atan2(z, level) + math.pi / 2) / pixel_rad + 0.5)
    col = math.floor((math.atan2(y, x) + math.pi) / pixel_rad + 0.5)
    return row, col, math.hypot(level, z)


@kernel
def look(points, T_map_base, T_lidar_base, size_m, table, keys, number, newest, pixel_rad, picture):  # type: ignore[no-untyped-def]
    """Draw how far a cloud (N, 3) sees, and note its number for the voxels that hold its points.

    Parameters
    ----------
    T_map_base, T_lidar_base
        (4, 4).
    table, keys
        Slots of the voxels, and their keys (V,).
    newest
        (V,) the newest cloud that has a point in each voxel.
    picture
        (rows, cols) of ranges, infinite before.
    """
    for i in range(points.shape[0]):
        a = points[i, 0]
        b = points[i, 1]
        c = points[i, 2]
        x = T_map_base[0, 0] * a + T_map_base[0, 1] * b + T_map_base[0, 2] * c + T_map_base[0, 3]
        y = T_map_base[1, 0] * a + T_map_base[1, 1] * b + T_map_base[1, 2] * c + T_map_base[1, 3]
        z = T_map_base[2, 0] * a + T_map_base[2, 1] * b + T_map_base[2, 2] * c + T_map_base[2, 3]
        k = entry_of(key_of(x, y, z, size_m), table, keys)
        if k >= 0:
            newest[k] = number
        x = T_lidar_base[0, 0] * a + T_lidar_base[0, 1] * b + T_lidar_base[0, 2] * c + T_lidar_base[0, 3]
        y = T_lidar_base[1, 0] * a + T_lidar_base[1, 1] * b + T_lidar_base[1, 2] * c + T_lidar_base[1, 3]
        z = T_lidar_base[2, 0] * a + T_lidar_base[2, 1] * b + T_lidar_base[2, 2] * c + T_lidar_base[2, 3]
        row, col, range_m = _pixel(x, y, z, pixel_rad)
        picture[row, col] = min(picture[row, col], range_m)


@kernel
def count_looks(middles, first, T_lidar_map, reach_m, half_m, number, newest, pixel_rad, picture, counts):  # type: ignore[no-untyped-def]
    """Count for the voxels near a lidar what its picture says of each.

    Parameters
    ----------
    middles, first
        (M, 3) of those that may be near, and the number of the first of them.
    T_lidar_map
        (4, 4).
    half_m
        A point so near to a middle hits the voxel.
    number, newest, picture
        As of `look`.
    counts
        (V, 4) hits, passes between hits, passes since the newest hit, passes before the first.
    """
    rows = picture.shape[0]
    cols = picture.shape[1]
    for n in range(middles.shape[0]):
        a = middles[n, 0]
        b = middles[n, 1]
        c = middles[n, 2]
        x = T_lidar_map[0, 0] * a + T_lidar_map[0, 1] * b + T_lidar_map[0, 2] * c + T_lidar_map[0, 3]
        y = T_lidar_map[1, 0] * a + T_lidar_map[1, 1] * b + T_lidar_map[1, 2] * c + T_lidar_map[1, 3]
        z = T_lidar_map[2, 0] * a + T_lidar_map[2, 1] * b + T_lidar_map[2, 2] * c + T_lidar_map[2, 3]
        if x * x + y * y + z * z >= reach_m * reach_m:
            continue
        row, col, away_m = _pixel(x, y, z, pixel_rad)
        k = first + n
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
