"""How much a scan prefers one pose to another, an object being one witness however many beams it catches.

A person who walks ahead of the robot in a bare corridor is seen by a third of the beams, and all of them
agree that the robot stands. They are one object, and may be wrong together.
"""

from __future__ import annotations

import math

import numpy as np

from fusion.kernel import kernel
from slam.matching.surfel_map import SurfelMap, nearest_surfel
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
    preferred = _weights(points, normals, pose, surfel_map, kernel_m)
    gain = preferred - _weights(points, normals, other, surfel_map, kernel_m)
    return _by_object(points, gain)


@kernel
def _weights(points, normals, pose, surfel_map: SurfelMap, kernel_m: float):  # type: ignore[no-untyped-def]
    """(M,) Geman-McClure weight of every point at a pose; zero where it finds no surfel."""
    surfels = surfel_map.surfels
    weights = np.zeros(points.shape[0])
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    for i in range(points.shape[0]):
        x = cos * points[i, 0] - sin * points[i, 1] + pose[0]
        y = sin * points[i, 0] + cos * points[i, 1] + pose[1]
        nx = cos * normals[i, 0] - sin * normals[i, 1]
        ny = sin * normals[i, 0] + cos * normals[i, 1]
        k = nearest_surfel(surfel_map, x, y, nx, ny)
        if k >= 0:
            residual = surfels[k, 2] * (x - surfels[k, 0]) + surfels[k, 3] * (y - surfels[k, 1])
            weights[i] = 1.0 / (1.0 + (residual / kernel_m) ** 2) ** 2
    return weights


@kernel
def _by_object(points, gain):  # type: ignore[no-untyped-def]
    """(K,) sums over runs of neighbouring points."""
    sums = np.zeros(points.shape[0])
    count = 0
    first = 0
    for i in range(points.shape[0]):
        if i > 0:
            gap = math.hypot(points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1])
            reach = math.hypot(points[i, 0] - points[first, 0], points[i, 1] - points[first, 1])
            if gap > _GAP_M or reach > _LONGEST_M:
                count += 1
                first = i
        sums[count] += gain[i]
    return sums[: count + 1] if points.shape[0] else sums
