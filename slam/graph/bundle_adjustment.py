"""Bundle adjustment of a sliding window of RGB-D keyframes (Yang2021 Eq. (7)-(12)).

A robust round tells true sightings from false, a plain round gives poses and covariance. The factors are in
``window_factors``. Smart factors were measured and lost: GTSAM's Python has no stereo one, and the monocular
one, blind to the depths, left 41 mm of error where these leave 3 (7 keyframes x 300 landmarks).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.special import chdtri

from slam.errors import GraphError
from slam.graph.landmarks import (
    LandmarkObservations,
    starting_points,
    tracked,
    well_placed,
    whitened_residuals,
)
from slam.graph.window_factors import (
    PoseStep,
    WindowNoise,
    WindowState,
    landmarks_first,
    window_graph,
    window_state,
    window_values,
)
from slam.measurements import BoolArray, CameraIntrinsics, FloatArray

# 95 % efficiency under Gaussian noise (Huber 1964).
_HUBER_SIGMAS = 1.345
_MAD_TO_SIGMA = 1.4826
# No camera is ten times better than its stated noise: keeps a perfect simulation from refusing itself.
_LEAST_SCALE = 0.1
# The robust round need not settle: what follows solves anew.
_ROBUST_TOLERANCE = 0.02
# A last step below this, in its own standard deviations, changes nothing.
_SETTLED_SIGMAS = 0.05


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """How a window is adjusted.

    Attributes
    ----------
    depth_sigma_at_1m
        Standard deviation of a depth at 1 m, in metres; it grows with the square of the distance. The
        default is Kinect's (Khoshelham 2012, Eq. (10)).
    inlier_probability
        Chi-square probability at which a true sighting passes the gate.
    fewest_sightings
        Of shared landmarks, from a keyframe that no step holds.
    most_landmarks
        The ones seen from the most keyframes are used: bounds the time.
    most_iterations
        Of either round.
    """

    depth_sigma_at_1m: float = 1.425e-3
    inlier_probability: float = 0.99
    fewest_sightings: int = 8
    most_landmarks: int = 300
    most_iterations: int = 6


@dataclass(frozen=True, slots=True)
class WindowResult:
    """The adjusted window and its trust.

    Attributes
    ----------
    poses
        ``T_odom_camera`` of every keyframe; the first as it was.
    covariance_first, covariance_previous
        (6, 6) of the last pose relative to the first and to the one before it, GTSAM's order, in the last
        pose's frame; by the noise as measured, not as stated.
    inliers
        (M,) sightings that were used and agreed.
    residual_px
        Robust standard deviation of a pixel coordinate of the inliers.
    depth_sigma_at_1m
        The depth's noise as measured, to compare with the setting, metres; NaN where no depth was used.
    converged
        Whether the last step was small against its own uncertainty.
    """

    poses: tuple[gtsam.Pose3, ...]
    covariance_first: FloatArray
    covariance_previous: FloatArray
    inliers: BoolArray
    residual_px: float
    depth_sigma_at_1m: float
    converged: bool


@dataclass(frozen=True, slots=True)
class WindowFailure:
    """Why a window could not be adjusted."""

    reason: str


@dataclass(frozen=True, slots=True)
class _Problem:
    """What both rounds share; the landmarks are numbered without a gap."""

    observations: LandmarkObservations
    intrinsics: CameraIntrinsics
    steps: Sequence[PoseStep]
    settings: WindowSettings

    def residuals(self, state: WindowState) -> tuple[FloatArray, FloatArray]:
        """Residuals over the stated noise: pixels (M, 2), inverse depths (M,), NaN where there is none."""
        sigma = self.settings.depth_sigma_at_1m
        return whitened_residuals(self.observations, state.poses, state.points, self.intrinsics, sigma)

    def graph(
        self, state: WindowState, kept: BoolArray, noise: WindowNoise
    ) -> tuple[gtsam.NonlinearFactorGraph, list[int]]:
        """Factors of the kept sightings, and the landmarks in them."""
        seen = self.observations.where(kept)
        count = len(state.poses)
        graph = window_graph(state.poses[0], count, self.steps, seen, self.intrinsics, noise)
        return graph, np.unique(seen.landmark).tolist()

    def left_over(self, kept: BoolArray, pose_count: int) -> float:
        """Share of the noise that the adjustment cannot take up: measurements less unknowns."""
        seen = self.observations.where(kept)
        measurements = 2 * len(seen) + int((seen.depth_m > 0.0).sum())
        unknowns = 3 * np.unique(seen.landmark).size + 6 * max(pose_count - 1 - len(self.steps), 0)
        return max(measurements - unknowns, 1) / max(measurements, 1)

    def fault(self, kept: BoolArray, pose_count: int) -> str | None:
        """What the kept sightings lack for a solution."""
        seen = self.observations.where(kept)
        if not self.steps and not (seen.depth_m > 0.0).any():
            return "neither a depth nor a step tells the scale"
        held = {0, *(end for step in self.steps for end in (step.source, step.target))}
        fewest = self.settings.fewest_sightings
        for keyframe, count in enumerate(np.bincount(seen.keyframe, minlength=pose_count).tolist()):
            if keyframe not in held and count < fewest:
                return f"keyframe {keyframe} shares {count} landmarks, it takes {fewest}"
        return None


def adjust_window(
    poses: Sequence[gtsam.Pose3],
    observations: LandmarkObservations,
    intrinsics: CameraIntrinsics,
    steps: Sequence[PoseStep] = (),
    settings: WindowSettings | None = None,
) -> WindowResult | WindowFailure:
    """Minimise the reprojection error over poses and landmarks (Yang2021 Eq. (7)-(12)).

    Landmarks seen from fewer than two keyframes are ignored.

    Parameters
    ----------
    poses
        (K) ``T_odom_camera`` to start from, two at least; the first is held.
    steps
        Measured motions within the window; the caller vouches for them.

    Raises
    ------
    GraphError
        Where an input is not finite, not positive, or names a keyframe that is not there.
    """
    _check(poses, observations, steps)
    settings = settings or WindowSettings()
    used = tracked(observations, np.ones(len(observations), np.bool_), settings.most_landmarks)
    if not used.any():
        return WindowFailure("no landmark is seen from two keyframes")
    problem = _Problem(observations.where(used).renumbered(), intrinsics, steps, settings)
    points, known = starting_points(problem.observations, poses, intrinsics)
    kept = known[problem.observations.landmark]
    start = WindowState(tuple(poses), points)
    if fault := problem.fault(kept, len(poses)):
        return WindowFailure(fault)
    try:
        return _two_rounds(problem, start, kept, used)
    except RuntimeError as error:  # GTSAM's indeterminate linear system
        return WindowFailure(f"the window is not determined: {str(error).strip().splitlines()[0]}")


def _two_rounds(
    problem: _Problem, start: WindowState, kept: BoolArray, used: BoolArray
) -> WindowResult | WindowFailure:
    """Robust round, gate, plain round."""
    state = _robust_round(problem, start, kept)
    kept = tracked(problem.observations, _agreeing(problem, state, kept), problem.settings.most_landmarks)
    placed = well_placed(problem.observations.where(kept), state.poses, state.points)
    kept &= placed[problem.observations.landmark]
    if fault := problem.fault(kept, len(state.poses)):
        return WindowFailure(f"after the outliers: {fault}")
    noise = _measured_noise(problem, state, kept)
    state, tree, converged = _plain_round(problem, state, kept, noise)
    pixels, depths = problem.residuals(state)
    inliers = used.copy()
    inliers[used] = kept
    last = len(state.poses) - 1
    return WindowResult(
        poses=state.poses,
        covariance_first=_relative_covariance(tree, state.poses, 0, last),
        covariance_previous=_relative_covariance(tree, state.poses, last - 1, last),
        inliers=inliers,
        residual_px=_MAD_TO_SIGMA
        * float(np.median(np.abs(pixels * problem.observations.sigma_px[:, None])[kept])),
        depth_sigma_at_1m=noise.depth_sigma_at_1m if np.isfinite(depths[kept]).any() else float("nan"),
        converged=converged,
    )


def _robust_round(problem: _Problem, start: WindowState, kept: BoolArray) -> WindowState:
    """Huber's loss and Levenberg-Marquardt."""
    kernel = gtsam.noiseModel.mEstimator.Huber.Create(_HUBER_SIGMAS)
    noise = WindowNoise(1.0, problem.settings.depth_sigma_at_1m, kernel)
    graph, landmarks = problem.graph(start, kept, noise)
    parameters = gtsam.LevenbergMarquardtParams()
    # Measured, 7 keyframes x 300 landmarks: three iterations take 13.8 ms; multifrontal 14.7 to 19.9.
    parameters.setLinearSolverType("SEQUENTIAL_CHOLESKY")
    parameters.setOrdering(landmarks_first(len(start.poses), landmarks))
    parameters.setMaxIterations(problem.settings.most_iterations)
    parameters.setRelativeErrorTol(_ROBUST_TOLERANCE)
    values = window_values(start, landmarks)
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    return window_state(solved, start, landmarks)


