"""Similarity of two curves, Xu2024 Eq. (2), and the grade of a pair."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from fusion.curves import Float32Array
from fusion.estimation import FEWEST, TINY

LOW_MAX, MIDDLE_MAX = 0.3, 0.6  # Xu2024, Table 1
LEAST_OVERLAP = 0.3


class Grade(IntEnum):
    """Reliability of a pair, by its PCC (Xu2024, Table 1).

    Examples
    --------
    >>> import fusion
    >>> fusion.Grade.HIGH > fusion.Grade.MIDDLE > fusion.Grade.LOW
    True
    """

    LOW = 0
    MIDDLE = 1
    HIGH = 2


def grade_of(pcc: float) -> Grade:
    """Return the class of a PCC in the paper.

    Examples
    --------
    >>> from fusion.similarity import grade_of
    >>> [grade_of(pcc).name for pcc in (0.2, 0.5, 0.9)]
    ['LOW', 'MIDDLE', 'HIGH']
    """
    if pcc > MIDDLE_MAX:
        return Grade.HIGH
    return Grade.MIDDLE if pcc > LOW_MAX else Grade.LOW


def pearson(one: Float32Array, other: Float32Array) -> float:
    """Return Xu2024 Eq. (2) of two curves (W,), ``nan`` invalid; 0 if one is flat or too few are shared.

    Examples
    --------
    >>> import numpy as np
    >>> from fusion.similarity import pearson
    >>> curve = np.random.default_rng(0).uniform(1.0, 4.0, 90)
    >>> round(pearson(curve, curve), 3), round(pearson(curve, -curve), 3)
    (1.0, -1.0)
    """
    both = np.isfinite(one) & np.isfinite(other)
    if both.sum() < max(FEWEST, LEAST_OVERLAP * one.size):
        return 0.0
    a, b = one[both].astype(np.float64), other[both].astype(np.float64)
    return float(np.corrcoef(a, b)[0, 1]) if a.std() * b.std() > TINY else 0.0
