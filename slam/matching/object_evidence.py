"""How much a scan prefers one pose to another, with each object counted once, however many beams hit it.

A person who walks ahead of the robot in a bare corridor is hit by a third of the beams, and all of these
beams agree that the robot stands still. They are one object, and may be wrong together.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import NONE, kernel
from slam.measurements import AnyFloatArray, FloatArray

# Neighbouring points farther apart than this are on different objects; a wall is divided at every metre.
GAP_M = 0.2
LONGEST_M = 1.0


def object_evidence(points: AnyFloatArray, gain: FloatArray) -> FloatArray:
    """Return sums (K,) per object of the evidence (M,) of points (M, 2) in beam order."""
    return np.asarray(np.bincount(objects_of(points, LONGEST_M), gain), np.float64)


def objects_of(points: AnyFloatArray, longest_m: float) -> NDArray[np.int64]:
    """Return the number of the object (M,) of points (M, 2) in beam order; none is longer than given."""
    objects = np.empty(points.shape[0], np.int64)
    _number_objects(points, longest_m, objects)
    return objects


@kernel
def _number_objects(points, longest_m, objects):  # type: ignore[no-untyped-def]
    """Write the object number of each point: runs of neighbouring points."""
    number = NONE
    first_x = first_y = before_x = before_y = 0.0
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        gap = math.hypot(x - before_x, y - before_y)
        reach = math.hypot(x - first_x, y - first_y)
        if i == 0 or gap > GAP_M or reach > longest_m:
            number += 1
            first_x = x
            first_y = y
        before_x = x
        before_y = y
        objects[i] = number
