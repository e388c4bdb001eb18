"""Offset between the clocks of two sensors that both measure the robot's rotation: Xu2024, 2.1."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.checks import numbers
from fusion.curves import FloatArray
from fusion.estimation import FEWEST, ROUNDS, TINY, gate
from fusion.registration import MIDDLE_MAX

# Motion between readings farther apart than this is unknown.
GAP_S = 0.5
# Step of the first search for the clock offset.
STEP_S = 0.01
_PEAK_STEPS = 6
_LEAST_TURN_RAD_S = 0.02  # standard deviation of a yaw rate: below, the robot hardly turns


@dataclass(frozen=True)
class ClockOffset:
    """Offset between two clocks.

    Attributes
    ----------
    offset_s
        Stamp of the second sensor minus stamp of the first, for the same instant.
    sigma_s
        Standard deviation of the offset.
    correlation
        Correlation of the rotations of both sensors at this offset.
    """

    offset_s: float
    sigma_s: float
    correlation: float


def clock_offset(
    first_spans_s: FloatArray,
    first_turned_rad: FloatArray,
    second_spans_s: FloatArray,
    second_turned_rad: FloatArray,
    most_s: float = 1.0,
) -> ClockOffset | None:
    """Estimate a constant offset between two clocks: where the rotations of both correlate best.

    Parameters
    ----------
    first_spans_s, first_turned_rad
        (N, 2) start and end stamps of (N,) rotations that the first sensor measured, of any length. For both
        sensors, a span that begins before an earlier one ends is ignored: a clock may have been set back.
    second_spans_s, second_turned_rad
        (M, 2) and (M,) of the second sensor, with constant angular rate assumed within a span.
    most_s
        Largest offset to try.

    Returns
    -------
    None if the offset is not determined: too few spans, too little rotation, or no clear peak in the range. A
    span is ignored if one of the tried offsets moves it to a time without data of the other sensor. Rotations
    that contradict the rest, as of a slipping wheel, are left out.

    Raises
    ------
    ValueError
        If the arrays have other shapes, or ``most_s`` is not above 0.

    Examples
    --------
    >>> import fusion, numpy as np
    >>> def turns(true_s):
    ...     yaw = 0.5 * np.sin(true_s) + 0.3 * np.sin(2.7 * true_s)
    ...     return np.column_stack([true_s[:-1], true_s[1:]]), np.diff(yaw)
    >>> spans_s, turned_rad = turns(np.arange(0.0, 20.0, 0.04))
    >>> found = fusion.clock_offset(*turns(np.arange(0.0, 20.0, 0.1)), spans_s + 0.25, turned_rad)
    >>> round(found.offset_s, 2)
    0.25
    """
    if not numbers(most_s, (), "most_s") > 0.0:
        raise ValueError(f"most_s is {most_s}; give seconds above 0")
    first_spans_s, first_turned_rad = _rising(first_spans_s, first_turned_rad)
    second_spans_s, second_turned_rad = _rising(second_spans_s, second_turned_rad)
    if min(len(first_spans_s), len(second_spans_s)) < FEWEST:
        return None
    periods_s = [float(np.median(np.diff(spans[:, 0]))) for spans in (first_spans_s, second_spans_s)]
    if periods_s[0] < periods_s[1]:
        # Within long spans the rate is unknown: compare them with sums of short ones, not the reverse.
        found = clock_offset(second_spans_s, second_turned_rad, first_spans_s, first_turned_rad, most_s)
        return None if found is None else replace(found, offset_s=-found.offset_s)
    # Interpolated noise is less halfway between stamps: as the mean over a period, it prefers no offset.
    half = round(0.5 * periods_s[1] / STEP_S)
    steps = math.ceil(most_s / STEP_S)
    every_shift = np.arange(-steps - half, steps + half + 1) * STEP_S
    covered = _covered(first_spans_s, second_spans_s, float(every_shift[-1]))
    spans_s, turned = first_spans_s[covered], first_turned_rad[covered]
    if turned.size < FEWEST:
        return None
    moved = turns_between(second_spans_s, second_turned_rad, spans_s + every_shift[:, None, None])
    moved = np.lib.stride_tricks.sliding_window_view(moved, 2 * half + 1, axis=0).mean(axis=-1)
    shifts, lasted_s = every_shift[half : len(every_shift) - half], spans_s[:, 1] - spans_s[:, 0]
    rates = np.vstack([turned, moved]) / lasted_s
    if rates.std(axis=1).min() < _LEAST_TURN_RAD_S:
        return None
    right = np.ones(turned.size, np.bool_)
    for _ in range(ROUNDS):
        correlation = _correlations(turned[right], moved[:, right])
        best = int(np.argmax(correlation))
        slope, level = np.polyfit(moved[best, right], turned[right], 1)
        misfits = turned - slope * moved[best] - level
        # A slip of the wheels turns like no offset. (A median would be that of a robot that stands still.)
        kept = misfits**2 <= gate() * max(float(misfits[right].var()), TINY**2)
        # Where a robot stands still for long, only its rotations would be left out.
        if np.array_equal(kept, right) or rates[:, kept].std(axis=1).min() < _LEAST_TURN_RAD_S:
            break
        right = kept
    if not 0 < best < shifts.size - 1 or correlation[best] < MIDDLE_MAX:
        return None
    # Fit a parabola to the whole peak, because single samples are noisy.
    low_k, high_k = max(0, best - _PEAK_STEPS), min(shifts.size, best + _PEAK_STEPS + 1)
    bend, tilt, _ = np.polyfit(shifts[low_k:high_k] - shifts[best], correlation[low_k:high_k], 2)
    if bend >= 0.0:
        return None
    offset = float(shifts[best] + np.clip(-0.5 * tilt / bend, -_PEAK_STEPS * STEP_S, _PEAK_STEPS * STEP_S))
    # Least squares: noise divided by slopes. The curvature of the peak contains the product of both sensors'
    # slopes, because noise also causes slopes, but not the same ones in both.
    slopes_squared = -2.0 * bend * turned[right].std() * moved[best, right].std() * np.count_nonzero(right)
    sigma_s = max(float(misfits[right].std()), TINY) / math.sqrt(slopes_squared)
    return ClockOffset(offset, sigma_s, float(correlation[best]))


def _rising(spans_s: FloatArray, turned_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return spans and rotations without those that begin before an earlier one ends."""
    spans_s = numbers(spans_s, (None, 2), "spans_s", finite=False)
    turned_rad = numbers(turned_rad, (len(spans_s),), "turned_rad", finite=False)
    ended_s = np.maximum.accumulate(np.concatenate([[-np.inf], spans_s[:, 1]]))[:-1]
    rising = (spans_s[:, 0] >= ended_s) & (spans_s[:, 1] > spans_s[:, 0])
    return spans_s[rising], turned_rad[rising]


