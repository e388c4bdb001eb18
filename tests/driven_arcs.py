"""A robot on a floor that drives arcs either way."""

from __future__ import annotations

import numpy as np

from slam.measurements import FloatArray

STAMPS = np.arange(0.0, 30.0, 0.1)


def base_rows() -> FloatArray:
    """(N, 4) of its wheel odometry: stamp, x, y, heading."""
    speed, rate = 0.5 + 0.1 * np.sin(STAMPS), 0.9 * np.sin(0.8 * STAMPS) + 0.4 * np.sin(2.3 * STAMPS)
    heading = np.cumsum(rate) * 0.1
    x, y = np.cumsum(0.1 * speed * np.cos(heading)), np.cumsum(0.1 * speed * np.sin(heading))
    return np.column_stack([STAMPS, x, y, heading])
