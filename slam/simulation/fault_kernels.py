"""Where faults can be: the borders of things, and what a sensor's second eye cannot see."""

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
    """Readings next to a jump in depth from one face to another.

    Parameters
    ----------
    distance_m, face
        (H, W) a row of beams is an image of one row. A slanted wall jumps from beam to beam too, but it is
        one face.
    jump_m, jump_share
        A jump is more than the first and this share of the nearer distance.

    Returns
    -------
    (H, W) whether it is an edge, and there the distances of what is before and behind.
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
    """Pixels that the projector, or the second camera, on the right of the first cannot see.

    A pixel in column u at depth z lies in the other eye's column u - f b / z. From right to left these
    columns fall; one that lies right of an earlier one is hidden behind a nearer surface.

    Parameters
    ----------
    depth_m
        (H, W), ``inf`` where there is nothing.
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
