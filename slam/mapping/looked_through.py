"""Compiled kernels of free space in clouds: voxels that a cloud hits, and voxels that its beams pass."""

from __future__ import annotations

import math

import numpy as np

from fusion.kernel import NONE, ZERO, kernel
from fusion.voxel_hash import AXIS_BITS, entry_of, key_of


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
