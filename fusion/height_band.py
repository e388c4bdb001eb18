"""Obstacles in a depth image from the robot's geometry, without a ground fit: Yang2021 Eq. (13)-(20)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.checks import numbers
from fusion.curves import Intrinsics
from fusion.kernel import kernel
from fusion.voxel_hash import first_in_voxels, table_for

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class HeightBand:
    """Range of heights in which an object stops the robot, Yang2021 Eq. (17)-(18).

    Attributes
    ----------
    base_height_m
        d, height of the centre of the base above the ground.
    workspace_m
        l, height of the top of the workspace above the centre of the base.
    climb_m
        sigma, highest step that the robot drives over. Lower objects are no obstacles (Li2020: 1 cm).

    Raises
    ------
    ValueError
        If the band is empty or begins below the ground.

    Examples
    --------
    A robot of 0.6 m whose wheels climb 1 cm.

    >>> import fusion
    >>> band = fusion.HeightBand(base_height_m=0.1, workspace_m=0.5, climb_m=0.01)
    >>> band.low_m, round(band.high_m, 2)
    (0.01, 0.61)
    """

    base_height_m: float
    workspace_m: float
    climb_m: float

    def __post_init__(self) -> None:
        numbers([self.base_height_m, self.workspace_m, self.climb_m], (3,), "heights of a band")
        if not (self.climb_m >= 0.0 and self.base_height_m + self.workspace_m > 0.0):
            raise ValueError(f"{self} is empty: needs climb_m >= 0 and base_height_m + workspace_m > 0")

    @property
    def low_m(self) -> float:
        """Lower limit: obstacles reach above this height."""
        return self.climb_m

    @property
    def high_m(self) -> float:
        """Upper limit d + l + sigma: the robot passes under objects above it."""
        return self.base_height_m + self.workspace_m + self.climb_m

    def holds(self, z_ground: FloatArray, margin_m: FloatArray | float = 0.0) -> BoolArray:
        """Return whether points at these heights are obstacles: sigma < z < d + l + sigma.

        ``margin_m`` raises the lower limit, to allow for noise of the heights.

        Examples
        --------
        >>> import fusion, numpy as np
        >>> band = fusion.HeightBand(base_height_m=0.1, workspace_m=0.5, climb_m=0.01)
        >>> band.holds(np.array([0.0, 0.3, 1.2])).tolist()  # the floor, a chair's seat, a table's lamp
        [False, True, False]
        """
        return np.asarray((z_ground > self.low_m + margin_m) & (z_ground < self.high_m))


def pixel_rays(shape: tuple[int, int], intrinsics: Intrinsics) -> FloatArray:
    """Return the viewing ray of each pixel: (H, W, 2) x/z, y/z in the optical frame, Yang2021 Eq. (13)."""
    rows, cols = shape
    x = np.broadcast_to((np.arange(cols) - intrinsics.cx) / intrinsics.fx, shape)
    y = np.broadcast_to(((np.arange(rows) - intrinsics.cy) / intrinsics.fy)[:, None], shape)
    return np.stack([x, y], axis=-1)


def back_project(depth_m: NDArray[np.floating[Any]], rays: FloatArray) -> FloatArray:
    """Return (N, 3) points of the valid pixels in the optical frame, by row: Yang2021 Eq. (14), zc = d.

    Parameters
    ----------
    depth_m
        (H, W) along the optical axis; zero and values that are not finite are invalid.
    rays
        (H, W, 2) from `pixel_rays`.
    """
    valid = np.isfinite(depth_m) & (depth_m > 0.0)
    z = depth_m[valid].astype(np.float64)
    return np.column_stack([rays[valid] * z[:, None], z])


def to_frame(points: FloatArray, T_a_b: FloatArray) -> FloatArray:
    """Transform (N, 3) points from frame b to frame a, Yang2021 Eq. (16)."""
    placed = np.empty((len(points), 3))
    _place(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(T_a_b, np.float64), placed)
    return placed


@kernel(nogil=True)
def _place(points, T_a_b, placed):  # type: ignore[no-untyped-def]
    """Transform (N, 3) points into ``placed``; ten times faster than a matrix product of this shape."""
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        for k in range(3):
            placed[i, k] = T_a_b[k, 0] * x + T_a_b[k, 1] * y + T_a_b[k, 2] * z + T_a_b[k, 3]


def thin_to_voxels(points: FloatArray, voxel_m: float, step: int = 1) -> FloatArray:
    """Return the first point (M, 3) in each voxel, so that near surfaces weigh no more than far ones.

    Points are visited in strides of ``step``, coprime to their number.
    """
    if not len(points):
        return points
    first, keys = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    count = first_in_voxels(points, voxel_m, step, table_for(len(points)), keys, first)
    return points.take(first[:count] if step == 1 else np.sort(first[:count]), axis=0)


def thin_evenly(points: FloatArray, voxel_m: float) -> FloatArray:
    """Return one point (M, 3) in each voxel without a bias to one side.

    The first in the order of the beams turns a noisy cloud; strides of the golden section prefer no side.
    """
    step = len(points) * 514_229 // 832_040
    while math.gcd(step, len(points)) > 1:
        step += 1
    return thin_to_voxels(points, voxel_m, step)


def dense_enough(points: FloatArray, radius_m: float, least_neighbours: int) -> BoolArray:
    """Radius outlier removal: return (N,) whether enough other points are within the radius."""
    from scipy.spatial import cKDTree

    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    neighbours = cKDTree(points).query_ball_point(points, radius_m, return_length=True)
    return np.asarray(neighbours > least_neighbours)


def obstacle_points(
    points_ground: FloatArray,
    band: HeightBand,
    *,
    margin_m: FloatArray | float = 0.0,
    radius_m: float,
    least_neighbours: int,
    voxel_m: float,
) -> FloatArray:
    """Return (M, 3) points of a cloud after the cut to the band, voxel filter and outlier removal.

    Parameters
    ----------
    points_ground
        (N, 3) points in a frame with the ground at z = 0 and z up.
    margin_m
        See `HeightBand.holds`; one value for all points or (N,).
    radius_m, least_neighbours
        r and n of the radius filter in Yang2021; r is below the cell size R.
    voxel_m
        Voxel size; 0 keeps all points.
    """
    cut = points_ground[band.holds(points_ground[:, 2], margin_m)]
    if voxel_m > 0.0:
        cut = thin_to_voxels(cut, voxel_m)
    return cut[dense_enough(cut, radius_m, least_neighbours)]
