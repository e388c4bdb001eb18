"""Evidence of several stations for a pose, and what it makes of rival poses."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from slam.measurements import FloatArray


def way_nats(evidence: Sequence[float], kidnap_nats: float) -> float:
    """Evidence of a way, station by station, or of its end alone if the robot was carried off in between."""
    whole = best = 0.0
    for nats in reversed(evidence):
        whole += nats
        best = max(best, whole)
    return max(whole, best - kidnap_nats)


def posterior(totals: FloatArray, nowhere_nats: float) -> FloatArray:
    """Probabilities of hypotheses (N,) by their evidence; what is left to one is that of none being right."""
    greatest = max(nowhere_nats, totals.max(initial=-math.inf))
    weights = np.exp(totals - greatest)
    return np.asarray(weights / (weights.sum() + math.exp(nowhere_nats - greatest)))
