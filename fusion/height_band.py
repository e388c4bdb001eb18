"""Obstacles in a depth image by the robot's own geometry, no fit of the ground: Yang2021 Eq. (13)-(20)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion.curves import Intrinsics
from fusion.estimation import ROUNDS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class LensDistortion:
    """Brown's model as OpenCV has it: radial k1, k2, k3, tangential p1, p2 (Li2020 Eq. (5)-(6): dx, dy)."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


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
        """
        return np.asarray((z_ground > self.low_m + margin_m) & (z_ground < self.high_m))


@dataclass(frozen=True)
class ArmJoint:
    """A joint of the arm that carries the camera.

    Attributes
    ----------
    T_parent_joint
        (4, 4) of the joint at position 0 in the frame of the link before it.
    axis
        Unit vector in the joint's frame, about which it turns or along which it slides.
    kind
        ``turn`` (position in radians) or ``slide`` (metres).
    """

    T_parent_joint: FloatArray
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    kind: Literal["turn", "slide"] = "turn"

    def T_parent_link(self, position: float) -> FloatArray:
        """(4, 4) of the moved link in the frame of the link before it."""
        moved = np.eye(4)
        axis = np.asarray(self.axis, dtype=np.float64)
        if self.kind == "slide":
            moved[:3, 3] = position * axis
        else:
            cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
            # Rodrigues' formula.
            moved[:3, :3] += math.sin(position) * cross + (1.0 - math.cos(position)) * cross @ cross
        return np.asarray(self.T_parent_joint @ moved)


def camera_on_arm(
    joints: Sequence[ArmJoint], positions: Sequence[float], T_link_camera: FloatArray
) -> FloatArray:
    """``T_base_camera`` (4, 4) of a camera on an arm's last link, Yang2021 Eq. (15).

    Parameters
    ----------
    joints
        From the base on; none for a camera on the body.
    positions
        One a joint, radians or metres.
    T_link_camera
        (4, 4) of the optical frame on the last link.

    Raises
    ------
    ValueError
        Where there is not one position a joint.

    Examples
    --------
    A mast that slides up, on a base that turns.

    >>> import fusion, numpy as np
    >>> turn, slide = fusion.ArmJoint(np.eye(4)), fusion.ArmJoint(np.eye(4), kind="slide")
    >>> T_link_camera = np.eye(4)
    >>> T_link_camera[0, 3] = 0.2  # before the mast
    >>> T_base_camera = fusion.camera_on_arm([turn, slide], [np.pi / 2, 0.5], T_link_camera)
    >>> T_base_camera[:3, 3].round(3).tolist()
    [0.0, 0.2, 0.5]
    """
    T_base_link = np.eye(4)
    for joint, position in zip(joints, positions, strict=True):
        T_base_link = T_base_link @ joint.T_parent_link(position)
    return np.asarray(T_base_link @ T_link_camera)


def pixel_rays(
    shape: tuple[int, int], intrinsics: Intrinsics, distortion: LensDistortion | None = None
) -> FloatArray:
    """Where each pixel looks: (H, W, 2) x/z and y/z in the optical frame, Yang2021 Eq. (13) solved for them.

    With a distortion the ideal ray is found by fixed-point iteration.
    """
    rows, cols = shape
    x = np.broadcast_to((np.arange(cols) - intrinsics.cx) / intrinsics.fx, shape)
    y = np.broadcast_to(((np.arange(rows) - intrinsics.cy) / intrinsics.fy)[:, None], shape)
    seen = np.stack([x, y], axis=-1)
    if distortion is None:
        return seen
    ray = seen.copy()
    for _ in range(ROUNDS):
        ray = ray + seen - distort(ray, distortion)
    return ray


def distort(rays: FloatArray, distortion: LensDistortion) -> FloatArray:
    """Where a lens shows ideal rays (..., 2), x/z and y/z."""
    x, y = rays[..., 0], rays[..., 1]
    square = x * x + y * y
    radial = 1.0 + square * (distortion.k1 + square * (distortion.k2 + square * distortion.k3))
    p1, p2 = distortion.p1, distortion.p2
    return np.stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
            y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=-1,
    )


def back_project(depth_m: NDArray[np.floating[Any]], rays: FloatArray) -> FloatArray:
    """(N, 3) points in the optical frame of the valid pixels, row by row: Yang2021 Eq. (14), zc = d.

    Parameters
    ----------
    depth_m
        (H, W) along the optical axis; zero and what is not finite is no reading.
    rays
        (H, W, 2) from `pixel_rays`.
    """
    valid = np.isfinite(depth_m) & (depth_m > 0.0)
    z = depth_m[valid].astype(np.float64)
    return np.column_stack([rays[valid] * z[:, None], z])


def to_frame(points: FloatArray, T_a_b: FloatArray) -> FloatArray:
    """(N, 3) points of frame b in frame a, Yang2021 Eq. (16)."""
    return np.asarray(points @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def thin_to_voxels(points: FloatArray, voxel_m: float) -> FloatArray:
    """(M, 3) one of the points in each voxel, the first; so near surfaces weigh no more than far ones."""
    if not len(points):
        return points
    cells = np.floor(points / voxel_m).astype(np.int64)
    cells -= cells.min(axis=0)
    _, across, up = cells.max(axis=0) + 1
    keys = (cells[:, 0] * across + cells[:, 1]) * up + cells[:, 2]
    return points[np.sort(np.unique(keys, return_index=True)[1])]


def dense_enough(points: FloatArray, radius_m: float, least_neighbours: int) -> BoolArray:
    """Radius outlier removal: (N,) whether at least so many other points lie within the radius."""
    from scipy.spatial import cKDTree

    if not len(points):
        return np.zeros(0, dtype=np.bool_)
    found = cKDTree(points).query_ball_point(points, radius_m, return_length=True)
    return np.asarray(found > least_neighbours)


def count_in_cells(points_xy: FloatArray, cell_m: float) -> tuple[IntArray, IntArray]:
    """Points a cell: Yang2021 Eq. (19), cell = floor(xy / R).

    Returns
    -------
    (M, 2) column and row of each cell that holds a point, on the lattice through the frame's origin; (M,) how
    many it holds. Eq. (20) takes those of at least N points for occupied.
    """
    cells = np.floor(np.asarray(points_xy)[:, :2] / cell_m).astype(np.int64)
    if not len(cells):
        return cells.reshape(0, 2), np.zeros(0, dtype=np.int64)
    found, counts = np.unique(cells, axis=0, return_counts=True)
    return found, counts


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
