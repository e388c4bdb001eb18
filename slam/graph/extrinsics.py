"""Pose of a camera on the robot from the motions of both (hand-eye calibration, Tsai 1989).

``hand_eye`` finds the mounting and the outliers; then the mounting is a variable of a GTSAM graph, connected
to two base poses by each camera step. Besides ``pose_graph``, this file also builds GTSAM factors. Degrees of
freedom that the motions do not determine are reported: a planar robot never determines the camera's height.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from fusion.curves import FORWARD
from fusion.estimation import SETTLED
from slam.errors import GraphError
from slam.graph.edge import check_motion, check_pose
from slam.graph.hand_eye import Fit, Motions, refine, search
from slam.measurements import IN_PLANE, BoolArray, FloatArray, Pose

# GTSAM's order, base frame.
_NAMES = ("roll", "pitch", "yaw", "x", "y", "height")
# A direction of the mounting (radians, metres; base frame) with a larger sigma is called unobservable.
_VAGUE = np.repeat([0.09, 0.1], 3)
# Sigma of undetermined directions, in units of the vague sigmas.
_UNKNOWN = 100.0
# An axis is called unobservable if this share of it is in the undetermined subspace.
_UNTOLD_SHARE = 0.05
_SETTLED = 0.01


@dataclass(frozen=True, slots=True)
class MotionPair:
    """Motions of base and camera over the same time.

    Attributes
    ----------
    base_step
        Pose of the base at the end in the base frame at the start; Pose2 of a planar robot, or Pose3.
    base_covariance
        (d, d) in GTSAM's order, in the frame at the end.
    camera_step
        Pose of the camera's optical frame at the end in the one at the start.
    camera_covariance
        (6, 6) in the frame at the end.
    """

    base_step: Pose
    base_covariance: FloatArray
    camera_step: gtsam.Pose3
    camera_covariance: FloatArray


@dataclass(frozen=True, slots=True)
class ExtrinsicsResult:
    """The mounting and its uncertainty.

    Attributes
    ----------
    T_base_camera
        Unobservable directions keep the start values; without a start, those of a forward-looking camera at
        the base origin.
    covariance
        (6, 6) in GTSAM's order, in the camera's frame; unobservable directions have a hundred times the vague
        sigma.
    unobservable
        Among roll, pitch, yaw, x, y, height in the base frame; ``("all",)`` if nothing is reported.
    inliers
        (N,) pairs that agree.
    inlier_share
        Their share, 0 without a pair.
    converged
        Whether the iteration converged to a reported result.
    """

    T_base_camera: gtsam.Pose3
    covariance: FloatArray
    unobservable: tuple[str, ...]
    inliers: BoolArray
    inlier_share: float
    converged: bool


def estimate_extrinsics(pairs: Sequence[MotionPair], start: gtsam.Pose3 | None = None) -> ExtrinsicsResult:
    """``T_base_camera`` from paired motions.

    Parameters
    ----------
    pairs
        All planar or all spatial; a third of them may be false. Steps should turn by more than their noise.
    start
        Assumed ``T_base_camera``; it may be wrong or missing.

    Raises
    ------
    GraphError
        If a pair is not finite, its covariance is not positive definite, or planar and spatial are mixed.
    """
    _check(pairs, start)
    nominal = start or gtsam.Pose3(gtsam.Rot3(FORWARD), np.zeros(3))
    if not pairs:
        axes = _base_axes(nominal)
        covariance = axes.T @ np.diag((_UNKNOWN * _VAGUE) ** 2) @ axes
        nothing = np.zeros(0, np.bool_)
        return ExtrinsicsResult(nominal, covariance, ("all",), nothing, 0.0, converged=False)
    motions = _motions(pairs)
    rough = search(motions, nominal.rotation().matrix(), nominal.translation())
    fit = refine(motions, *rough)
    untold = _untold_space(fit)
    mount = _restored(fit, nominal, untold)
    agreeing = [pair for pair, keep in zip(pairs, fit.inliers, strict=True) if keep]
    # Held directions keep their values; covariances in the base frame, scaled by the vague sigmas.
    holding = (10 * SETTLED) ** 2 * untold + _UNKNOWN**2 * (np.eye(6) - untold)
    mount, covariance = _solve_graph(agreeing, mount, _from_base(mount, holding), fit.scale)
    covariance = covariance + _from_base(mount, _UNKNOWN**2 * untold)
    return _result(fit, mount, covariance, untold)


def camera_step_factor(
    keys: tuple[int, int, int], camera_step: gtsam.Pose3, noise: gtsam.noiseModel.Base, planar: bool
) -> gtsam.CustomFactor:
    """Return a camera step as a factor of two base poses and the mounting.

    Error: Log(inverse(camera_step) inverse(X) inverse(pose_i) pose_j X), in the frame at the step's end.

    Parameters
    ----------
    keys
        Of pose_i, pose_j (Pose2 where planar, else Pose3) and X = ``T_base_camera`` (Pose3).
    noise
        Of the camera step, six dimensions; in 2D it should include the base's tilt and heave.
    """
    return gtsam.CustomFactor(noise, list(keys), _step_error(camera_step.inverse(), planar))


def _step_error(
    to_camera: gtsam.Pose3, planar: bool
) -> Callable[[gtsam.CustomFactor, gtsam.Values, list[FloatArray] | None], FloatArray]:
    """Return the error and Jacobians of a camera step, perturbations on the right."""

    def error(
        factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
    ) -> FloatArray:
        key_i, key_j, key_mount = factor.keys()
        mount = values.atPose3(key_mount)
        pose_at: Any = values.atPose2 if planar else values.atPose3
        step: Any = pose_at(key_i).between(pose_at(key_j))
        spatial = gtsam.Pose3(step)
        to_mount = mount.inverse()
        predicted = to_mount.compose(spatial).compose(mount)
        twist: FloatArray = gtsam.Pose3.Logmap(to_camera.compose(predicted))
        if jacobians is not None:
            by_step = gtsam.Pose3.LogmapDerivative(twist)
            by_end = by_step @ to_mount.AdjointMap() @ (np.eye(6)[:, IN_PLANE] if planar else np.eye(6))
            jacobians[0] = -by_end @ step.inverse().AdjointMap()
            jacobians[1] = by_end
            jacobians[2] = by_step @ (np.eye(6) - predicted.inverse().AdjointMap())
        return twist

    return error


def _solve_graph(
    pairs: Sequence[MotionPair],
    mount: gtsam.Pose3,
    holding: FloatArray,
    scale: float,
) -> tuple[gtsam.Pose3, FloatArray]:
    """Solve for base poses chained by base steps and the mounting; return the mounting and its covariance.

    Only the steps matter, so consecutive pairs in the chain need not be consecutive in time.
    """
    planar = isinstance(pairs[0].base_step, gtsam.Pose2)
    # Pose2 and Pose3 alike.
    pose: Any = gtsam.Pose2() if planar else gtsam.Pose3()
    between: Any = gtsam.BetweenFactorPose2 if planar else gtsam.BetweenFactorPose3
    prior = gtsam.PriorFactorPose2 if planar else gtsam.PriorFactorPose3
    mount_key = len(pairs) + 1
    back = mount.inverse().AdjointMap()
    swing = back @ _out_of_plane() @ back.T if planar else np.zeros((6, 6))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(prior(0, pose, gtsam.noiseModel.Isotropic.Sigma(3 if planar else 6, SETTLED)))
    graph.add(gtsam.PriorFactorPose3(mount_key, mount, gtsam.noiseModel.Gaussian.Covariance(holding)))
    values.insert(mount_key, mount)
    values.insert(0, pose)
    for k, pair in enumerate(pairs):
        pose = pose.compose(pair.base_step)
        values.insert(k + 1, pose)
        noise = gtsam.noiseModel.Gaussian.Covariance(scale**2 * pair.base_covariance)
        graph.add(between(k, k + 1, pair.base_step, noise))
        noise = gtsam.noiseModel.Gaussian.Covariance(scale**2 * (pair.camera_covariance + swing))
        graph.add(camera_step_factor((k, k + 1, mount_key), pair.camera_step, noise, planar))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return solved.atPose3(mount_key), gtsam.Marginals(graph, solved).marginalCovariance(mount_key)


def _untold_space(fit: Fit) -> FloatArray:
    """Return (6, 6) the projector on undetermined directions; base frame, scaled by the vague sigmas."""
    axes = _base_axes(gtsam.Pose3(gtsam.Rot3(fit.R), fit.t))
    information = np.outer(_VAGUE, _VAGUE) * (axes @ fit.information @ axes.T) / fit.scale**2
    strengths, directions = np.linalg.eigh(information)
    weak = directions[:, strengths < 1.0]
    return np.asarray(weak @ weak.T, dtype=np.float64)


def _restored(fit: Fit, nominal: gtsam.Pose3, untold: FloatArray) -> gtsam.Pose3:
    """Return the fitted mounting, with the nominal values in undetermined directions."""
    rotation = gtsam.Rot3(fit.R)
    turn = gtsam.Rot3.Logmap(nominal.rotation().compose(rotation.inverse()))
    offset = np.concatenate([turn, nominal.translation() - fit.t])
    offset = _VAGUE * (untold @ (offset / _VAGUE))
    return gtsam.Pose3(gtsam.Rot3.Expmap(offset[:3]).compose(rotation), fit.t + offset[3:])


def _from_base(mount: gtsam.Pose3, covariance: FloatArray) -> FloatArray:
    """Return (6, 6) in the camera frame for a covariance over scaled axes of the base."""
    axes = _base_axes(mount)
    turned: FloatArray = axes.T @ (np.outer(_VAGUE, _VAGUE) * covariance) @ axes
    return turned


def _result(fit: Fit, mount: gtsam.Pose3, covariance: FloatArray, untold: FloatArray) -> ExtrinsicsResult:
    """Return the result with its unobservable directions and covariance."""
    unobservable = np.diag(untold) > _UNTOLD_SHARE
    last_step = _base_axes(mount) @ fit.last_step / _VAGUE
    settled = np.abs(last_step - untold @ last_step).max() < _SETTLED
    return ExtrinsicsResult(
        T_base_camera=mount,
        covariance=0.5 * (covariance + covariance.T),
        unobservable=("all",) if unobservable.all() else tuple(np.array(_NAMES)[unobservable].tolist()),
        inliers=fit.inliers,
        inlier_share=float(fit.inliers.mean()),
        converged=bool(settled and not unobservable.all()),
    )


def _base_axes(mount: gtsam.Pose3) -> FloatArray:
    """Return (6, 6) that rotates a twist of the mounting from the camera frame to the axes of the base."""
    return np.asarray(np.kron(np.eye(2), mount.rotation().matrix()), dtype=np.float64)


def _out_of_plane() -> FloatArray:
    """Return (6, 6) the noise of a step out of the plane: a planar robot tilts and heaves by these sigmas."""
    return np.diag(np.square([0.002, 0.002, 0.0, 0.0, 0.0, 0.002]))


def _motions(pairs: Sequence[MotionPair]) -> Motions:
    """Return the pairs as arrays, planar steps lifted to 3D."""
    base, base_covariances = [], []
    for pair in pairs:
        if isinstance(pair.base_step, gtsam.Pose2):
            base.append(gtsam.Pose3(pair.base_step).matrix())
            lift = np.eye(6)[:, IN_PLANE]
            base_covariances.append(lift @ pair.base_covariance @ lift.T + _out_of_plane())
        else:
            base.append(pair.base_step.matrix())
            base_covariances.append(pair.base_covariance)
    bases = np.stack(base)
    cameras = np.stack([pair.camera_step.matrix() for pair in pairs])
    return Motions(
        bases[:, :3, :3],
        bases[:, :3, 3],
        np.stack(base_covariances),
        cameras[:, :3, :3],
        cameras[:, :3, 3],
        np.stack([pair.camera_covariance for pair in pairs]),
    )


def _check(pairs: Sequence[MotionPair], start: gtsam.Pose3 | None) -> None:
    """Raise an error for input that GTSAM would accept silently."""
    if start is not None:
        check_pose(start, 6)
    if len({isinstance(pair.base_step, gtsam.Pose2) for pair in pairs}) > 1:
        raise GraphError("motion pairs mix planar and spatial base steps; give one kind")
    for k, pair in enumerate(pairs):
        size = 3 if isinstance(pair.base_step, gtsam.Pose2) else 6
        check_motion(f"motion pair {k}: the base", pair.base_step, pair.base_covariance, size)
        check_motion(f"motion pair {k}: the camera", pair.camera_step, pair.camera_covariance, 6)
