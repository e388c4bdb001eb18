"""GTSAM's factors of one window of keyframes and landmarks (Yang2021 Eq. (7)-(12)).

Beside ``pose_graph`` this file builds factors too: its graph lives for one adjustment only. A sighting
with depth becomes a stereo factor of a virtual baseline b: the noise of the disparity f b / z does not depend
on z, as with structured light and stereo cameras (Khoshelham 2012, Eq. (6)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.graph.landmarks import LandmarkObservations
from slam.measurements import CameraIntrinsics, FloatArray

# Any length will do: it scales the disparity and its noise alike.
_VIRTUAL_BASELINE_M = 0.1
# The first pose is the gauge, not a measurement.
_GAUGE_SIGMA = 1e-6


@dataclass(frozen=True, slots=True)
class PoseStep:
    """A measured motion between two keyframes of the window, from an odometry.

    Attributes
    ----------
    source, target
        Positions in the window.
    T_source_target
        Pose of the target's camera in the source's.
    covariance
        (6, 6) in GTSAM's order, rotation first, in the target's frame.
    """

    source: int
    target: int
    T_source_target: gtsam.Pose3
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class WindowState:
    """Poses ``T_odom_camera`` (K), and points (L, 3) in the odom frame."""

    poses: tuple[gtsam.Pose3, ...]
    points: FloatArray


@dataclass(frozen=True, slots=True)
class WindowNoise:
    """Noise of the sightings: a factor on their ``sigma_px``, the depth's sigma at 1 m, a robust kernel."""

    pixel_scale: float
    depth_sigma_at_1m: float
    kernel: gtsam.noiseModel.mEstimator.Base | None = None

    def model(self, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
        """The noise under the kernel."""
        return noise if self.kernel is None else gtsam.noiseModel.Robust.Create(self.kernel, noise)


def window_graph(
    origin: gtsam.Pose3,
    first_point: int,
    steps: Sequence[PoseStep],
    seen: LandmarkObservations,
    intrinsics: CameraIntrinsics,
    noise: WindowNoise,
) -> gtsam.NonlinearFactorGraph:
    """Gauge, steps and sightings.

    Parameters
    ----------
    origin
        Pose of keyframe 0, held.
    first_point
        Key of landmark 0; the poses have the keys below.
    """
    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.PriorFactorPose3(0, origin, gtsam.noiseModel.Isotropic.Sigma(6, _GAUGE_SIGMA)))
    for step in steps:
        between = gtsam.noiseModel.Gaussian.Covariance(step.covariance)
        graph.add(gtsam.BetweenFactorPose3(step.source, step.target, step.T_source_target, between))
    deep = seen.depth_m > 0.0
    _add_stereo(graph, first_point, seen.where(deep), intrinsics, noise)
    _add_projections(graph, first_point, seen.where(~deep), intrinsics, noise)
    return graph


def window_values(state: WindowState, landmarks: Sequence[int]) -> gtsam.Values:
    """Start of the poses and of the landmarks that are seen."""
    values = gtsam.Values()
    for key, pose in enumerate(state.poses):
        values.insert(key, pose)
    for landmark in landmarks:
        values.insert(len(state.poses) + landmark, state.points[landmark])
    return values


def window_state(values: gtsam.Values, before: WindowState, landmarks: Sequence[int]) -> WindowState:
    """The solved state; landmarks that were not in the graph stay."""
    count = len(before.poses)
    points = before.points.copy()
    for landmark in landmarks:
        points[landmark] = values.atPoint3(count + landmark)
    # The gauge's sigma lets the first pose move by a rounding error.
    return WindowState((before.poses[0], *(values.atPose3(k) for k in range(1, count))), points)


def landmarks_first(pose_count: int, landmarks: Sequence[int]) -> gtsam.Ordering:
    """Elimination order of the Schur complement: a landmark touches poses only."""
    ordering = gtsam.Ordering()
    for landmark in landmarks:
        ordering.push_back(pose_count + landmark)
    for pose in range(pose_count):
        ordering.push_back(pose)
    return ordering


def _add_stereo(
    graph: gtsam.NonlinearFactorGraph,
    first_point: int,
    seen: LandmarkObservations,
    camera: CameraIntrinsics,
    noise: WindowNoise,
) -> None:
    """Sightings with depth as (left column, right column, row) of a virtual stereo camera."""
    calibration = gtsam.Cal3_S2Stereo(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, _VIRTUAL_BASELINE_M)
    # Khoshelham 2012 Eq. (6): sigma_z = z^2 / (f b) sigma_disparity.
    depth_to_disparity = camera.fx * _VIRTUAL_BASELINE_M
    disparity_variance = (depth_to_disparity * noise.depth_sigma_at_1m) ** 2
    models = {}
    for sigma in np.unique(seen.sigma_px).tolist():
        variance = (noise.pixel_scale * sigma) ** 2
        covariance = np.array([[variance, variance, 0.0], [variance, variance, 0.0], [0.0, 0.0, variance]])
        # The right column is the left one less the disparity.
        covariance[1, 1] += disparity_variance
        models[sigma] = noise.model(gtsam.noiseModel.Gaussian.Covariance(covariance))
    left, row = seen.pixels.T.tolist()
    right = (seen.pixels[:, 0] - depth_to_disparity / seen.depth_m).tolist()
    for u, u_right, v, (pose, point, sigma) in zip(left, right, row, _names(seen, first_point), strict=True):
        measured = gtsam.StereoPoint2(u, u_right, v)
        graph.add(gtsam.GenericStereoFactor3D(measured, models[sigma], pose, point, calibration))


def _add_projections(
    graph: gtsam.NonlinearFactorGraph,
    first_point: int,
    seen: LandmarkObservations,
    camera: CameraIntrinsics,
    noise: WindowNoise,
) -> None:
    """Sightings without depth, Yang2021 Eq. (8)."""
    calibration = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
    models = {
        sigma: noise.model(gtsam.noiseModel.Isotropic.Sigma(2, noise.pixel_scale * sigma))
        for sigma in np.unique(seen.sigma_px).tolist()
    }
    for pixel, (pose, point, sigma) in zip(seen.pixels, _names(seen, first_point), strict=True):
        graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, models[sigma], pose, point, calibration))


def _names(seen: LandmarkObservations, first_point: int) -> list[tuple[int, int, float]]:
    """Pose key, landmark key and sigma of every sighting, as Python numbers."""
    points = (seen.landmark + first_point).tolist()
    return list(zip(seen.keyframe.tolist(), points, seen.sigma_px.tolist(), strict=True))
