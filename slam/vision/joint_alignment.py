"""Pose of a frame against keyframes: surfaces by point to plane and features by reprojection, together.

Either part may be empty: a bare wall is held by its texture, a dark room by its shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import gtsam
import numba
import numpy as np
from numpy.typing import NDArray

from slam.measurements import CameraIntrinsics, FloatArray
from slam.vision.surface import Surface, SurfacePoints

_LEAST_NORMAL_COSINE = 0.8  # two surfaces turned further apart are not the same
_NEAREST_M = 0.2
# Sigma over the median of residuals: of a distance along one axis, and of the root mean square of two.
_MEDIAN_TO_SIGMA_1D, _MEDIAN_TO_SIGMA_2D = 1.4826, 1.2011
_LEAST_CURVATURE = 1e-9  # of the normal equations, in shares of their trace
# Lengths of a step, radians and metres together: near enough to go on with all points, not worth another,
# and short enough that the pose is where it will stay.
_NEAR, _SETTLED, _SHORT = 2e-3, 1e-4, 1e-3
_THINNED = 4
_LEAST_READINGS = 12.0


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """How the least squares is done.

    Attributes
    ----------
    iterations
        Gauss-Newton steps at most.
    coarse_iterations
        The first of them, with everything four times as tolerant.
    kernel_sigmas
        Scale of the Geman-McClure kernel.
    gate_m
        A point this far off its partner has none; grows with the square of the depth beyond a metre.
    depth_floor_m, depth_share
        Sigma of a depth reading: floor + share z^2.
    correlated_points, correlated_features
        Neighbouring readings share an error: so many count as one. Infinite: they do not count at all.
    """

    iterations: int
    coarse_iterations: int
    kernel_sigmas: float
    gate_m: float
    depth_floor_m: float
    depth_share: float
    correlated_points: float
    correlated_features: float


class View(NamedTuple):
    """A keyframe's surface and where its camera stood, ``T_odom_camera``."""

    surface: Surface
    pose: gtsam.Pose3


class Landmarks(NamedTuple):
    """Matched features: (L, 3) points, odometry frame, (L, 2) pixels in the new image, (L,) their sigma."""

    points: FloatArray
    pixels: FloatArray
    sigma_px: FloatArray

    @classmethod
    def none(cls) -> Landmarks:
        """No features."""
        return cls(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))


@dataclass(frozen=True, slots=True)
class JointAlignment:
    """The outcome.

    Attributes
    ----------
    pose
        ``T_odom_camera``.
    information
        (6, 6) of the pose, GTSAM's order, camera frame, by the measured residuals and correlations.
    overlap
        Share of the points that meet a keyframe's surface.
    surface_inliers, feature_inliers
        Shares, 0..1, of the points that met a surface, and of the matched features, that agree.
    point_pairs, feature_pairs
        Points that met a surface, and matched features.
    point_count, feature_count
        Those of them that agree.
    residual_m
        Robust sigma of point to plane at the points that agree.
    residual_px
        Robust sigma of the reprojection of the features that agree.
    converged
        Whether the last step was small.
    """

    pose: gtsam.Pose3
    information: FloatArray
    overlap: float
    surface_inliers: float
    feature_inliers: float
    point_pairs: int
    feature_pairs: int
    point_count: int
    feature_count: int
    residual_m: float
    residual_px: float
    converged: bool


def align(
    points: SurfacePoints,
    views: list[View],
    landmarks: Landmarks,
    intrinsics: CameraIntrinsics,
    guess: gtsam.Pose3,
    settings: AlignmentSettings,
) -> JointAlignment:
    """Find ``T_odom_camera`` of a frame near a guess.

    Parameters
    ----------
    points
        The frame's surface points, camera frame.
    views
        Keyframes that may see the same.
    landmarks
        Features of the keyframes found again in the frame.
    intrinsics
        Of the pixels in ``landmarks``.
    """
    # A few points lead near; all of them are asked for the last millimetres.
    few = SurfacePoints(points.points[::_THINNED], points.normals[::_THINNED])
    coarse = _Work.of(few, landmarks)
    near, _ = _descend(coarse, views, intrinsics, guess, settings, settings.coarse_iterations, _NEAR, 4.0)
    fine = _Work.of(points, landmarks)
    rounds = settings.iterations - settings.coarse_iterations
    pose, converged = _descend(fine, views, intrinsics, near, settings, rounds, _SETTLED, 1.0)
    return fine.conclude(views, intrinsics, pose, settings, converged)


def _descend(
    work: _Work,
    views: list[View],
    intrinsics: CameraIntrinsics,
    pose: gtsam.Pose3,
    settings: AlignmentSettings,
    rounds: int,
    settled: float,
    slack: float,
) -> tuple[gtsam.Pose3, bool]:
    """Gauss-Newton until a step is shorter than ``settled``: the pose, and whether it came to rest."""
    length = np.inf
    for _ in range(rounds):
        hessian, gradient = work.linearize(views, intrinsics, pose, settings, slack)
        ridge = _LEAST_CURVATURE * float(np.trace(hessian))
        if ridge <= 0.0:
            return pose, False
        # Where nothing tells a direction, as along a bare wall, the pose stays there and moves elsewhere.
        step = np.linalg.solve(hessian + ridge * np.eye(6), gradient)
        length = float(np.linalg.norm(step))
        if length > 1.0:
            return pose, False
        pose = pose.compose(gtsam.Pose3.Expmap(step))
        if length < settled:
            break
    return pose, length < _SHORT


