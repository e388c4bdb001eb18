"""Estimating from the log itself how the colour camera sits beside the depth camera.

Matched features of frame pairs must fit one rigid motion a pair, once their 3D points are read from the depth
image at the right place. The robust loss of all pairs, each with its best motion, is a smooth bowl over the
registration (the loss of a single pair is not: readings jump at rims), so parabolas along its axes find the
bottom; the derivative of the errors themselves, by Gauss-Newton, does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam.measurements import AnyFloatArray, BoolArray, CameraIntrinsics, Float32Array, FloatArray
from slam.vision.color_registration import (
    ColorRegistration,
    camera_row,
    identity_registration,
    points_of_pixels,
)
from slam.vision.color_registration_kernels import IntArray, settle_motions, squared_errors

_INLIER_PX = 2.0
# The first motion is found through a registration that may be wrong.
_FIRST_INLIER_PX = 4.0
_FIRST_TRIALS = 100
_SCALE_PX = 2.0
_MATCHES_A_PAIR = 300
_FEWEST_MATCHES = 25
_FEWEST_PAIRS = 8
_SETTLING = 3
_SETTLED = 2e-4
# Where the search starts: colour cameras see about as wide as the depth camera, or wider.
_FOCAL_SHARES = (1.1, 1.0, 0.95, 0.9, 0.85, 0.8)
_ROUNDS = 6
# First steps of the search: share of the focal length, pixels, metres; at most so many of them at once.
_STEPS = {"focal": 0.02, "x": 6.0, "y": 6.0, "shift_x": 0.025, "shift_y": 0.015}
_LONGEST_STEP = 2.0
# What is known of such cameras before the log is read, and the loss of one of these widths: short logs hardly
# tell a shift from a moved principal point. Focal length and principal point as shares of the focal length.
_WIDTH_FOCAL, _WIDTH_CENTRE, _WIDTH_SHIFT_X_M, _WIDTH_SHIFT_Y_M = 0.4, 0.017, 0.05, 0.01
_LOSS_OF_A_WIDTH = 0.007
# Evidence: mean gain of a held-out pair in standard errors, more inliers, pixels that really move, and halves
# of the pairs that agree on where to.
_CLEAR = 3.5
_LEAST_GAIN = 0.01
_LEAST_MOVE_PX = 2.0
_MOST_APART = 0.5


@dataclass(frozen=True, slots=True)
class FramePair:
    """Two frames of the log and their matched features.

    Attributes
    ----------
    pixels_a, pixels_b
        (N, 2) column and row of the same N features in the two colour images; wrong matches may be among.
    depth_a_m, depth_b_m
        (H, W) depth images of the two, 0 invalid.
    """

    pixels_a: AnyFloatArray
    pixels_b: AnyFloatArray
    depth_a_m: Float32Array
    depth_b_m: Float32Array


@dataclass(frozen=True, slots=True)
class _Guess:
    """A registration: colour focal length, principal point, shift. `whole`: depth has it too."""

    focal_px: float
    cx: float
    cy: float
    shift_x_m: float = 0.0
    shift_y_m: float = 0.0
    whole: bool = False


@dataclass(frozen=True, slots=True)
class _Problem:
    """All matches of some pairs, pair by pair; arrays as `settle_motions` takes them."""

    pixels_a: FloatArray
    pixels_b: FloatArray
    starts: IntArray
    depths: tuple[tuple[Float32Array, Float32Array], ...]
    poses: FloatArray
    depth_camera: CameraIntrinsics
    typical_depth_m: float


@dataclass(frozen=True, slots=True)
class _Fit:
    """A guess, its loss, and the motions that go with it."""

    guess: _Guess
    loss: float
    poses: FloatArray


def estimate_registration(
    pairs: Sequence[FramePair], intrinsics_depth: CameraIntrinsics, seed: int
) -> ColorRegistration:
    """Whether, and how, the colour camera differs from the depth camera.

    Three explanations compete: colour is registered with the given intrinsics; it is registered, but the
    intrinsics are wrong; it is another camera beside. Each is fitted on one half of the pairs and judged on
    the other. The third is accepted only where it is clearly better than both, by a figure that matters.

    Parameters
    ----------
    pairs
        In the order of the log; 20 to 30 with some motion between (a decimetre, ten degrees) and a hundred
        or more matches are plenty. Both images of a frame have one size.
    intrinsics_depth
        Of the depth camera.
    seed
        Of the choice of matches and of RANSAC.
    """
    problem = _problem(pairs, intrinsics_depth, seed)
    count = problem.starts.size - 1
    if count < _FEWEST_PAIRS:
        reason = f"{count} frame pairs with a motion, {_FEWEST_PAIRS} are needed: taken as registered"
        return identity_registration(intrinsics_depth, reason)
    first = np.arange(count) % 2 == 0
    halves = [_cross_validate(problem, own) for own in (first, ~first)]
    before, after = (
        float(np.concatenate([getattr(h, n) for h in halves]).mean()) for n in ("before", "after")
    )
    refusal = _refusal(halves, after - before, intrinsics_depth)
    if refusal:
        refused = identity_registration(intrinsics_depth, f"taken as registered: {refusal}")
        return replace(refused, inlier_share_before=before, inlier_share_after=after)
    middle = _mean(halves[0].guess, halves[1].guess)
    guess = _search(problem, _fit(problem, middle, 2 * _SETTLING), tuple(_STEPS)).guess
    return ColorRegistration(
        _color_camera(guess, intrinsics_depth),
        intrinsics_depth,
        gtsam.Pose3(gtsam.Rot3(), np.array([guess.shift_x_m, guess.shift_y_m, 0.0])),
        accepted=True,
        reason=(
            f"colour has f = {guess.focal_px:.0f} px and sits {100 * guess.shift_x_m:.1f} cm beside: "
            f"{100 * before:.1f} % of held-out matches fit as registered, {100 * after:.1f} % so"
        ),
        inlier_share_before=before,
        inlier_share_after=after,
    )


@dataclass(frozen=True, slots=True)
class _Half:
    """A guess fitted on half of the pairs, judged on the other: gains by pair, inliers by match."""

    guess: _Guess
    gains: FloatArray
    gains_over_rescaled: FloatArray
    before: BoolArray
    after: BoolArray


def _cross_validate(problem: _Problem, own: BoolArray) -> _Half:
    """Fit on some pairs, judge on the others."""
    depth = problem.depth_camera
    train, test = _subset(problem, own), _subset(problem, ~own)
    registered = _Guess(depth.fx, depth.cx, depth.cy)
    starts = [replace(registered, focal_px=share * depth.fx) for share in _FOCAL_SHARES]
    start = min((_fit(train, guess, 2 * _SETTLING) for guess in starts), key=lambda fit: fit.loss)
    beside = _search(train, start, tuple(_STEPS)).guess
    same = _fit(train, replace(registered, whole=True), 2 * _SETTLING)
    rescaled = _search(train, same, ("focal", "x", "y")).guess
    errors = [_settle(test, guess, test.poses, 2 * _SETTLING)[1] for guess in (registered, rescaled, beside)]
    common = np.isfinite(errors[0]) & np.isfinite(errors[2])
    return _Half(
        beside,
        _gains(test, errors[0], errors[2]),
        _gains(test, errors[1], errors[2]),
        errors[0][common] < _INLIER_PX**2,
        errors[2][common] < _INLIER_PX**2,
    )


def _refusal(halves: Sequence[_Half], gain: float, depth: CameraIntrinsics) -> str:
    """Why the registration must not be used; empty where the evidence is clear."""
    clear = _standard_errors(np.concatenate([half.gains for half in halves]))
    over_rescaled = _standard_errors(np.concatenate([half.gains_over_rescaled for half in halves]))
    moves = [_distance_px(half.guess, _Guess(depth.fx, depth.cx, depth.cy), depth) for half in halves]
    apart = _distance_px(halves[0].guess, halves[1].guess, depth)
    if gain < _LEAST_GAIN:
        return f"another camera explains {100 * gain:.1f} % more of the held-out matches, 1 % is asked"
    if clear < _CLEAR:
        return f"the gain of another camera is {clear:.1f} standard errors, {_CLEAR} are asked"
    if over_rescaled < _CLEAR:
        return f"other intrinsics explain it as well ({over_rescaled:.1f} standard errors): check them"
    if min(moves) < _LEAST_MOVE_PX:
        return f"another camera moves pixels by {min(moves):.1f}, {_LEAST_MOVE_PX} are asked"
    if apart > _MOST_APART * min(moves):
        return f"halves of the log disagree by {apart:.1f} pixels on a move of {min(moves):.1f}"
    return ""


def _standard_errors(gains: FloatArray) -> float:
    """Mean gain in units of its standard error; pairs that judge nothing are left out."""
    known = gains[np.isfinite(gains)]
    if known.size < _FEWEST_PAIRS:
        return 0.0
    return float(known.mean() * np.sqrt(known.size) / max(float(known.std(ddof=1)), 1e-9))


def _gains(problem: _Problem, worse: FloatArray, better: FloatArray) -> FloatArray:
    """(P,) mean gain of loss of each pair over the matches that both can judge; NaN where there is none."""
    gain = _loss(worse) - _loss(better)
    known = np.isfinite(gain)
    sums = np.add.reduceat(np.where(known, gain, 0.0).sum(axis=1), problem.starts[:-1])
    counts = np.add.reduceat(known.sum(axis=1), problem.starts[:-1])
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def _distance_px(a: _Guess, b: _Guess, depth: CameraIntrinsics) -> float:
    """RMS over the image, at 1 to 3 m, between where two guesses place a colour pixel in the depth image."""
    columns, rows = np.meshgrid(
        np.linspace(0.1, 0.9, 9) * depth.width, np.linspace(0.1, 0.9, 9) * depth.height
    )
    squares = []
    for z in (1.0, 2.0, 3.0):
        places = []
        for guess in (a, b):
            x = (columns - guess.cx) / guess.focal_px + guess.shift_x_m / z
            y = (rows - guess.cy) / guess.focal_px + guess.shift_y_m / z
            places.append(depth.fx * np.stack([x, y]))
        squares.append(((places[0] - places[1]) ** 2).sum(axis=0))
    return float(np.sqrt(np.mean(squares)))


def _mean(a: _Guess, b: _Guess) -> _Guess:
    """Half way between."""
    return _Guess(
        0.5 * (a.focal_px + b.focal_px),
        0.5 * (a.cx + b.cx),
        0.5 * (a.cy + b.cy),
        0.5 * (a.shift_x_m + b.shift_x_m),
        0.5 * (a.shift_y_m + b.shift_y_m),
    )


def _loss(errors: FloatArray) -> FloatArray:
    """Of Geman and McClure, 0..1, from squared errors in pixels."""
    return np.asarray(errors / (errors + _SCALE_PX**2))


def _color_camera(guess: _Guess, depth: CameraIntrinsics) -> CameraIntrinsics:
    """The colour camera of a guess; its pixels have the shape of the depth camera's."""
    focal_y = guess.focal_px * depth.fy / depth.fx
    return replace(depth, fx=guess.focal_px, fy=focal_y, cx=guess.cx, cy=guess.cy)