def turns_between(known_s: FloatArray, turned_rad: FloatArray, spans_s: FloatArray) -> FloatArray:
    """Return (...) rotations over spans (..., 2) from (M,) over (M, 2) rising spans, at constant rates."""
    yaw_rad = np.column_stack([np.cumsum(turned_rad) - turned_rad, np.cumsum(turned_rad)])
    yaws = np.interp(spans_s, known_s.ravel(), yaw_rad.ravel())
    return np.asarray(yaws[..., 1] - yaws[..., 0])


def _covered(spans_s: FloatArray, known_s: FloatArray, margin_s: float) -> NDArray[np.bool_]:
    """Return (N,) whether spans cover each span (N, 2) without gaps, with a margin on both sides."""
    known_s = known_s[known_s[:, 1] - known_s[:, 0] < GAP_S]
    if not len(known_s):
        return np.zeros(len(spans_s), np.bool_)
    gaps = np.flatnonzero(known_s[1:, 0] > known_s[:-1, 1])
    begun, ended = known_s[np.append(0, gaps + 1), 0], known_s[np.append(gaps, -1), 1]
    piece = np.searchsorted(begun, spans_s[:, 0] - margin_s, side="right") - 1
    return (piece >= 0) & (spans_s[:, 1] + margin_s <= ended[piece])


def _correlations(turned: FloatArray, moved: FloatArray) -> FloatArray:
    """Return (K,) Pearson correlations of rotations with each of (K, N) others."""
    a = turned - turned.mean()
    b = moved - moved.mean(axis=1, keepdims=True)
    return np.asarray(b @ a / np.sqrt((a @ a) * (b * b).sum(axis=1)))
