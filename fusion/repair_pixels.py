# mypy: allow-untyped-decorators
"""The decisions on single pixels of a depth image, by what the lidar sees."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.curves import HEIGHT_STEP_M, Float32Array, FloatArray, IntArray
from fusion.kernel import kernel
from fusion.repair import FILLED, HOLE, ProvenanceArray

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
    """For every column of a panorama the pixel that looks at a predicted point of a given height.

    Returns
    -------
    (W,) flat pixel index, -1 where the point is outside the image; (W,) the range measured there, ``nan`` in
    a hole; (W,) by what a range is divided to be a depth.
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
def repair_columns(
    measured: Float32Array,
    predicted: Float32Array,
    pixel: IntArray,
    islands: Islands,
    eps_share: float,
    most_pixels: tuple[int, int],
    fill_columns: int,
) -> ProvenanceArray:
    """Which columns of a depth curve to fill from the lidar, or to drop: Xu2024 Eq. (6) and (8).

    Only a few columns between two that agree are filled. Wider holes have causes that the lidar does not see:
    a thing nearer than the camera measures, or glass, which both look through; of those half were wrong by
    more than 0.1 m. A reading that disagrees is the camera's fault only where the image itself
    does not support it (ours): beside a column that agrees, it hangs together with no more than a few pixels,
    above and below too. A patch behind the lidar's surface is light by a detour, a tiny one flies at an edge.
    What belongs to more is seen by the camera alone, and is kept: a table's top, the wall over a box.

    Parameters
    ----------
    measured, predicted
        (W,) ranges of the camera, and of the lidar's surfaces, reprojected to the camera.
    pixel
        (W,) flat index of the pixel that looks at a prediction, -1 where none does.
    islands
        As for `island_size`.
    most_pixels
        Of a burr behind the lidar's surface, and of one before it.
    fill_columns
        Widest run that is filled; 0: burrs are dropped only.

    Returns
    -------
    (W,) `FILLED` where the lidar's reading is to be taken, `HOLE` where a burr is to be dropped.
    """
    count = measured.size
    source = np.zeros(count, np.uint8)
    agrees = np.zeros(count, np.bool_)
    for i in range(count):
        if pixel[i] >= 0:
            agrees[i] = abs(measured[i] - predicted[i]) <= eps_share * predicted[i]
    first = 0
    while first < count:
        if agrees[first] or pixel[first] < 0:
            first += 1
            continue
        last = first
        while last + 1 < count and not agrees[last + 1]:
            if pixel[last + 1] < 0 and not np.isnan(predicted[last + 1]):
                break
            last += 1
        left, right = first > 0 and agrees[first - 1], last + 1 < count and agrees[last + 1]
        kind = FILLED if left and right and last - first < fill_columns else HOLE
        for i in range(first, last + 1):
            if pixel[i] < 0 or not (left or right):
                continue
            if np.isnan(measured[i]):
                source[i] = kind
            else:
                most = most_pixels[0] if measured[i] > predicted[i] else most_pixels[1]
                if island_size(pixel[i], islands, 0.5 * eps_share) <= most:
                    source[i] = kind
        first = last + 1
    return source


@kernel
def island_size(at: int, islands: Islands, slack_share: float) -> int:
    """How many pixels hang together with one, by steps to the four neighbours.

    Parameters
    ----------
    at
        Flat index of a pixel with a reading.
    islands
        (H, W) the image as it was given; (H * W,) sizes that are known already, else 0: filled in as they are
        found; (most + 1,) room to work in. What has more than ``most`` pixels counts ``most + 1``.
    slack_share
        Step between neighbours of one surface, as a share of the range.
    """
    depth, sizes, found = islands
    if sizes[at] > 0:
        return int(sizes[at])
    height, width = depth.shape
    flat = depth.ravel()
    count, done, size = 1, 0, 0
    found[0], sizes[at] = at, -1
    while done < count and size == 0:
        here = found[done]
        done += 1
        row, col = here // width, here % width
        for step in range(4):
            r, c = row + (step == 0) - (step == 1), col + (step == 2) - (step == 3)
            if not (0 <= r < height and 0 <= c < width):
                continue
            there = r * width + c
            if sizes[there] == -1 or not _hang(flat[here], flat[there], slack_share):
                continue
            if sizes[there] > 0 or count == found.size:
                size = found.size
                break
            found[count], sizes[there] = there, -1
            count += 1
    for k in range(count):
        sizes[found[k]] = size if size > 0 else count
    return size if size > 0 else count


@kernel
def _hang(near: float, far: float, slack_share: float) -> bool:
    """Whether two neighbours may be of one surface; false for a hole."""
    return near > 0.0 and far > 0.0 and abs(near - far) <= 0.5 * HEIGHT_STEP_M + slack_share * min(near, far)


@kernel
def repair_image(
    image: Float32Array,
    image_source: ProvenanceArray,
    lookup: tuple[IntArray, Float32Array, Float32Array],
    shifted: Float32Array,
    heights_m: FloatArray,
    sharp: NDArray[np.bool_],
    range_max_m: float,
    eps_share: float,
    most_pixels: tuple[int, int],
    fill_columns: int,
) -> None:
    """Repair the pixels that look at the lidar's surfaces, height by height, in place: Xu2024 Eq. (8).

    Parameters
    ----------
    image, image_source
        (H, W) the image and its provenance.
    lookup
        Pixels, factors and slopes of the panorama.
    shifted
        (3, W) the lidar's ranges, reprojected to the panorama's columns; and moved by half a beam to either
        side: at an edge a pixel may look past the surface that the beam next to it met.
    heights_m, sharp
        (K,) heights, and where the moved ranges are looked at too, for readings that fly: a hole is filled
        from the nearest beam alone.
    most_pixels, fill_columns
        As for `repair_columns`; moved ranges tell no more than what flies.
    """
    depth, source = image.ravel(), image_source.ravel()
    islands = (image.copy(), np.zeros(depth.size, np.int32), np.empty(max(most_pixels) + 1, np.int32))
    for k in range(heights_m.size):
        for side in range(3 if sharp[k] else 1):
            predicted = shifted[side]
            pixel, measured, scale = look_at(
                depth, lookup[0], lookup[1], lookup[2], predicted, heights_m[k], range_max_m
            )
            most = most_pixels if side == 0 else (most_pixels[1], most_pixels[1])
            widest = fill_columns if side == 0 else 0
            kinds = repair_columns(measured, predicted, pixel, islands, eps_share, most, widest)
            for col in range(predicted.size):
                if kinds[col] == HOLE:
                    depth[pixel[col]], source[pixel[col]] = 0.0, HOLE
                elif kinds[col] == FILLED:
                    value = predicted[col] / scale[col]
                    if value <= range_max_m:
                        depth[pixel[col]], source[pixel[col]] = value, FILLED
