"""Estimate the pose of the colour camera relative to the depth camera from the log itself.

Matched features of a frame pair must fit one rigid motion if their 3D points are read at the right place in
the depth image. `color_registration_search.py` finds that place; this file accepts or rejects it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from fusion.estimation import TINY, gate
from slam.measurements import BoolArray, CameraIntrinsics, FloatArray
from slam.vision.color_registration import ColorRegistration, identity_registration
from slam.vision.color_registration_search import (
    AXES,
    MATCH_PX,
    SETTLING,
    FramePair,
    Guess,
    Problem,
    color_camera,
    fit_motions,
    gather_matches,
    robust_loss,
    search,
    settle,
    some_pairs,
)

__all__ = ["FramePair", "estimate_registration"]

_FEWEST_PAIRS = 8
# Start of the search: the field of view of colour is about that of depth, or wider.
_FOCAL_SHARES = (1.1, 1.0, 0.95, 0.9, 0.85, 0.8)
# Evidence: more inliers, and halves of the pairs that agree on the motion of pixels.
_LEAST_GAIN = 0.01
_MOST_APART = 0.5


def estimate_registration(
    pairs: Sequence[FramePair], intrinsics_depth: CameraIntrinsics, seed: int
) -> ColorRegistration:
    """Estimate whether and how the colour camera differs from the depth camera.

    Three explanations compete: colour is registered with the given intrinsics; it is registered, but the
    intrinsics are wrong; it is another camera beside. Each is fitted on one half of the pairs and judged on
    the other. The third is accepted only if it is significantly and relevantly better than both.

    Parameters
    ----------
    pairs
        In log order; 20 to 30 with some motion between (a decimetre, ten degrees) and a hundred or more
        matches suffice. Both images of a frame have one size.
    seed
        Seed of the selection of matches.
    """
    problem = gather_matches(pairs, intrinsics_depth, seed)
    count = problem.starts.size - 1
    if count < _FEWEST_PAIRS:
        reason = f"{count} frame pairs with a motion, {_FEWEST_PAIRS} are needed: taken as registered"
        return identity_registration(intrinsics_depth, reason)
    first = np.arange(count) % 2 == 0
    halves = [_cross_validate(problem, own) for own in (first, ~first)]
    before, after = (
        float(np.concatenate([getattr(h, n) for h in halves]).mean()) for n in ("before", "after")
    )
    apart_px = _distance_px(halves[0].guess, halves[1].guess, intrinsics_depth)
    refusal = _refusal(halves, after - before, apart_px, intrinsics_depth)
    if refusal:
        refused = identity_registration(intrinsics_depth, f"taken as registered: {refusal}")
        return replace(refused, inlier_share_before=before, inlier_share_after=after)
    middle = _mean(halves[0].guess, halves[1].guess)
    guess = search(problem, fit_motions(problem, middle, 2 * SETTLING), tuple(AXES)).guess
    return ColorRegistration(
        color_camera(guess, intrinsics_depth),
        intrinsics_depth,
        gtsam.Pose3(gtsam.Rot3(), np.array([guess.shift_x_m, guess.shift_y_m, 0.0])),
        accepted=True,
        reason=(
            f"colour has f = {guess.focal_px:.0f} px and sits {100 * guess.shift_x_m:.1f} cm beside, "
            # The error of the mean of two estimates is half their difference.
            f"+- {0.5 * apart_px:.1f} px: {100 * before:.1f} % of held-out matches fit as registered, "
            f"{100 * after:.1f} % so"
        ),
        inlier_share_before=before,
        inlier_share_after=after,
    )


@dataclass(frozen=True, slots=True)
class _Half:
    """A guess fitted on half of the pairs, tested on the other: gains by pair, inliers by match."""

    guess: Guess
    gains: FloatArray
    gains_over_rescaled: FloatArray
    before: BoolArray
    after: BoolArray


def _cross_validate(problem: Problem, own: BoolArray) -> _Half:
    """Fit on some pairs, test on the others."""
    depth = problem.depth_camera
    train, test = some_pairs(problem, own), some_pairs(problem, ~own)
    registered = Guess(depth.fx, depth.cx, depth.cy)
    starts = [replace(registered, focal_px=share * depth.fx) for share in _FOCAL_SHARES]
    fits = sorted((fit_motions(train, guess, 2 * SETTLING) for guess in starts), key=lambda fit: fit.loss)
    # Readings jump at edges, so a search may end in a local minimum: two searches rarely do.
    moved = min((search(train, fit, tuple(AXES)) for fit in fits[:2]), key=lambda fit: fit.loss).guess
    same = fit_motions(train, replace(registered, whole=True), 2 * SETTLING)
    rescaled = search(train, same, ("focal", "x", "y")).guess
    errors = [settle(test, guess, test.poses, 2 * SETTLING)[1] for guess in (registered, rescaled, moved)]
    common = np.isfinite(errors[0]) & np.isfinite(errors[2])
    return _Half(
        moved,
        _gains(test, errors[0], errors[2]),
        _gains(test, errors[1], errors[2]),
        errors[0][common] < MATCH_PX**2,
        errors[2][common] < MATCH_PX**2,
    )


def _refusal(halves: Sequence[_Half], gain: float, disagreement: float, depth: CameraIntrinsics) -> str:
    """Return why the registration must not be used; empty if the evidence is clear."""
    clear = _standard_errors(np.concatenate([half.gains for half in halves]))
    over_rescaled = _standard_errors(np.concatenate([half.gains_over_rescaled for half in halves]))
    gate_sigmas = math.sqrt(gate())
    moves = [_distance_px(half.guess, Guess(depth.fx, depth.cx, depth.cy), depth) for half in halves]
    if gain < _LEAST_GAIN:
        return f"another camera explains {100 * gain:z.1f} % more of the held-out matches, 1 % is asked"
    if clear < gate_sigmas:
        return f"the gain of another camera is {clear:.1f} standard errors, {gate_sigmas:.1f} are asked"
    if over_rescaled < gate_sigmas:
        return f"other intrinsics explain it as well ({over_rescaled:.1f} standard errors): check them"
    if min(moves) < MATCH_PX:
        return f"another camera moves pixels by {min(moves):.1f}, {MATCH_PX} are asked"
    if disagreement > _MOST_APART * min(moves):
        return f"halves of the log disagree by {disagreement:.1f} pixels on a move of {min(moves):.1f}"
    return ""


def _standard_errors(gains: FloatArray) -> float:
    """Return the mean gain in units of its standard error; pairs without a result are ignored."""
    known = gains[np.isfinite(gains)]
    if known.size < _FEWEST_PAIRS:
        return 0.0
    return float(known.mean() * np.sqrt(known.size) / max(float(known.std(ddof=1)), TINY))


def _gains(problem: Problem, worse: FloatArray, better: FloatArray) -> FloatArray:
    """Return (P,) the mean gain in loss of each pair over their common matches; NaN if there is none."""
    gain = robust_loss(worse) - robust_loss(better)
    known = np.isfinite(gain)
    sums = np.add.reduceat(np.where(known, gain, 0.0).sum(axis=1), problem.starts[:-1])
    counts = np.add.reduceat(known.sum(axis=1), problem.starts[:-1])
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _distance_px(a: Guess, b: Guess, depth: CameraIntrinsics) -> float:
    """Return the RMS distance of colour pixels in the depth image by two guesses, at 1 to 3 m."""
    shares = np.arange(1, 10) / 10
    columns, rows = np.meshgrid(shares * depth.width, shares * depth.height)
    squares = []
    for z in (1.0, 2.0, 3.0):
        places = []
        for guess in (a, b):
            x = (columns - guess.cx) / guess.focal_px + guess.shift_x_m / z
            y = (rows - guess.cy) / guess.focal_px + guess.shift_y_m / z
            places.append(depth.fx * np.stack([x, y]))
        squares.append(((places[0] - places[1]) ** 2).sum(axis=0))
    return float(np.sqrt(np.mean(squares)))


def _mean(a: Guess, b: Guess) -> Guess:
    """Return the mean of two guesses."""
    fields = ("focal_px", "cx", "cy", "shift_x_m", "shift_y_m")
    return Guess(*(0.5 * (getattr(a, name) + getattr(b, name)) for name in fields))
