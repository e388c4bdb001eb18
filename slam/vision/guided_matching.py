"""Match features near their predicted position in the image."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import NONE, ZERO, kernel
from slam.measurements import Float32Array, FloatArray
from slam.vision.features import Features, Matches
from slam.vision.place_recognition_vocabulary import ones


def match_near(
    known: Features,
    expected_px: FloatArray,
    current: Features,
    radius_px: float,
    ratio: float,
    greatest_distance: int = 64,
) -> Matches:
    """Match features that are mutual nearest neighbours near their expected position.

    Parameters
    ----------
    known, expected_px
        Features and their expected pixels, (N, 2); NaN for one that is not visible.
    radius_px
        Largest distance from the expected position.
    ratio
        Greatest share of the second nearest's distance; the second nearest is within the radius, too.
    greatest_distance
        Hamming distance, of 256 bits, above which two descriptors differ.
    """
    empty = np.zeros(0, np.int64)
    if len(known) == 0 or len(current) == 0:
        return Matches(empty, empty)
    spans, order = _within_reach(expected_px, current.pixels, radius_px)
    words = [
        np.ascontiguousarray(side).view(np.uint64) for side in (known.descriptors, current.descriptors[order])
    ]
    target = np.full(len(known), -1, np.int64)
    _nearest(
        expected_px.astype(np.float32),
        words[0],
        current.pixels[order],
        words[1],
        order,
        spans,
        radius_px * radius_px,
        ratio,
        greatest_distance,
        target,
        np.full(len(current), -1, np.int64),
        np.full(len(current), 8 * known.descriptors.shape[1] + 1),
    )
    first = np.flatnonzero(target >= 0)
    return Matches(first, target[first])


def _within_reach(
    expected_px: FloatArray, pixels: Float32Array, radius_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return spans (N, 3, 2) of features that may be within a radius of each position, and their order.

    They are ordered by cells as wide as the radius, with empty ones around; three rows of three are in reach.
    """
    reach = radius_px + 1.0  # one pixel more, for rounding; the radius itself decides
    last = np.floor([side.max() / reach for side in pixels.T])
    # Invisible features, NaN, are put at the border.
    cells = [np.fmax(np.fmin(np.floor(side / reach), last + 1.0), -1.0) for side in (pixels, expected_px)]
    columns, rows = (int(side) + 6 for side in last)
    cells_seen, middle = ((side.astype(np.int64) + 3) @ (1, columns) for side in cells)
    up_to = np.cumsum(np.bincount(cells_seen, minlength=rows * columns))
    ends = np.add.outer(middle, np.add.outer([-columns, 0, columns], [-2, 1]).ravel())
    return up_to[ends].reshape(-1, 3, 2), np.argsort(cells_seen, kind="stable")


@kernel(nogil=True)
def _nearest(
    expected: NDArray[Any],
    known: NDArray[Any],
    pixels: NDArray[Any],
    current: NDArray[Any],
    numbers: NDArray[Any],
    spans: NDArray[Any],
    radius_squared: float,
    ratio: float,
    greatest: int,
    target: NDArray[Any],
    owner: NDArray[Any],
    owner_distance: NDArray[Any],
) -> None:
    """Find the nearest feature seen, or -1; each is assigned only to its nearest claimant.

    Seen features are in the order ``numbers`` of `_within_reach`; ``spans`` are those in reach.
    """
    for i in range(expected.shape[0]):
        u = expected[i, 0]
        v = expected[i, 1]
        if math.isnan(u + v):
            continue
        best = second = np.int64(64 * known.shape[1] + 1)
        chosen = NONE
        for band in range(3):
            for j in range(spans[i, band, 0], spans[i, band, 1]):
                du = pixels[j, 0] - u
                dv = pixels[j, 1] - v
                if du * du + dv * dv > radius_squared:
                    continue
                distance = ZERO
                for w in range(4):
                    distance += ones(known[i, w] ^ current[j, w])
                if distance < best:
                    second, best, chosen = best, distance, numbers[j]
                elif distance < second:
                    second = distance
        if chosen < 0 or best > greatest or best >= ratio * second or best >= owner_distance[chosen]:
            continue
        if owner[chosen] >= 0:
            target[owner[chosen]] = -1
        owner[chosen] = i
        owner_distance[chosen] = best
        target[i] = chosen
