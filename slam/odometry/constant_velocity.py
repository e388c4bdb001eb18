"""Constant velocity prediction: the last motion, scaled to another time, if nothing else measures it."""

from __future__ import annotations

import math

import numpy as np

from fusion.time_alignment import GAP_S
from slam.config.stages import PredictionConfig
from slam.matching.motion import Motion
from slam.measurements import FloatArray

# A velocity is extrapolated over at most this many times the step of its measurement.
_GREATEST_STRETCH = 3.0


def stretch(step_s: float, measured_s: float) -> float:
    """Return how often a step of ``measured_s`` is repeated in ``step_s``; once if no time passed."""
    if step_s <= 0.0 or measured_s <= 0.0:
        return 1.0
    return min(step_s / measured_s, _GREATEST_STRETCH)


def repeated(
    step: FloatArray,
    measured_s: float,
    step_s: float,
    config: PredictionConfig,
    *,
    alone: bool = False,
    steady_s: float = GAP_S,
) -> Motion:
    """Scale a motion (3,) measured over one time to another time.

    The acceleration is unknown, so the error grows with the square of the time beyond ``steady_s``. If it is
    the only prediction, ``alone``, it ends with a gap: by then, the rotation has changed.
    """
    ends_s = max(GAP_S, measured_s) if alone else step_s
    step = step * stretch(min(step_s, ends_s), measured_s)
    sigma_m = config.velocity_floor + config.velocity_share * math.hypot(step[0], step[1])
    sigma_rad = config.velocity_floor + config.velocity_share * abs(float(step[2]))
    covariance = np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
    return Motion(step, covariance * max(step_s / steady_s, 1.0) ** 4)
