"""Constants that all estimates share: gate, robust scale, and limits for small sums and short steps."""

from __future__ import annotations

import math
from functools import cache

# A true pair is rejected once in a thousand times.
CONFIDENCE = 0.999
# Fewer readings are not enough for statistics.
FEWEST = 20
# Maximum rounds of an iteration; it normally ends earlier, with a step below this, metres or radians.
ROUNDS, SETTLED = 20, 1e-4
# Relative differences below this are rounding.
TINY = 1e-9


@cache
def gate(degrees: int = 1, confidence: float = CONFIDENCE) -> float:
    """Return the squared Mahalanobis distance above which a difference is no noise: a chi-square quantile.

    Parameters
    ----------
    degrees
        Degrees of freedom: the number of differences.
    confidence
        Share of true differences within the gate.
    """
    from scipy.special import chdtri  # imported here because it loads slowly

    return float(chdtri(degrees, 1.0 - confidence))


def half_interval(sigma: float) -> float:
    """Return half the width of the 95 % interval of a normal estimate, as it is reported to users."""
    return math.sqrt(gate(1, 0.95)) * sigma


@cache
def median_to_sigma(degrees: int = 1) -> float:
    """Return the ratio of sigma to median of normal residuals: 1.4826 for distances along one axis.

    Parameters
    ----------
    degrees
        Number of axes of which a residual is the root mean square.
    """
    return math.sqrt(degrees / gate(degrees, 0.5))
