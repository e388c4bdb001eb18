"""Similarity of two curves: Xu2024 Eq. (2), masked, for all candidates and offsets at once.

Every sum over the samples of both curves is one matrix product: candidates (V, W) times windows
of the lidar curve (W, U).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from fusion.curves import Float32Array
from fusion.estimation import FEWEST, TINY

LOW_MAX, MIDDLE_MAX = 0.3, 0.6  # Xu2024, Table 1
LEAST_OVERLAP = 0.3
_TINY = np.float32(TINY)


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


@dataclass(frozen=True)
class Sums:
    """Sums over the samples that a candidate D_v and a window L_u share, each (V, U).

    Attributes
    ----------
    n
        Number of samples.
    d, l, dd, ll, dl
        Sums of D, L, their squares and their product, after ``shift_m`` is subtracted from both.
    shift_m
        A mean range: without it, squares of metres hide centimetre differences in single precision.
    width
        Number of samples of a candidate, valid or not.
    """

    n: Float32Array
    d: Float32Array
    l: Float32Array  # noqa: E741  the paper's letter
    dd: Float32Array
    ll: Float32Array
    dl: Float32Array
    shift_m: np.float32
    width: int


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


def masked_sums(candidates_m: Float32Array, curve_m: Float32Array) -> Sums:
    """Compute all sums at once.

    Parameters
    ----------
    candidates_m
        (V, W) ranges, ``nan`` invalid.
    curve_m
        (Psi,) lidar ranges at the same step; Psi >= W gives U = Psi - W + 1 windows.

    Raises
    ------
    ValueError
        If the lidar curve is shorter than the candidates.
    """
    width = candidates_m.shape[1]
    if curve_m.size < width:
        raise ValueError(
            f"the lidar curve has {curve_m.size} samples, the image's {width}; Xu2024 needs the lidar wider"
        )
    has_d, has_l = np.isfinite(candidates_m), np.isfinite(curve_m)
    shift = np.float32(np.median(curve_m[has_l])) if has_l.any() else np.float32(0.0)
    d = np.where(has_d, candidates_m - shift, np.float32(0.0)).astype(np.float32)
    l_shifted = np.where(has_l, curve_m - shift, np.float32(0.0)).astype(np.float32)
    left = np.concatenate([has_d.astype(np.float32), d, d * d])
    rows = len(candidates_m)

    def windows(values: Float32Array) -> Float32Array:
        return np.ascontiguousarray(np.lib.stride_tricks.sliding_window_view(values, width).T)

    by_mask = left @ windows(has_l.astype(np.float32))
    by_range = left[: 2 * rows] @ windows(l_shifted)
    by_square = left[:rows] @ windows(l_shifted * l_shifted)
    return Sums(
        n=by_mask[:rows],
        d=by_mask[rows : 2 * rows],
        l=by_range[:rows],
        dd=by_mask[2 * rows :],
        ll=by_square,
        dl=by_range[rows:],
        shift_m=shift,
        width=width,
    )


def enough(sums: Sums) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return (V, U) where a candidate and a window share enough samples to be compared."""
    return sums.n >= max(FEWEST, LEAST_OVERLAP * sums.width)


def pearson(sums: Sums) -> Float32Array:
    """Return Xu2024 Eq. (2), (V, U) in -1..1; 0 if a curve is flat or too few samples are shared.

    Examples
    --------
    >>> import numpy as np
    >>> from fusion.similarity import masked_sums, pearson
    >>> curve = np.random.default_rng(0).uniform(1.0, 4.0, 90).astype(np.float32)
    >>> alike = pearson(masked_sums(curve[None, 25:75], curve))  # one candidate at each offset
    >>> int(alike[0].argmax()), alike.shape
    (25, (1, 41))
    """
    n = np.maximum(sums.n, np.float32(1.0))
    var_d = np.maximum(sums.dd / n - (sums.d / n) ** 2, np.float32(0.0))
    var_l = np.maximum(sums.ll / n - (sums.l / n) ** 2, np.float32(0.0))
    covariance = sums.dl / n - (sums.d / n) * (sums.l / n)
    spread = np.sqrt(var_d * var_l)
    fine = enough(sums) & (spread > _TINY)
    return np.where(fine, np.clip(covariance / np.maximum(spread, _TINY), -1.0, 1.0), 0.0).astype(np.float32)
