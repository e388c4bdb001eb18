"""Registration as in Xu2024: image rows as candidates, selected by three similarities, Eq. (2)-(4).

Every sum over the samples of both curves is one matrix product: candidates (V, W) times windows
of the lidar curve (W, U).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.curves import SAMPLE_STEP_RAD, Curve, DepthImage, Float32Array, LidarCurve, masked, resample
from fusion.panorama import CurveStack, join, lookup_of, yaw_of
from fusion.registration import FEWEST, LEAST_OVERLAP, Registration, registration_at

SIMILARITIES = ("pcc", "inv_cos", "inv_euler")
ROWS = 160  # Xu2024, 3.2.1: v <= 160
_TINY = np.float32(1e-9)


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


def register_rows(scan: LidarCurve, images: Sequence[DepthImage]) -> Registration:
    """A pair registered by the rows of its images."""
    return register_by_pcc(resample(scan), tuple(row_curves(image) for image in images))


def register_by_pcc(curve: Curve, stacks: tuple[CurveStack, ...]) -> Registration:
    """The candidate and the offset of the greatest PCC."""
    scores = pearson_map(masked_sums(join(stacks).ranges_m, curve.ranges_m))
    v, u = (int(at) for at in np.unravel_index(np.argmax(scores), scores.shape))  # Xu2024 Eq. (1)
    return registration_at(curve, stacks, scores, v, u, 1.0)


def row_curves(image: DepthImage, rows: int = ROWS, step_rad: float = SAMPLE_STEP_RAD) -> CurveStack:
    """The rows of one image as curves: Xu2024, 3.2.1.

    A row looks along one slope; ``rows`` of them are spread evenly over the image.
    """
    lookup = lookup_of(image, step_rad)
    chosen = np.linspace(0, lookup.slopes.size - 1, rows).round().astype(int)
    depth = masked(image.depth_m.ravel()[lookup.pixel[chosen]], image.range_max_m)
    start = yaw_of(image) + float(lookup.bearings_rad[0])
    return CurveStack(depth * lookup.range_of_depth[chosen], start, step_rad, np.full(rows, np.nan))


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


def pearson_map(sums: Sums) -> Float32Array:
    """Return Xu2024 Eq. (2), (V, U) in -1..1; 0 if a curve is flat or too few samples are shared."""
    n = np.maximum(sums.n, np.float32(1.0))
    var_d = np.maximum(sums.dd / n - (sums.d / n) ** 2, np.float32(0.0))
    var_l = np.maximum(sums.ll / n - (sums.l / n) ** 2, np.float32(0.0))
    covariance = sums.dl / n - (sums.d / n) * (sums.l / n)
    spread = np.sqrt(var_d * var_l)
    fine = enough(sums) & (spread > _TINY)
    return np.where(fine, np.clip(covariance / np.maximum(spread, _TINY), -1.0, 1.0), 0.0).astype(np.float32)


def inverse_cosine(sums: Sums) -> Float32Array:
    """Xu2024 Eq. (3), (V, U): a distance, 0 for curves that are alike; 1 where too little is shared."""
    norm_d, norm_l, dot = _norms(sums)
    cosine = dot / np.maximum(norm_d * norm_l, _TINY)
    return np.where(enough(sums), np.clip(1.0 - cosine, 0.0, 1.0), 1.0).astype(np.float32)


def inverse_euler(sums: Sums) -> Float32Array:
    """Xu2024 Eq. (4), (V, U): 1 for equal curves; 0 where too little is shared."""
    norm_d, norm_l, _ = _norms(sums)
    apart = np.sqrt(np.maximum(sums.dd - 2.0 * sums.dl + sums.ll, np.float32(0.0)))
    value = 1.0 - apart / np.maximum(np.maximum(norm_d, norm_l), _TINY)
    return np.where(enough(sums), np.clip(value, 0.0, 1.0), 0.0).astype(np.float32)


def similarity_map(sums: Sums, similarity: str) -> Float32Array:
    """(V, U) of one of the three, turned so that larger is more alike."""
    if similarity == "pcc":
        return pearson_map(sums)
    if similarity == "inv_euler":
        return inverse_euler(sums)
    return np.asarray(1.0 - inverse_cosine(sums), dtype=np.float32)


def _norms(sums: Sums) -> tuple[Float32Array, Float32Array, Float32Array]:
    """|D|, |L| and D.L of the unshifted ranges."""
    c = sums.shift_m
    dd = sums.dd + 2.0 * c * sums.d + sums.n * c * c
    ll = sums.ll + 2.0 * c * sums.l + sums.n * c * c
    dot = sums.dl + c * (sums.d + sums.l) + sums.n * c * c
    return np.sqrt(np.maximum(dd, 0.0)), np.sqrt(np.maximum(ll, 0.0)), dot
