# mypy: allow-untyped-decorators
"""Repair decisions for single pixels of a depth image, from what the lidar sees."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from fusion.curves import HEIGHT_STEP_M, SLACK_M, Float32Array, FloatArray, IntArray
from fusion.kernel import kernel
from fusion.repair_odds import over_noise

Islands: TypeAlias = tuple[Float32Array, IntArray, IntArray]


@kernel
def look_at(
    depth: Float32Array,
    pixel: IntArray,
    range_of_depth: Float32Array,
    slopes: Float32Array,
    predicted: Float32Array,
    height_m: float,
    range_max_m: float,
) -> tuple[IntArray, Float32Array, Float32Array]:
    """Find, for every column of a panorama, the pixel that looks at a predicted point of a given height.

    Returns
    -------
    (W,) flat pixel index, -1 if the point is outside the image; (W,) the range measured there, ``nan`` in
    a hole; (W,) divisor from range to depth.
    """
    columns = predicted.size
    at = np.full(columns, -1, np.int32)
    measured = np.full(columns, np.nan, np.float32)
    scale = np.full(columns, np.nan, np.float32)
    fall = slopes[0] - slopes[1]
    for col in range(columns):
        if np.isnan(predicted[col]):
            continue
        row = math.floor((slopes[0] - height_m / predicted[col]) / fall + 0.5)
        if 0 <= row < slopes.size and pixel[row, col] >= 0:
            at[col], scale[col] = pixel[row, col], range_of_depth[row, col]
            value = depth[at[col]]
            if 0.0 < value <= range_max_m:
                measured[col] = value * scale[col]
    return at, measured, scale


@kernel
def island_size(at: int, islands: Islands, slack_share: float) -> int:
    """Count the pixels connected to one, by steps to the four neighbours.

    Parameters
    ----------
    at
        Flat index of a pixel with a reading.
    islands
        (H, W) the input image; (H * W,) sizes already known, else 0: filled in as they are found;
        (most + 1,) a work buffer. An island of more than ``most`` pixels counts ``most + 1``.
    slack_share
        Step between neighbours of one surface, as a share of the range.
    """
    depth, sizes, queue = islands
    if sizes[at] > 0:
        return int(sizes[at])
    height, width = depth.shape
    flat = depth.ravel()
    count, done, size = 1, 0, 0
    queue[0], sizes[at] = at, -1
    while done < count and size == 0:
        here = queue[done]
        done += 1
        row, col = here // width, here % width
        for step in range(4):
            r, c = row + (step == 0) - (step == 1), col + (step == 2) - (step == 3)
            if not (0 <= r < height and 0 <= c < width):
                continue
            there = r * width + c
            if sizes[there] == -1 or not _same_surface(flat[here], flat[there], slack_share):
                continue
            if sizes[there] > 0 or count == queue.size:
                size = queue.size
                break
            queue[count], sizes[there] = there, -1
            count += 1
    for k in range(count):
        sizes[queue[k]] = size if size > 0 else count
    return size if size > 0 else count


@kernel
def _same_surface(near: float, far: float, slack_share: float) -> bool:
    """Return whether two neighbours may be on one surface; false for a hole."""
    return near > 0.0 and far > 0.0 and abs(near - far) <= 0.5 * HEIGHT_STEP_M + slack_share * min(near, far)


@kernel
def pixel_candidates(
    image: Float32Array,
    lookup: tuple[IntArray, Float32Array, Float32Array],
    shifted: Float32Array,
    lost: Float32Array,
    heights_m: FloatArray,
    range_max_m: float,
    eps_share: float,
    noise_share: float,
    most_pixels: tuple[int, int],
    crowd: int,
) -> FloatArray:
    """Find candidate depths for pixels that look at the lidar's surfaces, by height: Xu2024 Eq. (8).

    A run of columns that disagree with the lidar is filled between two that agree. A reading that disagrees
    is an error of the camera only if the image itself does not support it (our rule): it is connected to at
    most a few pixels, also above and below. A patch behind the lidar's surface is multipath light, a tiny one
    is a flying point at an edge. A larger surface is seen only by the camera, and is kept: a table top, the
    wall above a box.

    Parameters
    ----------
    image
        (H, W) the input image.
    lookup
        Pixels, factors and slopes of the panorama.
    shifted
        (3, C) the lidar's ranges, reprojected to the panorama's columns; shifted by half a beam to each side.
    lost
        (C,) logarithm of the number of lidar holes around the beam that looks there.
    heights_m
        (K,) heights to check.
    noise_share
        Noise of the lidar, as a share of the range.
    most_pixels
        Largest size of an outlier behind the lidar's surface, and of one in front of it.
    crowd
        Columns on either side in which holes are counted; a run with farther ends gives no candidate.

    Returns
    -------
    (N, 14) flat pixel; row of `fusion.repair_odds.PIXEL_ODDS`, -1 for an outlier without candidate; the
    depth; and its features: the logarithm of the width of the run; the difference of its ends to the lidar;
    holes in the row, and in the lidar; how far the reading is behind; the distance between the lidar's
    neighbours; the logarithms of the range, of the range over the largest in the image, and of its noise; the
    differences of the nearest readings above and below, the smaller first: a wall continues, the top of a
    table does not. A missing one counts as the other.
    """
    depth = image.ravel()
    islands = (image, np.zeros(depth.size, np.int32), np.empty(max(most_pixels) + 1, np.int32))
    predicted, columns = shifted[0], shifted.shape[1]
    residual, nans, farthest = np.empty(columns), np.zeros(columns + 1, np.int32), np.float32(0.0)
    for value in depth:
        if farthest < value <= range_max_m:
            farthest = value
    rows, curves = (np.empty((256, 14)), 0), (shifted, lost, residual, nans)
    limits = range_max_m, farthest, eps_share, noise_share
    for k in range(heights_m.size):
        seen = look_at(depth, lookup[0], lookup[1], lookup[2], predicted, heights_m[k], range_max_m)
        pixel, measured = seen[0], seen[1]
        for i in range(columns):
            nans[i + 1] = nans[i] + (pixel[i] >= 0 and np.isnan(measured[i]))
            residual[i] = measured[i] - predicted[i] if pixel[i] >= 0 else np.nan
        first = 0
        while first < columns:
            if pixel[first] < 0 or abs(residual[first]) <= eps_share * predicted[first]:
                first += 1
                continue
            last = first
            while last + 1 < columns and not abs(residual[last + 1]) <= eps_share * predicted[last + 1]:
                if pixel[last + 1] < 0 and not np.isnan(predicted[last + 1]):
                    break
                last += 1
            rows = _with_run(rows, (first, last, crowd), seen, curves, islands, most_pixels, limits, lookup)
            first = last + 1
    return rows[0][: rows[1]]


@kernel(inline="always")
def _with_run(
    rows: tuple[FloatArray, int],
    run: tuple[int, int, int],
    seen: tuple[IntArray, Float32Array, Float32Array],
    curves: tuple[Float32Array, Float32Array, FloatArray, IntArray],
    islands: Islands,
    most_pixels: tuple[int, int],
    limits: tuple[float, float, float, float],
    lookup: tuple[IntArray, Float32Array, Float32Array],
) -> tuple[FloatArray, int]:
    """Add one more run of columns to the rows of `pixel_candidates`; return the rows and their number."""
    (table, count), (first, last, crowd), (pixel, measured, scale) = rows, run, seen
    (shifted, lost, residual, nans), (range_max_m, farthest, eps_share, noise_share) = curves, limits
    predicted, columns = shifted[0], shifted.shape[1]
    left = first > 0 and abs(residual[first - 1]) <= eps_share * predicted[first - 1]
    right = last + 1 < columns and abs(residual[last + 1]) <= eps_share * predicted[last + 1]
    for i in range(first, last + 1):
        hole, between = np.isnan(measured[i]), left and right and max(i - first, last - i) < crowd
        most = most_pixels[0] if residual[i] > 0.0 else most_pixels[1]
        bad = between if hole else (left or right) and island_size(pixel[i], islands, 0.5 * eps_share) <= most
        if pixel[i] < 0 or not bad:
            continue
        if count == table.shape[0]:
            table = np.concatenate((table, np.empty_like(table)))
        row = table[count]
        count += 1
        row[0], row[1] = pixel[i], -1.0
        if not between:
            continue
        before, after, width = residual[first - 1], residual[last + 1], last - first + 1
        put = predicted[i] + before + (after - before) * (i - first + 1) / (width + 1)
        if put > range_max_m * scale[i]:
            continue
        low, high = max(0, i - crowd), min(columns, i + crowd + 1)
        around = nans[high] - nans[low] - nans[min(high, last + 1)] + nans[max(low, first)]
        jump = 0.0 if hole else over_noise(measured[i] - put, put, eps_share)
        error = max(abs(shifted[1, i] - predicted[i]), abs(shifted[2, i] - predicted[i]))
        row[1], row[2], row[3] = 0.0 if hole else 1.0, put / scale[i], math.log(width)
        row[4], row[5] = over_noise(max(abs(before), abs(after)), put, eps_share), math.log(1.0 + around)
        row[6], row[7] = lost[i], jump if hole or measured[i] > put else -jump
        row[8] = over_noise(put if np.isnan(error) else error, put, eps_share)
        row[9], row[10] = math.log(put), math.log(row[2] / farthest)
        row[11] = math.log(SLACK_M + noise_share * put)
        row[12], row[13] = _around(i, pixel[i], put, islands[0].ravel(), lookup, range_max_m, eps_share)
    return table, count


@kernel
def _around(
    col: int,
    at: int,
    put_m: float,
    depth: Float32Array,
    lookup: tuple[IntArray, Float32Array, Float32Array],
    range_max_m: float,
    eps_share: float,
) -> tuple[float, float]:
    """Return the differences of the readings above and below to a range, over the noise: smaller, larger."""
    pixels, range_of_depth, _ = lookup
    least, most, middle = np.inf, 0.0, 0
    while pixels[middle, col] != at:
        middle += 1
    for step in (-1, 1):
        row = middle + step
        while 0 <= row < pixels.shape[0]:
            near = pixels[row, col]
            if near >= 0 and near != at and 0.0 < depth[near] <= range_max_m:
                sigmas = over_noise(depth[near] * range_of_depth[row, col] - put_m, put_m, eps_share)
                least, most = min(least, sigmas), max(most, sigmas)
                break
            row += step
    return (most if math.isinf(least) else least), most