def _plain_round(
    problem: _Problem, state: WindowState, kept: BoolArray, noise: WindowNoise
) -> tuple[WindowState, gtsam.GaussianBayesTree, bool]:
    """Gauss-Newton by hand: its last factorisation is the covariance too, for which Marginals starts anew."""
    graph, landmarks = problem.graph(state, kept, noise)
    last = len(state.poses) - 1
    ordering = landmarks_first(last + 1, landmarks)
    values = window_values(state, landmarks)
    for _ in range(problem.settings.most_iterations):
        tree = graph.linearize(values).eliminateMultifrontal(ordering)
        step = tree.optimize()
        values = values.retract(step)
        motion = step.at(last)
        size = motion @ np.linalg.solve(tree.marginalCovariance(last), motion)
        if size < _SETTLED_SIGMAS**2:
            break
    return window_state(values, state, landmarks), tree, bool(size < _SETTLED_SIGMAS**2)


def _agreeing(problem: _Problem, state: WindowState, kept: BoolArray) -> BoolArray:
    """The sightings within the chi-square gate, by the spread that the residuals show themselves."""
    pixels, depths = problem.residuals(state)
    deep = np.isfinite(depths)
    left_over = problem.left_over(kept, len(state.poses))
    distance = (pixels**2).sum(axis=1) * left_over / _robust_scale(pixels[kept]) ** 2
    if (kept & deep).any():
        distance[deep] += depths[deep] ** 2 * left_over / _robust_scale(depths[kept & deep]) ** 2
    gates = chdtri(np.where(deep, 3, 2), 1.0 - problem.settings.inlier_probability)
    return kept & (distance < gates)


