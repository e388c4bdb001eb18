"""Registration as in Xu2024: image rows as candidates, selected by three similarities."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion.curves import SAMPLE_STEP_RAD, Curve, DepthImage, Float32Array, LidarCurve, masked, resample
from fusion.panorama import CurveStack, join, lookup_of, yaw_of
from fusion.registration import Registration, registration_at
from fusion.similarity import Sums, enough, masked_sums, pearson

SIMILARITIES = ("pcc", "inv_cos", "inv_euler")
ROWS = 160  # Xu2024, 3.2.1: v <= 160
_TINY = np.float32(1e-9)


def register_rows(scan: LidarCurve, images: Sequence[DepthImage]) -> Registration:
    """A pair registered by the rows of its images."""
    return register_by_pcc(resample(scan), tuple(row_curves(image) for image in images))


def register_by_pcc(curve: Curve, stacks: tuple[CurveStack, ...]) -> Registration:
    """The candidate and the offset of the greatest PCC."""
    scores = pearson(masked_sums(join(stacks).ranges_m, curve.ranges_m))
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
        return pearson(sums)
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