def _settle(
    problem: _Problem, guess: _Guess, poses: FloatArray, iterations: int
) -> tuple[FloatArray, FloatArray]:
    """Motions and (N, 2) squared errors under a guess."""
    color = _color_camera(guess, problem.depth_camera)
    depth = color if guess.whole else problem.depth_camera
    cameras = camera_row(color, depth, guess.shift_x_m, guess.shift_y_m)
    of_a, of_b = [], []
    for pair, (depth_a_m, depth_b_m) in enumerate(problem.depths):
        rows = slice(problem.starts[pair], problem.starts[pair + 1])
        of_a.append(points_of_pixels(problem.pixels_a[rows], depth_a_m, cameras))
        of_b.append(points_of_pixels(problem.pixels_b[rows], depth_b_m, cameras))
    data = (np.concatenate(of_a), np.concatenate(of_b), problem.pixels_a, problem.pixels_b, problem.starts)
    settled = settle_motions(*data, poses, cameras[:4], _SCALE_PX, iterations)
    return settled, squared_errors(*data, settled, cameras[:4])


def _fit(problem: _Problem, guess: _Guess, iterations: int, poses: FloatArray | None = None) -> _Fit:
    """A guess with its best motions."""
    settled, errors = _settle(problem, guess, problem.poses if poses is None else poses, iterations)
    if not np.isfinite(errors).any():
        return _Fit(guess, np.inf, settled)
    return _Fit(guess, float(np.nanmean(_loss(errors))) + _prior(guess, problem.depth_camera), settled)


