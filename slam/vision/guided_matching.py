"""Matching of features whose place in the image is expected."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import NONE, ZERO, kernel
from slam.measurements import FloatArray
from slam.vision.features import Features, Matches
from slam.vision.place_recognition_vocabulary import ones


def match_near(
    known: Features,
    expected_px: FloatArray,
    seen: Features,
    radius_px: float,
    ratio: float,
    greatest_distance: int,
) -> Matches:
    """Pairs that are each other's nearest among those that lie where they are expected.

    Parameters
    ----------
    known, expected_px
        Features and where they should be in the image, (N, 2); NaN for one that is not in sight.
    seen
        Features of the image.
    radius_px
        How far from the expected place a feature may be.
    ratio
        Greatest share of the second nearest's distance; the second nearest lies within the radius too.
    greatest_distance
        Hamming distance, of 256 bits, above which two descriptors differ.
    """
    empty = np.zeros(0, np.int64)
    if len(known) == 0 or len(seen) == 0:
        return Matches(empty, empty)
    words = [np.ascontiguousarray(side.descriptors).view(np.uint64) for side in (known, seen)]
    target = np.full(len(known), -1, np.int64)
    _nearest(
        expected_px.astype(np.float32),
        words[0],
        seen.pixels,
        words[1],
        radius_px * radius_px,
        ratio,
        greatest_distance,
        target,
        np.full(len(seen), -1, np.int64),
        np.full(len(seen), 8 * known.descriptors.shape[1] + 1),
    )
    first = np.flatnonzero(target >= 0)
    return Matches(first, target[first])


@kernel(nogil=True)
def _nearest(
    expected: NDArray[Any],
    known: NDArray[Any],
    pixels: NDArray[Any],
    seen: NDArray[Any],
    radius_squared: float,
    ratio: float,
    greatest: int,
    target: NDArray[Any],
    owner: NDArray[Any],
    owner_distance: NDArray[Any],
) -> None:
    """Number of the nearest feature seen, or -1; of several that claim one, only the nearest keeps it."""
    for i in range(expected.shape[0]):
        u = expected[i, 0]
        v = expected[i, 1]
        if math.isnan(u + v):
            continue
        best = second = np.int64(64 * known.shape[1] + 1)
        chosen = NONE
        for j in range(pixels.shape[0]):
            du = pixels[j, 0] - u
            dv = pixels[j, 1] - v
            if du * du + dv * dv > radius_squared:
                continue
            distance = ZERO
            for w in range(4):
                distance += ones(known[i, w] ^ seen[j, w])
            if distance < best:
                second, best, chosen = best, distance, j
            elif distance < second:
                second = distance
        if chosen < 0 or best > greatest or best >= ratio * second or best >= owner_distance[chosen]:
            continue
        if owner[chosen] >= 0:
            target[owner[chosen]] = -1
        owner[chosen] = i
        owner_distance[chosen] = best
        target[i] = chosen
