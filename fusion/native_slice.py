# mypy: allow-untyped-decorators
"""Slice of a depth image at one known height, and the pixels around it, at the resolution of the image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.curves import (
    EDGE_M,
    HEIGHT_STEP_M,
    NEAREST_M,
    Curve,
    DepthImage,
    Float32Array,
    FloatArray,
    IntArray,
)
from fusion.kernel import kernel
from fusion.panorama import Lookup, lookup_of, yaw_of

_MOST_ROWS = 121


@dataclass(frozen=True)
class ImageView:
    """View of one camera for the repair, at the resolution of its image.

    Attributes
    ----------
    curve
        Ranges at the bearings of the columns.
    lookup
        Pixels that show these ranges.
    low_m, high_m
        Limits of the heights that are as good as that of the curve.
    """

    curve: Curve
    lookup: Lookup
    low_m: float
    high_m: float

    def heights(self, nearest_m: float) -> FloatArray:
        """Return heights to check, so that no row of pixels is missed.

        Parameters
        ----------
        nearest_m
            Smallest range of the lidar's surfaces: there the rows are closest to each other.
        """
        # One step beyond the equally good heights, because walls are vertical.
        low, high = self.low_m - HEIGHT_STEP_M, self.high_m + HEIGHT_STEP_M
        fall = float(self.lookup.slopes[0] - self.lookup.slopes[1])
        rows = min(_MOST_ROWS, 2 + int(np.ceil((high - low) / (nearest_m * fall))))
        return np.linspace(low, high, rows)


def native_step_rad(image: DepthImage) -> float:
    """Return the angle between two columns in the middle of an image."""
    return 1.0 / max(image.intrinsics.fx, image.intrinsics.fy)


def native_slice(image: DepthImage, height_m: float) -> Curve:
    """Find in each column the nearest surface at a height above the camera."""
    step = native_step_rad(image)
    lookup = lookup_of(image, step)
    ranges = _slice(
        np.ascontiguousarray(image.depth_m, dtype=np.float32).ravel(),
        lookup.pixel,
        lookup.range_of_depth,
        lookup.slopes,
        height_m,
        image.range_max_m,
    )
    return Curve(ranges, yaw_of(image) + float(lookup.bearings_rad[0]), step)


@kernel
def _slice(
    depth: Float32Array,
    pixel: IntArray,
    range_of_depth: Float32Array,
    slopes: Float32Array,
    height_m: float,
    range_max_m: float,
) -> NDArray[np.float32]:
    """Return (W,) ranges; computed row by row, as the image is in memory."""
    columns = pixel.shape[1]
    best = np.full(columns, np.nan, np.float32)
    error = np.full(columns, np.inf)
    fall = slopes[0] - slopes[1]
    bounds = (height_m / NEAREST_M, height_m / (1.5 * range_max_m))
    first = max(0, math.floor((slopes[0] - max(bounds)) / fall) - 3)
    last = min(slopes.size - 1, math.ceil((slopes[0] - min(bounds)) / fall) + 3)
    for row in range(first, last + 1):
        slope = slopes[row]
        for col in range(columns):
            at = pixel[row, col]
            if at < 0:
                continue
            value = depth[at]
            if not 0.0 < value <= range_max_m:
                continue
            reach = value * range_of_depth[row, col]
            error_m = abs(slope * reach - height_m)
            # The tolerance is half a pixel, plus noise and the quantisation of the height.
            if error_m > 0.5 * (fall * reach + HEIGHT_STEP_M):
                continue
            nearer = reach < best[col] - EDGE_M
            if np.isnan(best[col]) or nearer or (error_m < error[col] and reach < best[col] + EDGE_M):
                best[col], error[col] = reach, error_m
    return best
