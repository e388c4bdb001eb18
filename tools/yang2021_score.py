"""Scores of Yang2021's room: observation points, lengths, angles, completeness; and RANSAC ground fitting."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
from layer_homes import on_truth, to_be_seen
from numpy.typing import NDArray
from yang2021_room import CORNERS, FLOOR_POINTS, LENGTH_M, OBSTACLE_POINTS, SEGMENTS, WIDTH_M, Run

from fusion.curves import Intrinsics
from fusion.height_band import (
    HeightBand,
    back_project,
    dense_enough,
    pixel_rays,
    thin_to_voxels,
    to_frame,
)
from slam.mapping.layered_map import LayeredMap
from slam.mapping.occupancy_grid import OCCUPIED
from slam.simulation.true_grid import true_grid

NEAR_M = 0.12
RANSAC_DISTANCE_M, RANSAC_DRAWS = 0.03, 1000

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Line:
    """A fitted face: a point on it and its unit direction."""

    point: Points
    along: Points


def occupied_points(built: LayeredMap) -> Points:
    """(N, 2) middles of the occupied cells, map frame."""
    rows, cols = np.nonzero(built.states("depth") == OCCUPIED)
    corner = np.array([built.T_map_grid.x(), built.T_map_grid.y()])
    return np.column_stack([cols + 0.5, rows + 0.5]) * built.resolution_m + corner


def points_right(run: Run, occupied: Points, cell_m: float) -> list[bool]:
    """For each observation point whether it was reported right: occupied in its cell or beside it, or not."""

    def marked(point: tuple[float, float]) -> bool:
        at = run.in_map(np.array([point]))[0]
        return bool(len(occupied)) and bool((np.abs(occupied - at).max(axis=1) < 1.5 * cell_m).any())

    return [not marked(point) for point in FLOOR_POINTS] + [marked(point) for point in OBSTACLE_POINTS]


def length_error_per_m(run: Run, occupied: Points) -> float:
    """Mean error of the four measured lengths, metres a metre."""
    errors = []
    for (axis, one), (_, other), across in SEGMENTS:
        first, second = _face(run, occupied, axis, one, across), _face(run, occupied, axis, other, across)
        middle = np.empty(2)
        middle[axis], middle[1 - axis] = one, 0.5 * (across[0] + across[1])
        start = _foot(first, run.in_map(middle[None])[0])
        measured = abs(_cross(second.along, start - second.point))
        errors.append(abs(measured - abs(other - one)) / abs(other - one))
    return float(np.mean(errors))


def angle_error_deg(run: Run, occupied: Points) -> float:
    """Mean error of the measured corners of the room, degrees."""
    errors = []
    for (axis, one), (other_axis, other) in CORNERS:
        full = ((0.3, WIDTH_M - 0.3), (0.3, LENGTH_M - 0.3))
        first = _face(run, occupied, axis, one, full[axis])
        second = _face(run, occupied, other_axis, other, full[other_axis])
        errors.append(abs(90.0 - math.degrees(math.acos(abs(float(first.along @ second.along))))))
    return float(np.mean(errors))


def completeness(run: Run, built: LayeredMap, band: HeightBand) -> float:
    """Occupied cells of the map (tau'), over the true ones that can be seen (tau).

    True are cells that border on the floor, and the tops of what ends inside the height band.
    """
    truth = true_grid(run.home, band.low_m, band.high_m, built.resolution_m)
    above = true_grid(run.home, band.high_m, band.high_m + 0.01, built.resolution_m)
    wanted = to_be_seen(truth, run.home) | (truth.occupied & ~above.occupied)
    found = on_truth(built.states("depth"), built, truth)
    return float(found.sum() / wanted.sum())


def ransac_occupied(run: Run, band: HeightBand, cell_m: float, seed: int, *, whole: bool) -> Points:
    """Occupied middles where the ground is fitted by RANSAC instead, map frame.

    What lies on the plane is cut off as ground, what lies above it is projected.

    Parameters
    ----------
    whole
        One plane for the cloud of the whole drive; otherwise one for each keyframe.
    """
    rng = np.random.default_rng(seed)
    clouds, eyes = [], []
    for frame, pose in zip(run.frames, run.poses, strict=True):
        camera = frame.intrinsics
        intrinsics = Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        depth = np.where(frame.depth_m <= 4.0, frame.depth_m, 0.0)[::2, ::2]
        cloud = back_project(depth, pixel_rays(frame.depth_m.shape, intrinsics)[::2, ::2])
        assert frame.T_base_camera is not None
        T_map_camera = gtsam.Pose3(pose).compose(frame.T_base_camera).matrix()
        clouds.append(thin_to_voxels(to_frame(cloud, T_map_camera), 0.015))
        eyes.append(T_map_camera[:3, 3])
    if whole:
        clouds, eyes = [thin_to_voxels(np.concatenate(clouds), 0.015)], [np.mean(eyes, axis=0)]
    kept = np.concatenate(
        [_over_plane(cloud, eye, band, rng) for cloud, eye in zip(clouds, eyes, strict=True)]
    )
    left = thin_to_voxels(kept, 0.015)
    left = left[dense_enough(left, 0.04, 6)]
    cells, counts = count_in_cells(left, cell_m)
    return np.asarray((cells[counts >= 3] + 0.5) * cell_m)


def _over_plane(cloud: Points, eye: Points, band: HeightBand, rng: np.random.Generator) -> Points:
    """The points above the plane of most of a cloud, up to the band's top; up is towards the eye."""
    normal, middle = _ransac_plane(cloud, rng)
    height = (cloud - middle) @ normal * math.copysign(1.0, (eye - middle) @ normal)
    return cloud[(height > RANSAC_DISTANCE_M) & (height < band.high_m)]


def _ransac_plane(cloud: Points, rng: np.random.Generator) -> tuple[Points, Points]:
    """Unit normal and a point of the plane that most points are near, fitted to all of those."""
    first, second, third = (cloud[rng.integers(0, len(cloud), RANSAC_DRAWS)] for _ in range(3))
    normals = np.cross(second - first, third - first)
    length = np.linalg.norm(normals, axis=1)
    planes = [
        (n / norm, n @ p / norm) for n, norm, p in zip(normals, length, first, strict=True) if norm > 0.0
    ]

    def near(plane: tuple[Points, float]) -> NDArray[np.bool_]:
        return np.abs(cloud @ plane[0] - plane[1]) < RANSAC_DISTANCE_M

    inliers = cloud[near(max(planes, key=lambda plane: np.count_nonzero(near(plane))))]
    middle = inliers.mean(axis=0)
    return np.linalg.eigh(np.cov((inliers - middle).T))[1][:, 0], middle


def _face(run: Run, occupied: Points, axis: int, place: float, across: tuple[float, float]) -> Line:
    """Line through the occupied cells at a face of the room, by total least squares."""
    ends = np.empty((2, 2))
    ends[:, axis], ends[:, 1 - axis] = place, across
    one, other = run.in_map(ends)
    along = (other - one) / np.linalg.norm(other - one)
    beside, at = np.abs(_cross(along, occupied - one)), (occupied - one) @ along
    near = occupied[(beside < NEAR_M) & (at > 0.0) & (at < np.linalg.norm(other - one))]
    if len(near) < 3:
        return Line(np.full(2, np.nan), along)
    middle = near.mean(axis=0)
    return Line(middle, np.linalg.svd(near - middle)[2][0])


def _foot(line: Line, point: Points) -> Points:
    """The point of a line nearest to a point."""
    return line.point + ((point - line.point) @ line.along) * line.along


def _cross(a: Points, b: Points) -> Points:
    """The z of the cross product in the plane."""
    return np.asarray(a[0] * b[..., 1] - a[1] * b[..., 0])


def count_in_cells(points_xy: Points, cell_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
