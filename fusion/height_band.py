"""Obstacles in a depth image by the robot's own geometry, no fit of the ground: Yang2021 Eq. (13)-(20)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.curves import Intrinsics
from fusion.kernel import kernel
from fusion.voxel_hash import first_in_voxels, table_for

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class HeightBand:
    """The heights in which a thing stops the robot, Yang2021 Eq. (17)-(18).

    Attributes
    ----------
    base_height_m
        d, of the base's centre above the ground.
    workspace_m
        l, of the workspace's top above the base's centre.
    climb_m
        sigma, the highest step that the robot drives over. What is lower is no obstacle (Li2020: 1 cm).

    Raises
    ------
    ValueError
        Where the band is empty or begins below the ground.

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
        if not (self.climb_m >= 0.0 and self.base_height_m + self.workspace_m > 0.0):
            raise ValueError(f"{self} is empty: needs climb_m >= 0 and base_height_m + workspace_m > 0")

    @property
    def low_m(self) -> float:
        """Obstacles reach above this."""
        return self.climb_m

    @property
    def high_m(self) -> float:
        """The robot passes under what begins above this: d + l + sigma."""
        return self.base_height_m + self.workspace_m + self.climb_m

    def holds(self, z_ground: FloatArray, margin_m: FloatArray | float = 0.0) -> BoolArray:
        """Whether points at these heights are obstacles: sigma < z < d + l + sigma.

        ``margin_m`` raises the lower end, for heights that noise alone could lift so far.

        Examples
        --------
        >>> import fusion, numpy as np
        >>> band = fusion.HeightBand(base_height_m=0.1, workspace_m=0.5, climb_m=0.01)
        >>> band.holds(np.array([0.0, 0.3, 1.2])).tolist()  # the floor, a chair's seat, a table's lamp
        [False, True, False]
        """
        return np.asarray((z_ground > self.low_m + margin_m) & (z_ground < self.high_m))


def pixel_rays(shape: tuple[int, int], intrinsics: Intrinsics) -> FloatArray:
    """Where each pixel looks: (H, W, 2) x/z, y/z in the optical frame by Yang2021 Eq. (13).

    Examples
    --------
    >>> import fusion
    >>> from fusion.height_band import pixel_rays
    >>> pixel_rays((2, 3), fusion.Intrinsics(fx=1.0, fy=1.0, cx=1.0, cy=0.5))[0].tolist()
    [[-1.0, -0.5], [0.0, -0.5], [1.0, -0.5]]
    """
    rows, cols = shape
    x = np.broadcast_to((np.arange(cols) - intrinsics.cx) / intrinsics.fx, shape)
    y = np.broadcast_to(((np.arange(rows) - intrinsics.cy) / intrinsics.fy)[:, None], shape)
    return np.stack([x, y], axis=-1)


def back_project(depth_m: NDArray[np.floating[Any]], rays: FloatArray) -> FloatArray:
    """(N, 3) points in the optical frame of the valid pixels, row by row: Yang2021 Eq. (14), zc = d.

    Parameters
    ----------
    depth_m
        (H, W) along the optical axis; zero and what is not finite is no reading.
    rays
        (H, W, 2) from `pixel_rays`.

    Examples
    --------
    >>> import fusion, numpy as np
    >>> from fusion.height_band import back_project, pixel_rays
    >>> depth_m = np.array([[2.0, 0.0, 2.0]])  # the middle pixel has no reading
    >>> back_project(depth_m, pixel_rays((1, 3), fusion.Intrinsics(fx=2.0, fy=2.0, cx=1.0, cy=0.0))).tolist()
    [[-1.0, 0.0, 2.0], [1.0, 0.0, 2.0]]
    """
    valid = np.isfinite(depth_m) & (depth_m > 0.0)
    z = depth_m[valid].astype(np.float64)
    return np.column_stack([rays[valid] * z[:, None], z])


def to_frame(points: FloatArray, T_a_b: FloatArray) -> FloatArray:
    """(N, 3) points of frame b in frame a, Yang2021 Eq. (16)."""
    placed = np.empty((len(points), 3))
    _place(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(T_a_b, np.float64), placed)
    return placed


@kernel(nogil=True)
def _place(points, T_a_b, placed):  # type: ignore[no-untyped-def]
    """Points (N, 3) by a matrix into ``placed``; a product of matrices so thin takes ten times as long."""
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        for k in range(3):
            placed[i, k] = T_a_b[k, 0] * x + T_a_b[k, 1] * y + T_a_b[k, 2] * z + T_a_b[k, 3]


def thin_to_voxels(points: FloatArray, voxel_m: float, step: int = 1) -> FloatArray:
    """(M, 3) one of the points in each voxel; so near surfaces weigh no more than far ones.

    The first, if asked in such steps, which share no divisor with their number; in their order.

    Examples
    --------
    >>> import numpy as np
    >>> from fusion.height_band import thin_to_voxels
    >>> thin_to_voxels(np.array([[0.01, 0.0, 0.0], [0.02, 0.0, 0.0], [1.0, 0.0, 0.0]]), voxel_m=0.1).tolist()
    [[0.01, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    if not len(points):
        return points
    first, keys = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    count = first_in_voxels(points, voxel_m, step, table_for(len(points)), keys, first)
    return points.take(first[:count] if step == 1 else np.sort(first[:count]), axis=0)


def thin_evenly(points: FloatArray, voxel_m: float) -> FloatArray:
    """The same, whichever: the first would turn the cloud about the lidar.

    Of what noise makes thick it is that on the side from which the beams came. Asked in steps of the golden
    section no side is.
    """
    step = len(points) * 514_229 // 832_040
    while math.gcd(step, len(points)) > 1:
        step += 1
    return thin_to_voxels(points, voxel_m, step)


def dense_enough(points: FloatArray, radius_m: float, least_neighbours: int) -> BoolArray:
    """Radius outlier removal: (N,) whether at least so many other points lie within the radius.

    Examples
    --------
    >>> import numpy as np
    >>> from fusion.height_band import dense_enough
    >>> points = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0], [5.0, 0.0, 0.0]])
    >>> dense_enough(points, radius_m=0.1, least_neighbours=1).tolist()
    [True, True, False]
    """
    from scipy.spatial import cKDTree

    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    found = cKDTree(points).query_ball_point(points, radius_m, return_length=True)
    return np.asarray(found > least_neighbours)


def obstacle_points(
    points_ground: FloatArray,
    band: HeightBand,
    *,
    margin_m: FloatArray | float = 0.0,
    radius_m: float = 0.04,
    least_neighbours: int = 6,
    voxel_m: float = 0.015,
) -> FloatArray:
    """(M, 3) what is left of a cloud after the cut to the band, thinning to voxels and outlier removal.

    Parameters
    ----------
    points_ground
        (N, 3) in a frame with the ground at z = 0 and z up.
    margin_m
        See `HeightBand.holds`; one for all points or (N,).
    radius_m, least_neighbours
        r and n of Yang2021's radius filter; r below the side R of a cell.
    voxel_m
        Side of the voxels, 0 keeps all points.
    """
    cut = points_ground[band.holds(points_ground[:, 2], margin_m)]
    if voxel_m > 0.0:
        cut = thin_to_voxels(cut, voxel_m)
    return cut[dense_enough(cut, radius_m, least_neighbours)]
