"""Finds the floor under a sensor from its points."""

from __future__ import annotations

import numpy as np

from fusion.estimation import FEWEST
from slam.measurements import FloatArray

# Minimum share of points on the floor, and maximum share of points below it.
_SEEN, _BELOW = 0.03, 0.02
_BINS = 40  # of the height, so that a bin is as wide as the noise of a depth camera


def floor_below_m(points: FloatArray, up: FloatArray) -> float | None:
    """Distance to the lowest horizontal surface below a sensor; None if there is none.

    Parameters
    ----------
    points
        (N, 3) in the sensor's frame.
    up
        (3,) up direction in that frame.
    """
    heights = points @ up
    below = -heights[heights < 0.0]
    if len(below) < FEWEST or len(below) <= _BELOW * len(heights):
        return None
    lowest = float(np.quantile(below, 1.0 - _BELOW * len(heights) / len(below)))
    width = lowest / _BINS
    counts, edges = np.histogram(below, np.arange(0.0, lowest + 4.0 * width, width))
    near = np.flatnonzero(counts >= _SEEN * len(heights))
    if not near.size or edges[near[-1]] < 0.75 * lowest:
        return None
    among = below[np.abs(below - edges[near[-1]] - 0.5 * width) < 1.5 * width]
    return float(np.median(among))