@dataclass(slots=True)
class _Work:
    """Residuals and information of either part at one linearisation, kept to be judged after the last."""

    points: SurfacePoints
    landmarks: Landmarks
    point_residuals: FloatArray
    seen: NDArray[np.uint8]
    feature_residuals: FloatArray
    information: tuple[FloatArray, FloatArray]

    @classmethod
    def of(cls, points: SurfacePoints, landmarks: Landmarks) -> _Work:
        count = len(points)
        zeros = np.zeros((6, 6))
        return cls(
            points,
            landmarks,
            np.full(count, np.inf),
            np.zeros(count, np.uint8),
            np.full(len(landmarks.points), np.inf),
            (zeros, zeros),
        )

    def linearize(
        self,
        views: list[View],
        k: CameraIntrinsics,
        pose: gtsam.Pose3,
        settings: AlignmentSettings,
        slack: float,
    ) -> tuple[FloatArray, FloatArray]:
        """Normal equations (6, 6), (6,) of both parts, weighted by their correlations."""
        self.seen[:] = 0
        self.point_residuals[:] = np.inf
        depth_h, depth_g, depth_i = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6))
        for surface, view_pose in views:
            c = surface.intrinsics
            _surface_part(
                self.points.points,
                self.points.normals,
                view_pose.between(pose).matrix(),
                surface.inverse_depth,
                surface.normals,
                (c.fx, c.fy, c.cx, c.cy),
                settings.gate_m * slack,
                settings.kernel_sigmas * slack,
                settings.depth_floor_m,
                settings.depth_share,
                depth_h,
                depth_g,
                depth_i,
                self.seen,
                self.point_residuals,
            )
        feature_h, feature_g = np.zeros((6, 6)), np.zeros(6)
        _feature_part(
            self.landmarks.points,
            self.landmarks.pixels,
            self.landmarks.sigma_px,
            pose.inverse().matrix(),
            (k.fx, k.fy, k.cx, k.cy),
            settings.kernel_sigmas * slack,
            feature_h,
            feature_g,
            self.feature_residuals,
        )
        self.information = (0.5 * (depth_i + depth_i.T), feature_h)
        hessian = depth_h / settings.correlated_points + feature_h / settings.correlated_features
        gradient = depth_g / settings.correlated_points + feature_g / settings.correlated_features
        return hessian, gradient

    def conclude(
        self,
        views: list[View],
        k: CameraIntrinsics,
        pose: gtsam.Pose3,
        settings: AlignmentSettings,
        converged: bool,
    ) -> JointAlignment:
        """Judge the residuals at the last pose."""
        self.linearize(views, k, pose, settings, 1.0)
        seen = self.seen > 0
        agreeing = self.point_residuals[self.point_residuals < settings.kernel_sigmas]
        matched = self.feature_residuals[self.feature_residuals < settings.kernel_sigmas]
        point_scale = _robust_scale(agreeing, _MEDIAN_TO_SIGMA_1D)
        feature_scale = _robust_scale(matched, _MEDIAN_TO_SIGMA_2D)
        information = self.information[0] / (settings.correlated_points * point_scale**2)
        information += self.information[1] / (settings.correlated_features * feature_scale**2)
        depth = np.median(self.points.points[:, 2]) if len(self.points) else 1.0
        sigma_m = settings.depth_floor_m + settings.depth_share * depth**2
        return JointAlignment(
            pose=pose,
            information=information,
            overlap=float(seen.mean()) if seen.size else 0.0,
            surface_inliers=agreeing.size / max(int(seen.sum()), 1),
            feature_inliers=matched.size / max(self.feature_residuals.size, 1),
            point_pairs=int(seen.sum()),
            feature_pairs=int(self.feature_residuals.size),
            point_count=int(agreeing.size),
            feature_count=int(matched.size),
            residual_m=float(point_scale * sigma_m),
            residual_px=float(feature_scale * np.median(self.landmarks.sigma_px)) if matched.size else 0.0,
            converged=converged,
        )


def _robust_scale(residuals: FloatArray, median_to_sigma: float) -> float:
    """Sigma of normalised residuals; 1 where there are too few to tell."""
    if residuals.size < _LEAST_READINGS:
        return 1.0
    return max(float(median_to_sigma * np.median(residuals)), 0.1)


