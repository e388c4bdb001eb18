"""Find the registration of colour to depth for which matched features fit rigid motions best.

The robust loss of all pairs, each with its best motion, is a smooth function of the registration (the loss of
a single pair is not: readings jump at edges). So parabolas along its axes find the minimum; the derivative of
the errors themselves, by Gauss-Newton, does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fusion.curves import NEAREST_M
from fusion.estimation import FEWEST, ROUNDS, SETTLED
from slam.measurements import AnyFloatArray, BoolArray, CameraIntrinsics, Float32Array, FloatArray
from slam.vision.color_registration import camera_row, points_of_images, points_of_pixels
from slam.vision.color_registration_kernels import IntArray, settle_motions

# Error of a true match, at which the loss is half its maximum.
MATCH_PX = 2.0
_MATCHES_A_PAIR = 300
# Iterations of the motions after a small change of the registration; twice as many after a large one.
SETTLING = 3
# Initial steps of the search: share of the focal length, pixels, metres; and their largest number.
AXES = {"focal": 0.02, "x": 6.0, "y": 6.0, "shift_x": 0.025, "shift_y": 0.015}
_LONGEST_STEP = 2.0
# What is known of such cameras before the log is read, and the loss of one of these widths: short logs hardly
# tell a shift from a moved principal point. Focal length and principal point as shares of the focal length.
_WIDTH_FOCAL, _WIDTH_CENTRE, _WIDTH_SHIFT_X_M, _WIDTH_SHIFT_Y_M = 0.4, 0.017, 0.05, 0.01
_LOSS_OF_A_WIDTH = 0.007


@dataclass(frozen=True, slots=True)
class FramePair:
    """Two frames of the log and their matched features.

    Attributes
    ----------
    pixels_a, pixels_b
        (N, 2) column and row of N matched features in the two colour images; some may be outliers.
    depth_a_m, depth_b_m
        (H, W) depth images of the two, 0 invalid.
    """

    pixels_a: AnyFloatArray
    pixels_b: AnyFloatArray
    depth_a_m: Float32Array
    depth_b_m: Float32Array


@dataclass(frozen=True, slots=True)
class Guess:
    """A registration: colour focal length, principal point, shift. `whole`: depth has it too."""

    focal_px: float
    cx: float
    cy: float
    shift_x_m: float = 0.0
    shift_y_m: float = 0.0
    whole: bool = False


@dataclass(frozen=True, slots=True)
class Problem:
    """All matches of some pairs, pair by pair, in the form of `settle_motions`."""

    pixels_a: FloatArray
    pixels_b: FloatArray
    starts: IntArray
    depths: tuple[tuple[Float32Array, Float32Array], ...]
    poses: FloatArray
    depth_camera: CameraIntrinsics
    typical_depth_m: float
    nearest_m: float


@dataclass(frozen=True, slots=True)
class Fit:
    """A guess, its loss, and its motions."""

    guess: Guess
    loss: float
    poses: FloatArray


def gather_matches(pairs: Sequence[FramePair], depth: CameraIntrinsics, seed: int) -> Problem:
    """Collect all pairs with a motion if colour is assumed registered."""
    rng = np.random.default_rng(seed)
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
        # Row by row, readings are adjacent in memory.
        by_row = np.argsort(own[:, 1])
        pixels_a.append(own[by_row])
        pixels_b.append(other[by_row])
        poses.append(pose)
        used.append((pair.depth_a_m, pair.depth_b_m))
        inverse.append(1.0 / points[points[:, 2] > 0.0, 2])
    return Problem(
        np.concatenate(pixels_a),
        np.concatenate(pixels_b),
        np.cumsum([len(rows) for rows in pixels_a]),
        tuple(used),
        np.array(poses).reshape(-1, 3, 4),
        depth,
        float(1.0 / np.median(np.concatenate(inverse))) if used else 1.0,
        float(min((z.min(where=z > 0.0, initial=np.inf) for both in used for z in both), default=NEAREST_M)),
    )


def some_pairs(problem: Problem, chosen: BoolArray) -> Problem:
    """Return some of the pairs."""
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


def search(problem: Problem, fit: Fit, axes: tuple[str, ...]) -> Fit:
    """Find the minimum: a parabola through three points on each axis in turn, with shrinking steps."""
    steps = {**AXES, "focal": AXES["focal"] * problem.depth_camera.fx}

    def at(axis: str, amount: float) -> Fit:
        guess = _moved(fit.guess, axis, amount, problem.typical_depth_m)
        return fit_motions(problem, guess, SETTLING, fit.poses)

    for _ in range(ROUNDS):
        before = fit.loss
        for axis in axes:
            step = steps[axis]
            tried = [fit, at(axis, -step), at(axis, step)]
            low, high = tried[1].loss - fit.loss, tried[2].loss - fit.loss
            if low + high > 0.0:
                share = float(np.clip(0.5 * (low - high) / (low + high), -_LONGEST_STEP, _LONGEST_STEP))
                tried.append(at(axis, share * step))
                steps[axis] = step * min(1.0, max(0.5, abs(share)))
            fit = min(tried, key=lambda trial: trial.loss)
        if before - fit.loss < SETTLED:
            break
    return fit


def fit_motions(problem: Problem, guess: Guess, iterations: int, poses: FloatArray | None = None) -> Fit:
    """Return a guess with its best motions."""
    settled, errors = settle(problem, guess, problem.poses if poses is None else poses, iterations)
    if not np.isfinite(errors).any():
        return Fit(guess, np.inf, settled)
    return Fit(guess, float(np.nanmean(robust_loss(errors))) + _prior(guess, problem.depth_camera), settled)


def settle(
    problem: Problem, guess: Guess, poses: FloatArray, iterations: int
) -> tuple[FloatArray, FloatArray]:
    """Return motions and (N, 2) squared errors for a guess."""
    color = color_camera(guess, problem.depth_camera)
    depth = color if guess.whole else problem.depth_camera
    cameras = camera_row(color, depth, guess.shift_x_m, guess.shift_y_m)
    rest = (problem.starts, cameras, problem.nearest_m)
    of_a, of_b = (
        points_of_images(pixels, [depths[side] for depths in problem.depths], *rest)
        for side, pixels in enumerate((problem.pixels_a, problem.pixels_b))
    )
    data = (of_a, of_b, problem.pixels_a, problem.pixels_b, problem.starts)
    return settle_motions(*data, poses, cameras[:4], MATCH_PX, iterations)


def robust_loss(errors: FloatArray) -> FloatArray:
    """Return the Geman-McClure loss, 0..1, from squared errors in pixels."""
    return np.asarray(errors / (errors + MATCH_PX**2))


def color_camera(guess: Guess, depth: CameraIntrinsics) -> CameraIntrinsics:
    """Return the colour camera of a guess; its pixels have the aspect of the depth camera's."""
    focal_y = guess.focal_px * depth.fy / depth.fx
    return replace(depth, fx=guess.focal_px, fy=focal_y, cx=guess.cx, cy=guess.cy)


