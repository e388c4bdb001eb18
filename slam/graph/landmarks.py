"""Landmarks seen from several keyframes: where they start, and how well they are met (Yang2021 Eq. (7)-(10)).

Arrays in, arrays out; ``bundle_adjustment`` builds the factors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.errors import GraphError
from slam.measurements import BoolArray, CameraIntrinsics, FloatArray

IntArray: TypeAlias = NDArray[np.integer]

# Rays closer to parallel than this about their mean tell no depth: pixel noise parts them as far.
_LEAST_PARALLAX_RAD = 0.02
# A point nearer to the image plane than this has no projection.
_NEAREST_M = 0.05
# Whitened residual of such a point: no gate lets it pass.
_FAR_OFF = 1e6


@dataclass(frozen=True, slots=True)
class LandmarkObservations:
    """What the keyframes of a window see of the landmarks, one row a sighting.

    Attributes
    ----------
    keyframe, landmark
        (M,) position in the window's list of poses, and any number that names the landmark.
    pixels
        (M, 2) column and row.
    depth_m
        (M,) along the optical axis, 0 where there is no reading.
    sigma_px
        (M,) standard deviation of a pixel coordinate.
    """

    keyframe: IntArray
    landmark: IntArray
    pixels: FloatArray
    depth_m: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return int(self.depth_m.size)

    def where(self, keep: BoolArray) -> LandmarkObservations:
        """The sightings that a mask (M,) keeps."""
        return LandmarkObservations(
            self.keyframe[keep],
            self.landmark[keep],
            self.pixels[keep],
            self.depth_m[keep],
            self.sigma_px[keep],
        )

    def renumbered(self) -> LandmarkObservations:
        """The same with landmarks 0..L-1, in the order of their numbers."""
        numbers = np.unique(self.landmark, return_inverse=True)[1]
        return LandmarkObservations(self.keyframe, numbers, self.pixels, self.depth_m, self.sigma_px)

    def check(self, keyframe_count: int) -> None:
        """Refuse what cannot enter a graph.

        Raises
        ------
        GraphError
            Where the sizes differ, a number is not finite, a sigma not positive, a depth negative, or a
            keyframe not in the window.
        """
        count = len(self)
        shapes = {self.keyframe.shape, self.landmark.shape, self.sigma_px.shape, self.depth_m.shape}
        if shapes != {(count,)} or self.pixels.shape != (count, 2):
            raise GraphError(f"sightings of {count} depths: every array needs one row a sighting")
        numbers = np.column_stack([self.pixels, self.depth_m, self.sigma_px])
        if not np.isfinite(numbers).all():
            raise GraphError("a sighting is not finite; a missing depth is 0")
        if (self.depth_m < 0.0).any() or (self.sigma_px <= 0.0).any():
            raise GraphError("a sighting has a negative depth or a sigma that is not positive")
        if count and not (self.keyframe.min() >= 0 and self.keyframe.max() < keyframe_count):
            raise GraphError(f"a sighting is not from one of the keyframes 0..{keyframe_count - 1}")


def tracked(observations: LandmarkObservations, candidates: BoolArray, most_landmarks: int) -> BoolArray:
    """Which sightings belong to the landmarks seen from the most keyframes, two at least.

    Parameters
    ----------
    candidates
        (M,) sightings that may count.
    most_landmarks
        Ties are broken by the landmark's number.

    Returns
    -------
    (M,) a part of the candidates.
    """
    seen = np.unique(np.column_stack([observations.landmark, observations.keyframe])[candidates], axis=0)
    names, keyframes = np.unique(seen[:, 0], return_counts=True)
    order = np.argsort(-keyframes, kind="stable")[:most_landmarks]
    return candidates & np.isin(observations.landmark, names[order[keyframes[order] >= 2]])


def starting_points(
    observations: LandmarkObservations, poses: Sequence[gtsam.Pose3], intrinsics: CameraIntrinsics
) -> tuple[FloatArray, BoolArray]:
    """Where landmarks 0..L-1 are, by the poses as they stand.

    The median of the back-projected depths (Yang2021 Eq. (14)); where no keyframe has a depth, the point
    nearest to all rays.

    Parameters
    ----------
    observations
        Landmarks numbered without a gap.
    poses
        ``T_odom_camera`` of the window's keyframes.

    Returns
    -------
    (L, 3) in the odom frame, and (L,) whether depth or parallax tells the position.
    """
    rotations, centres = _stacked(poses)
    focal = np.array([intrinsics.fx, intrinsics.fy])
    sides = (observations.pixels - np.array([intrinsics.cx, intrinsics.cy])) / focal
    rays_camera = np.column_stack([sides, np.ones(len(observations))])
    rays = np.einsum("mij,mj->mi", rotations[observations.keyframe], rays_camera)
    origins = centres[observations.keyframe]
    landmarks = observations.landmark
    projectors, normal = _ray_projectors(rays, landmarks, int(landmarks.max()) + 1)
    right = np.zeros(normal.shape[:2])
    np.add.at(right, landmarks, np.einsum("mij,mj->mi", projectors, origins))
    known = _has_parallax(normal)
    points = np.zeros_like(right)
    points[known] = np.linalg.solve(normal[known], right[known][:, :, None])[:, :, 0]
    deep = observations.depth_m > 0.0
    with_depth = np.unique(landmarks[deep])
    measured = (origins + observations.depth_m[:, None] * rays)[deep]
    points[with_depth] = _group_medians(measured, landmarks[deep])
    known[with_depth] = True
    return points, known


def well_placed(
    observations: LandmarkObservations, poses: Sequence[gtsam.Pose3], points_odom: FloatArray
) -> BoolArray:
    """Whether a depth, or the parallax at the solved position, tells where a landmark is, (L,).

    Rays that met by their noise alone part in the solution: the point moves out of sight.
    """
    _, centres = _stacked(poses)
    rays = points_odom[observations.landmark] - centres[observations.keyframe]
    _, normal = _ray_projectors(rays, observations.landmark, len(points_odom))
    placed = _has_parallax(normal)
    placed[observations.landmark[observations.depth_m > 0.0]] = True
    return placed


def whitened_residuals(
    observations: LandmarkObservations,
    poses: Sequence[gtsam.Pose3],
    points_odom: FloatArray,
    intrinsics: CameraIntrinsics,
    depth_sigma_at_1m: float,
) -> tuple[FloatArray, FloatArray]:
    """Measured less predicted, in standard deviations (Yang2021 Eq. (8), with the depth as a third row).

    Depth is compared as its inverse, whose noise does not depend on the distance.

    Parameters
    ----------
    points_odom
        (L, 3) of landmarks 0..L-1.

    Returns
    -------
    (M, 2) of the pixels, and (M,) of the inverse depth, NaN where there is no depth.
    """
    rotations, centres = _stacked(poses)
    offsets = points_odom[observations.landmark] - centres[observations.keyframe]
    points_camera = np.einsum("mji,mj->mi", rotations[observations.keyframe], offsets)
    ahead = points_camera[:, 2] > _NEAREST_M
    z = np.where(ahead, points_camera[:, 2], np.inf)[:, None]
    focal = np.array([intrinsics.fx, intrinsics.fy])
    # Yang2021 Eq. (13): projection.
    predicted = focal * points_camera[:, :2] / z + np.array([intrinsics.cx, intrinsics.cy])
    pixels = (observations.pixels - predicted) / observations.sigma_px[:, None]
    pixels[~ahead] = _FAR_OFF
    depth = np.full(len(observations), np.nan)
    deep = observations.depth_m > 0.0
    depth[deep] = (1.0 / observations.depth_m[deep] - 1.0 / z[deep, 0]) / depth_sigma_at_1m
    return pixels, depth


def _stacked(poses: Sequence[gtsam.Pose3]) -> tuple[FloatArray, FloatArray]:
    """Rotations (K, 3, 3) and positions (K, 3)."""
    matrices = np.stack([pose.matrix() for pose in poses])
    return matrices[:, :3, :3], matrices[:, :3, 3]


def _ray_projectors(rays: FloatArray, landmarks: IntArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Projectors (M, 3, 3) across the rays, and their sum a landmark (L, 3, 3)."""
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    projectors = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal = np.zeros((count, 3, 3))
    np.add.at(normal, landmarks, projectors)
    return projectors, normal


def _has_parallax(normal: FloatArray) -> BoolArray:
    """Whether the rays differ in direction; of n projectors the trace is 2 n."""
    sightings = np.maximum(0.5 * np.trace(normal, axis1=1, axis2=2), 1.0)
    wide: BoolArray = np.linalg.eigvalsh(normal)[:, 0] > sightings * _LEAST_PARALLAX_RAD**2
    return wide


def _group_medians(values: FloatArray, groups: IntArray) -> FloatArray:
    """(G, D) lower median of every coordinate of every group, the groups in rising order."""
    _, sizes = np.unique(groups, return_counts=True)
    middle = np.cumsum(sizes) - sizes + (sizes - 1) // 2
    return np.column_stack([column[np.lexsort((column, groups))][middle] for column in values.T])
