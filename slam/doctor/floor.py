"""Finds the floor under a sensor from its points."""

from __future__ import annotations

import math

import numpy as np

from fusion.estimation import FEWEST
from slam.measurements import FloatArray

# Limits of a correct mounting: tilt in radians, height in metres.
ANGLE_RAD, LEVER_M = math.radians(5.0), 0.15
# Minimum share of points on the floor, and maximum share of points below it.
_SEEN, _BELOW = 0.03, 0.02
_BINS = 40  # of the height, so that a bin is as wide as the noise of a depth camera


def floor_below_m(points: FloatArray, up: FloatArray) -> float | None:
    """Distance to the lowest horizontal surface below a sensor at the origin; None if there is none.

    ``points`` (N, 3) and the upward direction ``up`` (3,) are in one frame.
    """
    heights = points @ up
    below = -heights[heights < 0.0]
    if len(below) < FEWEST or len(below) <= _BELOW * len(heights):
        return None
    lowest = float(np.quantile(below, 1.0 - _BELOW * len(heights) / len(below)))
    width = lowest / _BINS
    counts, edges = np.histogram(below, np.arange(0.0, lowest + 4.0 * width, width))
    near = np.flatnonzero(counts[:-1] + counts[1:] >= _SEEN * len(heights))  # an edge may divide the floor
    if not near.size or edges[near[-1]] < 0.75 * lowest:
        return None
    return float(np.median(below[np.abs(below - edges[near[-1] + 1]) < 2.0 * width]))


def floor_normal(points: FloatArray, up: FloatArray, height_m: float) -> FloatArray | None:
    """Like `floor_below_m`, the upward normal (3,) of a floor at the stated height; ``up`` may be inexact."""
    middle_m = height_m
    for within_m in LEVER_M * 0.5 ** np.arange(3):
        near = points[np.abs(points @ up + middle_m) < within_m]
        if len(near) < FEWEST:
            return None
        normal = np.linalg.eigh(np.cov(near.T))[1][:, 0]
        up = normal * math.copysign(1.0, normal @ up)
        middle_m = -float(near.mean(axis=0) @ up)
    below_m = floor_below_m(points, up)
    return up if below_m is not None and abs(below_m - height_m) < LEVER_M else None