def _prior(guess: Guess, depth: CameraIntrinsics) -> float:
    """Return the prior loss of a guess."""
    focal = (guess.focal_px / depth.fx - 1.0) / _WIDTH_FOCAL
    centre = np.hypot(guess.cx - depth.cx, guess.cy - depth.cy) / (_WIDTH_CENTRE * depth.fx)
    shift = np.hypot(guess.shift_x_m / _WIDTH_SHIFT_X_M, guess.shift_y_m / _WIDTH_SHIFT_Y_M)
    return float(_LOSS_OF_A_WIDTH * (focal**2 + centre**2 + shift**2))


def _moved(guess: Guess, axis: str, amount: float, depth_m: float) -> Guess:
    """Return a guess moved along an axis; a shift also moves the principal point, to fix it at `depth_m`."""
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


def _first_motion(points: FloatArray, pixels: FloatArray, camera: CameraIntrinsics) -> FloatArray | None:
    """Return (3, 4) ``T_b_a`` by PnP-RANSAC; None if few matches agree."""
    import cv2

    known = points[:, 2] > 0.0
    if np.count_nonzero(known) < FEWEST:
        return None
    matrix = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    solved, turn, shift, inliers = cv2.solvePnPRansac(
        points[known],
        pixels[known],
        matrix,
        None,
        reprojectionError=2.0 * MATCH_PX,  # with a registration that may be wrong
    )
    if not solved or inliers is None or len(inliers) < FEWEST:
        return None
    return np.hstack([cv2.Rodrigues(turn)[0], shift])
