"""Medians with intervals, and paired comparisons of configurations on the same data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from slam.measurements import FloatArray

RESAMPLES = 2000
SHARE = 0.95
_SEED = 20
# With fewer pairs, even a common sign is not significant: 2 * 0.5**6 is the first value below 0.05.
LEAST_PAIRS = 6
Verdict: TypeAlias = Literal["better", "worse", "undecided", "too few pairs"]


@dataclass(frozen=True, slots=True)
class Interval:
    """A median with its 95 % bootstrap interval; limits are ``nan`` for fewer than two values."""

    median: float
    low: float
    high: float
    count: int


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """A configuration minus the reference, over the runs that both have.

    Attributes
    ----------
    difference
        Median of the differences with its interval.
    better
        Number of pairs in which it is better than the reference.
    verdict
        ``better`` or ``worse`` if the interval excludes zero and there are `LEAST_PAIRS`.
    """

    difference: Interval
    better: int
    verdict: Verdict


def interval_of(groups: Mapping[str, Sequence[float]]) -> Interval:
    """Median of all values, with the interval of a two-stage bootstrap: groups, then values in them.

    Drives through one home are similar: resampling single drives would make the interval too narrow.
    Davison and Hinkley 1997, section 3.8.

    Parameters
    ----------
    groups
        Values by group, at least one value in all.
    """
    samples = [np.asarray(values, dtype=np.float64) for values in groups.values() if len(values)]
    every = np.concatenate(samples)
    median = float(np.median(every))
    if every.size < 2:
        return Interval(median, np.nan, np.nan, every.size)
    medians = _resampled_medians(samples, np.random.default_rng(_SEED))
    low, high = np.quantile(medians, [0.5 - SHARE / 2.0, 0.5 + SHARE / 2.0])
    return Interval(median, float(low), float(high), every.size)


def paired(
    values: Mapping[tuple[str, str, int], float],
    reference: Mapping[tuple[str, str, int], float],
    *,
    smaller_is_better: bool,
) -> PairedDifference | None:
    """Compare with the reference on the same data sets and seeds; None if there is no common one.

    Parameters
    ----------
    values, reference
        Values by group, data set and seed. A side without seeds has a single seed per data set; it is
        compared with every seed of the other side.
    """
    groups: dict[str, list[float]] = {}
    for group, difference in _pairs(values, reference):
        groups.setdefault(group, []).append(difference)
    if not groups:
        return None
    interval = interval_of(groups)
    sign = 1.0 if smaller_is_better else -1.0
    better = sum(sign * difference < 0.0 for each in groups.values() for difference in each)
    verdict: Verdict = "undecided"
    if interval.count < LEAST_PAIRS:
        verdict = "too few pairs"
    elif sign * interval.low > 0.0 and sign * interval.high > 0.0:
        verdict = "worse"
    elif sign * interval.low < 0.0 and sign * interval.high < 0.0:
        verdict = "better"
    return PairedDifference(interval, better, verdict)


def _pairs(
    values: Mapping[tuple[str, str, int], float], reference: Mapping[tuple[str, str, int], float]
) -> list[tuple[str, float]]:
    """Group and difference of every pair, for the seeds of the side with more seeds."""
    richer = values if len(values) >= len(reference) else reference
    differences = [(key[0], _of(values, *key) - _of(reference, *key)) for key in richer]
    return [(group, difference) for group, difference in differences if not np.isnan(difference)]


def _of(values: Mapping[tuple[str, str, int], float], group: str, dataset: str, seed: int) -> float:
    """The value of a pair, or of the data set if it has only one; nan if there is none."""
    if (group, dataset, seed) in values:
        return values[group, dataset, seed]
    only = [value for (g, d, _), value in values.items() if (g, d) == (group, dataset)]
    return only[0] if len(only) == 1 else np.nan


def _resampled_medians(samples: Sequence[FloatArray], rng: np.random.Generator) -> FloatArray:
    """(RESAMPLES,) medians of resampled groups with resampled values."""
    sizes = np.array([each.size for each in samples])
    drawn = rng.integers(sizes.size, size=(RESAMPLES, sizes.size))
    # Each element of a drawn group is one of its values; missing elements of smaller groups sort last.
    within = (rng.random((*drawn.shape, sizes.max())) * sizes[drawn][..., None]).astype(np.int64)
    values = np.concatenate(samples)[(np.cumsum(sizes) - sizes)[drawn][..., None] + within]
    values[np.arange(sizes.max()) >= sizes[drawn][..., None]] = np.inf
    ordered, count = np.sort(values.reshape(RESAMPLES, -1)), sizes[drawn].sum(axis=1)
    row = np.arange(RESAMPLES)
    return np.asarray(0.5 * (ordered[row, (count - 1) // 2] + ordered[row, count // 2]))
