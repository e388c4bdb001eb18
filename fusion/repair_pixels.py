# mypy: allow-untyped-decorators
"""The decisions on single pixels of a depth image, by what the lidar sees."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.curves import Float32Array, FloatArray, IntArray
from fusion.repair import FILLED, HOLE, ProvenanceArray


@numba.njit(cache=True)
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


@numba.njit(cache=True)
def repair_columns(
    measured: Float32Array,
    predicted: Float32Array,
    raw: Float32Array,
    inside: NDArray[np.bool_],
    eps_share: float,
    samples: tuple[int, int, int],
    fill_holes: bool,
) -> ProvenanceArray:
    """Which columns of a depth curve to fill from the lidar: Xu2024 Eq. (6) and (8).

    A hole is filled unless what the camera sees on both sides of it is nearer than the lidar's surface: then
    something stands before it. A run of readings that disagree is the camera's fault only between columns
    that agree, and is a burr where it lies behind the lidar's surface and is short, or is of single readings
    that fly before it. All else is seen by the camera alone, and is kept; so is what any of the lidar's own
    readings nearby is near to.

    Parameters
    ----------
    measured, predicted
        (W,) ranges of the camera, and of the lidar's surfaces, carried to the camera.
    raw
        (W,) the lidar's single readings, carried as they are.
    inside
        (W,) where a prediction falls into the image.
    samples
        Columns of the longest burr and of the longest flight, and how far aside a reading supports another.
    fill_holes
        False: burrs only.
    """
    count = measured.size
    source = np.zeros(count, np.uint8)
    agrees, hidden = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for i in range(count):
        if np.isnan(measured[i]):
            source[i] = HOLE
        elif inside[i]:
            agrees[i] = abs(measured[i] - predicted[i]) <= eps_share * predicted[i]
    first = 0
    while first < count:
        if agrees[first] or not inside[first]:
            first += 1
            continue
        last = first
        while (
            last + 1 < count and not agrees[last + 1] and (inside[last + 1] or np.isnan(predicted[last + 1]))
        ):
            last += 1
        before, after = first > 0 and agrees[first - 1], last + 1 < count and agrees[last + 1]
        burrs = before and after
        if fill_holes and not (before or after):
            _mark_hidden(measured, predicted, first, last, eps_share, hidden)
        for i in range(first, last + 1):
            if not inside[i]:
                continue
            if np.isnan(measured[i]):
                if fill_holes and (before or after or not hidden[i]):
                    source[i] = FILLED
            elif burrs and not _supported(measured[i], raw, i, samples[2], eps_share):
                short = last - first + 1 <= samples[0] and measured[i] > predicted[i]
                if short or _stands_alone(measured, i, samples[1], 0.5 * eps_share):
                    source[i] = FILLED
        first = last + 1
    return source


@numba.njit(cache=True)
def _supported(reading: float, raw: Float32Array, i: int, reach: int, eps_share: float) -> bool:
    """Whether the other sensor has a reading near this one, close by."""
    for k in range(max(0, i - reach), min(raw.size, i + reach + 1)):
        if abs(raw[k] - reading) <= eps_share * reading:
            return True
    return False


@numba.njit(cache=True)
def _stands_alone(measured: Float32Array, i: int, most: int, slack_share: float) -> bool:
    """Whether a reading, with no more than ``most`` in a row, hangs together with nothing beside it.

    What is beside it must hang together in turn: on a wall seen at a slant every reading stands alone.
    """
    low = high = i
    last = measured.size - 1
    while low > 0 and i - low <= most and _hang(measured[low - 1], measured[low], slack_share):
        low -= 1
    while high < last and high - i <= most and _hang(measured[high], measured[high + 1], slack_share):
        high += 1
    if high - low + 1 > most or low < 2 or high > last - 2:
        return False
    left_hole, right_hole = np.isnan(measured[low - 1]), np.isnan(measured[high + 1])
    left = left_hole or _hang(measured[low - 2], measured[low - 1], slack_share)
    right = right_hole or _hang(measured[high + 1], measured[high + 2], slack_share)
    return left and right and not (left_hole and right_hole)


@numba.njit(cache=True)
def _hang(near: float, far: float, slack_share: float) -> bool:
    """Whether two neighbours may be of one surface; false for a hole."""
    return abs(near - far) <= 0.01 + slack_share * min(near, far)


@numba.njit(cache=True)
def _mark_hidden(
    measured: Float32Array,
    predicted: Float32Array,
    first: int,
    last: int,
    eps_share: float,
    hidden: NDArray[np.bool_],
) -> None:
    """Mark the holes of a run whose nearest readings on both sides, in the run, stand before the lidar's."""
    nearest = np.inf
    for i in range(first, last + 1):
        if np.isnan(measured[i]):
            hidden[i] = nearest < predicted[i] * (1.0 - eps_share)
        else:
            nearest = measured[i]
    nearest = np.inf
    for i in range(last, first - 1, -1):
        if np.isnan(measured[i]):
            hidden[i] = hidden[i] and nearest < predicted[i] * (1.0 - eps_share)
        else:
            nearest = measured[i]


@numba.njit(cache=True)
def repair_image(
    depth: Float32Array,
    source: ProvenanceArray,
    lookup: tuple[IntArray, Float32Array, Float32Array],
    shifted: Float32Array,
    raw: Float32Array,
    heights_m: FloatArray,
    sharp: NDArray[np.bool_],
    range_max_m: float,
    eps_share: float,
    samples: tuple[int, int, int],
) -> None:
    """Repair the pixels that look at the lidar's surfaces, height by height, in place: Xu2024 Eq. (8).

    Parameters
    ----------
    depth, source
        The image and its provenance, flat.
    lookup
        Pixels, factors and slopes of the panorama.
    shifted
        (3, W) the lidar's ranges, carried to the panorama's columns; and moved by half a beam to either side:
        at an edge a pixel may look past the surface that the beam next to it met.
    heights_m, sharp
        (K,) heights, and where the moved ranges are looked at too, for readings that fly: a hole is filled
        from the nearest beam alone.
    raw, samples
        As for `repair_columns`.
    """
    for k in range(heights_m.size):
        for side in range(3 if sharp[k] else 1):
            predicted = shifted[side]
            pixel, measured, scale = look_at(
                depth, lookup[0], lookup[1], lookup[2], predicted, heights_m[k], range_max_m
            )
            allowed = samples if side == 0 else (0, samples[1], samples[2])
            kinds = repair_columns(measured, predicted, raw, pixel >= 0, eps_share, allowed, side == 0)
            for col in range(predicted.size):
                if kinds[col] == FILLED and pixel[col] >= 0:
                    value = predicted[col] / scale[col]
                    if value <= range_max_m:
                        depth[pixel[col]], source[pixel[col]] = value, FILLED