def _prior(guess: _Guess, depth: CameraIntrinsics) -> float:
    """Loss of a guess before any match is looked at."""
    focal = (guess.focal_px / depth.fx - 1.0) / _WIDTH_FOCAL
    centre = np.hypot(guess.cx - depth.cx, guess.cy - depth.cy) / (_WIDTH_CENTRE * depth.fx)
    shift = np.hypot(guess.shift_x_m / _WIDTH_SHIFT_X_M, guess.shift_y_m / _WIDTH_SHIFT_Y_M)
    return float(_LOSS_OF_A_WIDTH * (focal**2 + centre**2 + shift**2))


def _moved(guess: _Guess, axis: str, amount: float, depth_m: float) -> _Guess:
    """A guess moved along an axis; a shift takes the principal point along, so that `depth_m` stays put."""
    if axis == "focal":
        return replace(guess, focal_px=guess.focal_px + amount)
    if axis == "x":
        return replace(guess, cx=guess.cx + amount)
    if axis == "y":
        return replace(guess, cy=guess.cy + amount)
    aside = guess.focal_px * amount / depth_m
    if axis == "shift_x":
        return replace(guess, cx=guess.cx + aside, shift_x_m=guess.shift_x_m + amount)
    return replace(guess, cy=guess.cy + aside, shift_y_m=guess.shift_y_m + amount)


