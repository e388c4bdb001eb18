"""Sensor model of the cell in which a range ends: Li2020 Eq. (4)-(6), with noise that grows with range."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.bayes import evidence_steps
from fusion.checks import numbers

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class RangeNoise:
    """Standard deviation of a range r: floor_m + share * r + per_m * r ** 2.

    Attributes
    ----------
    floor_m
        Constant part.
    share
        Part proportional to the range, as in data sheets of lidars.
    per_m
        Quadratic part, 1/m: effect of a disparity error on the depth (Li2020 Eq. (4)).

    Examples
    --------
    >>> import fusion, numpy as np
    >>> camera = fusion.RangeNoise(floor_m=0.002, per_m=0.003)  # of structured light
    >>> camera.sigma_m(np.array([1.0, 2.0, 4.0])).round(3).tolist()
    [0.005, 0.014, 0.05]
    """

    floor_m: float
    share: float = 0.0
    per_m: float = 0.0

    def __post_init__(self) -> None:
        numbers([self.floor_m, self.share, self.per_m], (3,), "floor_m, share, per_m")
        if not (self.floor_m > 0.0 and self.share >= 0.0 and self.per_m >= 0.0):
            raise ValueError(f"{self}: floor_m must be positive, share and per_m not negative")

    def sigma_m(self, range_m: Array) -> Array:
        """Return the standard deviation at each range, metres.

        Examples
        --------
        >>> import fusion, numpy as np
        >>> lidar = fusion.RangeNoise(floor_m=0.01, share=0.005)
        >>> lidar.sigma_m(np.array([2.0, 10.0])).round(3).tolist()
        [0.02, 0.06]
        """
        return np.asarray(self.floor_m + self.share * range_m + self.per_m * np.square(range_m))


def share_in_cell(range_m: Array, noise: RangeNoise, cell_m: float) -> Array:
    """Return the probability that the true end of a range is in the cell whose centre is the measured end."""
    reach = 0.5 * cell_m / (math.sqrt(2.0) * noise.sigma_m(range_m))
    return np.array([math.erf(value) for value in np.ravel(reach)]).reshape(np.shape(range_m))


def hit_evidence(noise: RangeNoise, p_hit: float, cell_m: float, range_max_m: float) -> NDArray[np.int16]:
    """Return the evidence of a hit by range, Ps of Li2020 Eq. (8) as log-odds.

    ``p_hit`` is for a range without noise; with noise, only a share of it applies to this cell.

    Parameters
    ----------
    p_hit
        Hit probability, above 0.5.

    Returns
    -------
    (N,) log-odds steps (`fusion.bayes.STEPS_A_UNIT`); entry i is for ranges from i cells on.

    Raises
    ------
    ValueError
        If ``p_hit`` is not between 0.5 and 1.
    """
    if not 0.5 < p_hit < 1.0:
        raise ValueError(f"p_hit is {p_hit}; it must be above 0.5 and below 1")
    middle_m = (np.arange(math.ceil(range_max_m / cell_m) + 1) + 0.5) * cell_m
    probability = 0.5 + (p_hit - 0.5) * share_in_cell(middle_m, noise, cell_m)
    return np.array([evidence_steps(float(p)) for p in probability], dtype=np.int16)