@numba.njit(cache=True, nogil=True)
def _surface_part(
    points: NDArray[Any],
    normals: NDArray[Any],
    T: NDArray[Any],
    inverse_depth: NDArray[Any],
    surface_normals: NDArray[Any],
    camera: tuple[float, float, float, float],
    gate_m: float,
    kernel: float,
    depth_floor_m: float,
    depth_share: float,
    hessian: NDArray[Any],
    gradient: NDArray[Any],
    information: NDArray[Any],
    seen: NDArray[Any],
    residuals: NDArray[Any],
) -> None:
    """Add the point-to-plane terms of one view; ``T`` maps the frame into the view.

    ``hessian`` squares the view's noisy normals, and so a flat wall seems to tell motion along itself. The
    product of both surfaces' normals, whose noise is independent, does not: that is the ``information``.
    """
    fx, fy, cx, cy = camera
    height, width = inverse_depth.shape
    jacobian = np.empty(6)
    twin = np.empty(6)
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if z < _NEAREST_M:
            continue
        u = int(np.floor(fx * x / z + cx + 0.5))
        v = int(np.floor(fy * y / z + cy + 0.5))
        if u < 0 or v < 0 or u >= width or v >= height or inverse_depth[v, u] <= 0.0:
            continue
        seen[i] = 1
        nx, ny, nz = surface_normals[v, u, 0], surface_normals[v, u, 1], surface_normals[v, u, 2]
        # The view's normal, seen from the frame.
        mx = T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz
        my = T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz
        mz = T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz
        if mx * normals[i, 0] + my * normals[i, 1] + mz * normals[i, 2] < _LEAST_NORMAL_COSINE:
            continue
        qz = 1.0 / inverse_depth[v, u]
        if abs(z - qz) > gate_m * max(1.0, z * z) * 2.0:
            continue
        r = nx * (x - (u - cx) / fx * qz) + ny * (y - (v - cy) / fy * qz) + nz * (z - qz)
        sigma = depth_floor_m + depth_share * z * z
        normalised = abs(r) / sigma
        residuals[i] = min(residuals[i], normalised)
        weight = 1.0 / (1.0 + (normalised / kernel) ** 2)
        weight = weight * weight / (sigma * sigma)
        jacobian[0] = py * mz - pz * my
        jacobian[1] = pz * mx - px * mz
        jacobian[2] = px * my - py * mx
        jacobian[3] = mx
        jacobian[4] = my
        jacobian[5] = mz
        twin[0] = py * normals[i, 2] - pz * normals[i, 1]
        twin[1] = pz * normals[i, 0] - px * normals[i, 2]
        twin[2] = px * normals[i, 1] - py * normals[i, 0]
        twin[3] = normals[i, 0]
        twin[4] = normals[i, 1]
        twin[5] = normals[i, 2]
        for a in range(6):
            gradient[a] -= weight * jacobian[a] * r
            for b in range(6):
                hessian[a, b] += weight * jacobian[a] * jacobian[b]
                information[a, b] += weight * jacobian[a] * twin[b]


@numba.njit(cache=True, nogil=True)
def _feature_part(
    points: NDArray[Any],
    pixels: NDArray[Any],
    sigma_px: NDArray[Any],
    T: NDArray[Any],
    camera: tuple[float, float, float, float],
    kernel: float,
    hessian: NDArray[Any],
    gradient: NDArray[Any],
    residuals: NDArray[Any],
) -> None:
    """Add the reprojection terms, Yang2021 Eq. (5); ``T`` maps the odometry frame into the camera."""
    fx, fy, cx, cy = camera
    du = np.empty(6)
    dv = np.empty(6)
    for i in range(points.shape[0]):
        x = T[0, 0] * points[i, 0] + T[0, 1] * points[i, 1] + T[0, 2] * points[i, 2] + T[0, 3]
        y = T[1, 0] * points[i, 0] + T[1, 1] * points[i, 1] + T[1, 2] * points[i, 2] + T[1, 3]
        z = T[2, 0] * points[i, 0] + T[2, 1] * points[i, 1] + T[2, 2] * points[i, 2] + T[2, 3]
        residuals[i] = np.inf
        if z < _NEAREST_M:
            continue
        eu = fx * x / z + cx - pixels[i, 0]
        ev = fy * y / z + cy - pixels[i, 1]
        normalised = np.sqrt(0.5 * (eu * eu + ev * ev)) / sigma_px[i]
        residuals[i] = normalised
        weight = 1.0 / (1.0 + (normalised / kernel) ** 2)
        weight = weight * weight / (sigma_px[i] * sigma_px[i])
        # Moving the camera by (w, v) moves the point by -w x p - v.
        gx = fx / z
        gy = fy / z
        hx = -fx * x / (z * z)
        hy = -fy * y / (z * z)
        du[0] = hx * -y
        du[1] = gx * -z + hx * x
        du[2] = gx * y
        du[3] = -gx
        du[4] = 0.0
        du[5] = -hx
        dv[0] = gy * z + hy * -y
        dv[1] = hy * x
        dv[2] = gy * -x
        dv[3] = 0.0
        dv[4] = -gy
        dv[5] = -hy
        for a in range(6):
            gradient[a] -= weight * (du[a] * eu + dv[a] * ev)
            for b in range(6):
                hessian[a, b] += weight * (du[a] * du[b] + dv[a] * dv[b])
