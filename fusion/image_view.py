"""A depth image as the repair sees it: the curve that the lidar may have met, and the pixels that show it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.curves import HEIGHT_STEP_M, Curve, DepthImage, Float32Array, FloatArray, IntArray
from fusion.native_slice import native_slice, native_step_rad
from fusion.panorama import lookup_of

MOST_ROWS = 121


@dataclass(frozen=True)
class ImageView:
    """One camera's part in a repair, at the image's own resolution.

    Attributes
    ----------
    curve
        Ranges at the columns' bearings.
    pixel, range_of_depth, slopes
        As in `fusion.panorama.Lookup`.
    low_m, high_m
        Between them lie all heights that are as good as the curve's.
    """

    curve: Curve
    pixel: IntArray
    range_of_depth: Float32Array
    slopes: Float32Array
    low_m: float
    high_m: float

    def heights(self, nearest_m: float) -> FloatArray:
        """Heights to look at, so that no row of pixels is left out.

        Parameters
        ----------
        nearest_m
            Least range of the lidar's surfaces: there the rows are the closest.
        """
        # A step beyond the heights that are as good: walls are upright.
        low, high = self.low_m - HEIGHT_STEP_M, self.high_m + HEIGHT_STEP_M
        fall = float(self.slopes[0] - self.slopes[1])
        rows = min(MOST_ROWS, 2 + int(np.ceil((high - low) / (nearest_m * fall))))
        return np.linspace(low, high, rows)


def view_at_height(image: DepthImage, best_m: float, low_m: float, high_m: float) -> ImageView:
    """The slice of an image with intrinsics at a height above the camera."""
    lookup = lookup_of(image, native_step_rad(image))
    curve = native_slice(image, best_m)
    return ImageView(curve, lookup.pixel, lookup.range_of_depth, lookup.slopes, low_m, high_m)