def _search(problem: _Problem, fit: _Fit, axes: tuple[str, ...]) -> _Fit:
    """Down to the bottom: a parabola through three points on each axis in turn, with shrinking steps."""
    steps = {**_STEPS, "focal": _STEPS["focal"] * problem.depth_camera.fx}

    def at(axis: str, amount: float) -> _Fit:
        guess = _moved(fit.guess, axis, amount, problem.typical_depth_m)
        return _fit(problem, guess, _SETTLING, fit.poses)

    for _ in range(_ROUNDS):
        before = fit.loss
        for axis in axes:
            step = steps[axis]
            tried = [fit, at(axis, -step), at(axis, step)]
            low, high = tried[1].loss - fit.loss, tried[2].loss - fit.loss
            if low + high > 0.0:
                share = float(np.clip(0.5 * (low - high) / (low + high), -_LONGEST_STEP, _LONGEST_STEP))
                tried.append(at(axis, share * step))
                steps[axis] = step * min(1.0, max(0.5, abs(share)))
            fit = min(tried, key=lambda one: one.loss)
        if before - fit.loss < _SETTLED:
            break
    return fit


def _subset(problem: _Problem, chosen: BoolArray) -> _Problem:
    """Some of the pairs."""
    lengths = np.diff(problem.starts)
    rows = np.repeat(chosen, lengths)
    return replace(
        problem,
        pixels_a=problem.pixels_a[rows],
        pixels_b=problem.pixels_b[rows],
        starts=np.concatenate([[0], np.cumsum(lengths[chosen])]),
        depths=tuple(d for d, own in zip(problem.depths, chosen, strict=True) if own),
        poses=problem.poses[chosen],
    )


def _problem(pairs: Sequence[FramePair], depth: CameraIntrinsics, seed: int) -> _Problem:
    """All pairs that have a motion when colour is taken as registered."""
    import cv2

    rng = np.random.default_rng(seed)
    cv2.setRNGSeed(seed)
    cameras = camera_row(depth, depth, 0.0, 0.0)
    pixels_a, pixels_b = [np.empty((0, 2))], [np.empty((0, 2))]
    poses, used, inverse = [], [], [np.empty(0)]
    for pair in pairs:
        chosen = np.sort(rng.permutation(len(pair.pixels_a))[:_MATCHES_A_PAIR])
        own = np.asarray(pair.pixels_a, dtype=np.float64)[chosen]
        other = np.asarray(pair.pixels_b, dtype=np.float64)[chosen]
        points = points_of_pixels(own, pair.depth_a_m, cameras)
        pose = _first_motion(points, other, depth)
        if pose is None:
            continue
        pixels_a.append(own)
        pixels_b.append(other)
        poses.append(pose)
        used.append((pair.depth_a_m, pair.depth_b_m))
        inverse.append(1.0 / points[points[:, 2] > 0.0, 2])
    return _Problem(
        np.concatenate(pixels_a),
        np.concatenate(pixels_b),
        np.cumsum([len(rows) for rows in pixels_a]),
        tuple(used),
        np.array(poses).reshape(-1, 3, 4),
        depth,
        float(1.0 / np.median(np.concatenate(inverse))) if used else 1.0,
    )


def _first_motion(points: FloatArray, pixels: FloatArray, camera: CameraIntrinsics) -> FloatArray | None:
    """(3, 4) ``T_b_a`` by PnP-RANSAC; None where few matches agree."""
    import cv2

    known = points[:, 2] > 0.0
    if np.count_nonzero(known) < _FEWEST_MATCHES:
        return None
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points[known],
        pixels[known],
        matrix,
        None,
        reprojectionError=_FIRST_INLIER_PX,
        iterationsCount=_FIRST_TRIALS,
    )
    if not found or inliers is None or len(inliers) < _FEWEST_MATCHES:
        return None
    return np.hstack([cv2.Rodrigues(turn)[0], shift])
