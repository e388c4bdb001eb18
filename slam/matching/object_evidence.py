"""How much a scan prefers one pose to another, an object being one witness however many beams it catches.

A person who walks ahead of the robot in a bare corridor is seen by a third of the beams, and all of them
agree that the robot stands. They are one object, and may be wrong together.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.kernel import NONE, kernel
from slam.matching.point_to_line import terms_at
from slam.matching.surfel_map import SurfelMap
from slam.measurements import AnyFloatArray, FloatArray

# Neighbouring points further apart than this are on different objects; a wall is cut at every metre.
_GAP_M = 0.2
_LONGEST_M = 1.0


def object_evidence(
    points: AnyFloatArray,
    normals: AnyFloatArray,
    pose: FloatArray,
    other: FloatArray,
    surfel_map: SurfelMap,
    kernel_m: float,
) -> FloatArray:
    """What every object says for ``pose`` against ``other``.

    Parameters
    ----------
    points, normals
        (M, 2), base frame, in beam order.
    pose, other
        (3,) of the base in the map.
    kernel_m
        Width of the Geman-McClure kernel.

    Returns
    -------
    (K,) sums of the points' robust weights at ``pose`` less those at ``other``, an object each.
    """
    preferred = terms_at(points, normals, pose, surfel_map, kernel_m)[:, 3]
    gain = preferred - terms_at(points, normals, other, surfel_map, kernel_m)[:, 3]
    objects = np.empty(points.shape[0], np.int64)
    _number_objects(points, objects)
    return np.asarray(np.bincount(objects, gain), np.float64)


@kernel
def _number_objects(points, objects):  # type: ignore[no-untyped-def]
    """Write the number of the object of each point: runs of neighbouring points."""
    number = NONE
    first_x = first_y = before_x = before_y = 0.0
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        gap = math.hypot(x - before_x, y - before_y)
        reach = math.hypot(x - first_x, y - first_y)
        if i == 0 or gap > _GAP_M or reach > _LONGEST_M:
            number += 1
            first_x = x
            first_y = y
        before_x = x
        before_y = y
        objects[i] = number