def _measured_noise(problem: _Problem, state: WindowState, kept: BoolArray) -> WindowNoise:
    """The noise by the residuals of the inliers, of pixels and of depths."""
    pixels, depths = problem.residuals(state)
    deep = kept & np.isfinite(depths)
    left_over = problem.left_over(kept, len(state.poses))
    pixel_scale = max(float(np.sqrt(np.mean(pixels[kept] ** 2) / left_over)), _LEAST_SCALE)
    depth_scale = 1.0
    if deep.any():
        depth_scale = max(float(np.sqrt(np.mean(depths[deep] ** 2) / left_over)), _LEAST_SCALE)
    return WindowNoise(pixel_scale, depth_scale * problem.settings.depth_sigma_at_1m)


def _robust_scale(residuals: FloatArray) -> float:
    """Standard deviation around zero by the median of the absolute values."""
    return max(_MAD_TO_SIGMA * float(np.median(np.abs(residuals))), _LEAST_SCALE)


def _relative_covariance(
    tree: gtsam.GaussianBayesTree, poses: tuple[gtsam.Pose3, ...], reference: int, last: int
) -> FloatArray:
    """(6, 6) of inverse(pose_reference) * pose_last in the last pose's frame."""
    joint = np.linalg.inv(tree.joint(reference, last).hessian()[0])
    back = poses[last].between(poses[reference]).AdjointMap()
    jacobian = np.hstack([-back, np.eye(6)])
    covariance: FloatArray = jacobian @ joint @ jacobian.T
    return 0.5 * (covariance + covariance.T)


def _check(
    poses: Sequence[gtsam.Pose3], observations: LandmarkObservations, steps: Sequence[PoseStep]
) -> None:
    """Refuse what GTSAM would take silently."""
    if len(poses) < 2:
        raise GraphError(f"a window of {len(poses)} keyframes: it takes two at least")
    if not all(np.isfinite(pose.matrix()).all() for pose in poses):
        raise GraphError("a pose of the window is not finite; check the odometry")
    observations.check(len(poses))
    for step in steps:
        name = f"step {step.source} -> {step.target}"
        if step.source == step.target or not {step.source, step.target} <= set(range(len(poses))):
            raise GraphError(f"{name}: it must join two of the keyframes 0..{len(poses) - 1}")
        if not np.isfinite(step.T_source_target.matrix()).all():
            raise GraphError(f"{name}: the motion is not finite")
        if step.covariance.shape != (6, 6) or not np.isfinite(step.covariance).all():
            raise GraphError(f"{name}: the covariance must be a finite (6, 6) matrix")
        if np.linalg.eigvalsh(step.covariance)[0] <= 0.0:
            raise GraphError(f"{name}: the covariance is not positive definite")
