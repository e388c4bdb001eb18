"""A depth image as the repair sees it: the curve that the lidar may have met, and the pixels that show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.curves import (
    HEIGHT_STEP_M,
    BoolArray,
    Curve,
    DepthImage,
    Float32Array,
    FloatArray,
    IntArray,
    masked,
)
from fusion.native_slice import native_slice, native_step_rad
from fusion.panorama import lookup_of, yaw_of

MOST_ROWS = 121


@dataclass(frozen=True)
class ImageView:
    """One camera's part in a repair, at the image's own resolution.

    Attributes
    ----------
    curve
        Ranges at the columns' bearings.
    pixel, range_of_depth, slopes
        As in `fusion.panorama.Lookup`; a single row has the slope 0.
    best_m, low_m, high_m
        Heights of the curve, and of all that are as good; 0 for a row.
    """

    curve: Curve
    pixel: IntArray
    range_of_depth: Float32Array
    slopes: Float32Array
    best_m: float
    low_m: float
    high_m: float

    def heights(self, nearest_m: float) -> tuple[FloatArray, BoolArray]:
        """Heights to look at, so that no row of pixels is left out, and which are near the best.

        Parameters
        ----------
        nearest_m
            Least range of the lidar's surfaces: there the rows are the closest.
        """
        if self.low_m == self.high_m == self.best_m == 0.0 and self.slopes.size == 2:
            return np.zeros(1), np.ones(1, dtype=bool)
        # A step beyond the heights that are as good: walls are upright.
        low, high = self.low_m - HEIGHT_STEP_M, self.high_m + HEIGHT_STEP_M
        fall = float(self.slopes[0] - self.slopes[1])
        rows = min(MOST_ROWS, 2 + int(np.ceil((high - low) / (nearest_m * fall))))
        heights = np.linspace(low, high, rows)
        return heights, np.abs(heights - self.best_m) <= 2.0 * HEIGHT_STEP_M


def view_at_height(image: DepthImage, best_m: float, low_m: float, high_m: float) -> ImageView:
    """The slice of an image with intrinsics at a height above the camera."""
    lookup = lookup_of(image, native_step_rad(image))
    return ImageView(
        native_slice(image, best_m), lookup.pixel, lookup.range_of_depth, lookup.slopes, best_m, low_m, high_m
    )


def view_of_row(image: DepthImage, v: int, candidates: int) -> ImageView:
    """One row: candidate v of those of `fusion.panorama.row_curves`.

    Without intrinsics the pixels count as ranges and share the field of view evenly, as published.
    """
    height, width = image.depth_m.shape
    if image.intrinsics is None:
        row = round(v * (height - 1) / max(candidates - 1, 1))
        # Columns run from left to right, bearings from right to left.
        pixel = (row * width + np.arange(width)[::-1]).astype(np.int32)
        scale = np.ones(width, dtype=np.float32)
        step = image.field_of_view_rad / width
        start = -0.5 * (width - 1) * step
    else:
        step = native_step_rad(image)
        lookup = lookup_of(image, step)
        row = round(v * (lookup.slopes.size - 1) / max(candidates - 1, 1))
        pixel, scale = lookup.pixel[row], lookup.range_of_depth[row]
        start = yaw_of(image) + float(lookup.bearings_rad[0])
    depth = np.where(pixel >= 0, image.depth_m.ravel()[pixel], 0.0)
    curve = Curve((masked(depth, image.range_max_m) * scale).astype(np.float32), start, step)
    slopes = np.array([0.0, -1.0], dtype=np.float32)
    return ImageView(curve, np.stack([pixel, pixel]), np.stack([scale, scale]), slopes, 0.0, 0.0, 0.0)
