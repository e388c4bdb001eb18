"""Finds where faults can occur: edges of objects, and areas occluded for a sensor's second view."""

from __future__ import annotations

import math

import numpy as np

from fusion.kernel import kernel
from slam.measurements import BoolArray, Float32Array
from slam.simulation.home_model import Int32Array

_SHADOW_PX = 1.0  # less than this is a slanted surface, not a shadow


@kernel(nogil=True)
def depth_edges(
    distance_m: Float32Array, face: Int32Array, jump_m: float, jump_share: float
) -> tuple[BoolArray, Float32Array, Float32Array]:
    """Find readings next to a jump in depth from one face to another.

    Parameters
    ----------
    distance_m, face
        (H, W); a scan is an image of one row. Ranges on a slanted wall also jump from beam to beam, but it is
        one face.
    jump_m, jump_share
        A jump exceeds the first and this share of the nearer distance.

    Returns
    -------
    (H, W) whether it is an edge, and the distances of the surfaces before and behind it.
    """
    height, width = distance_m.shape
    edge = np.zeros((height, width), np.bool_)
    fore = np.zeros((height, width), np.float32)
    back = np.zeros((height, width), np.float32)
    for row in range(height):
        for col in range(width):
            own = distance_m[row, col]
            if not own < math.inf:
                continue
            near, far = own, own
            for step in range(4):
                r = row + (step == 0) - (step == 1)
                c = col + (step == 2) - (step == 3)
                if r < 0 or r >= height or c < 0 or c >= width or face[r, c] == face[row, col]:
                    continue
                other = distance_m[r, c]
                if other < math.inf:
                    near, far = min(near, other), max(far, other)
            if far - near > jump_m + jump_share * near:
                edge[row, col] = True
                fore[row, col], back[row, col] = near, far
    return edge, fore, back


@kernel(nogil=True)
def stereo_shadow(depth_m: Float32Array, focal_baseline_px_m: float) -> BoolArray:
    """Find pixels that are occluded for the projector, or for the second camera, to the right of the first.

    A pixel in column u at depth z is in column u - f b / z of the other view. From right to left, these
    columns decrease; one to the right of an earlier one is occluded by a nearer surface.

    Parameters
    ----------
    depth_m
        (H, W), ``inf`` without a surface.
    focal_baseline_px_m
        Focal length times baseline.
    """
    height, width = depth_m.shape
    hidden = np.zeros((height, width), np.bool_)
    for row in range(height):
        leftmost = math.inf
        for col in range(width - 1, -1, -1):
            if not depth_m[row, col] < math.inf:
                continue
            other = col - focal_baseline_px_m / depth_m[row, col]
            if other > leftmost + _SHADOW_PX:
                hidden[row, col] = True
            else:
                leftmost = min(leftmost, other)
    return hidden
