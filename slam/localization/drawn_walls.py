"""Walls of a grid map: the boundaries of its free space, each side of a wall facing its own room."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import ndimage

from fusion.estimation import TINY
from slam.localization.beam_check import END_M, KnownSpace
from slam.localization.beams import WALL, follow
from slam.localization.scan_view import ScanView
from slam.localization.whole_map_field import BLUR
from slam.mapping.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between, transform_points
from slam.matching.scan_points import ScanPoints
from slam.measurements import Float32Array, Pose, pose2_from_row, row_from_pose2


def drawn_walls(grid: OccupancyGrid) -> OrientedPoints:
    """Return a point at the centre of each wall cell for every free side, map frame.

    Normals point away from the occupied cells around the free cell, as seen by a scan from there. A wall of
    one cell between two rooms has both.
    """
    states = grid.states()
    wall = states == OCCUPIED
    # Wide enough to smooth the steps of a slanted wall.
    filled = np.pad(ndimage.gaussian_filter(wall.astype(np.float32), BLUR, mode="nearest"), 1, "edge")
    walls, free = np.pad(wall, 1), np.pad(states == FREE, 1)
    slope_y, slope_x = (np.gradient(filled, axis=axis) for axis in (0, 1))
    cells, normals = list[Float32Array](), list[Float32Array]()
    for row, column in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        free_cells = np.argwhere(free & np.roll(walls, (-row, -column), (0, 1)))
        gradient = -np.column_stack([slope_x[tuple(free_cells.T)], slope_y[tuple(free_cells.T)]])
        length = np.hypot(*gradient.T)
        sided = length > TINY
        normals.append(gradient[sided] / length[sided, None])
        cells.append(np.asarray(free_cells[sided] + (row, column), np.float32)[:, ::-1])
    middles = (np.concatenate(cells) - np.float32(0.5)) * np.float32(grid.resolution_m)
    corner = row_from_pose2(grid.T_map_grid)
    turned = transform_points(np.concatenate(normals), np.array([0.0, 0.0, corner[2]]))
    return OrientedPoints(
        transform_points(middles, corner).astype(np.float32), np.asarray(turned, np.float32)
    )


def drawn_views(
    drawn: OrientedPoints, space: KnownSpace, reach_m: float, count: int
) -> Iterator[tuple[Pose, ScanView]]:
    """Return virtual 360 degree scans from so many places of free space, with ``T_map_base``."""
    clear = np.argwhere(space.clear) + 0.5
    in_cells = transform_points(drawn.points, between(space.frame, np.zeros(3))) / space.cell_m
    for cell in clear[np.arange(count) * len(clear) // count] if len(clear) else ():
        place = np.array([*transform_points(cell[None] * space.cell_m, space.frame)[0], 0.0])
        offsets = drawn.points - place[:2]
        faces = (np.hypot(*offsets.T) < reach_m) & (np.einsum("ij,ij->i", offsets, drawn.normals) < 0.0)
        ends = np.column_stack([in_cells, np.full(len(drawn), 0.5)])[faces]
        first_hits = follow(space.cells, np.array([*cell, 0.5]), ends, END_M / space.cell_m)
        on_wall = np.flatnonzero(faces)[first_hits != WALL]
        points = ScanPoints(offsets[on_wall].astype(np.float32), drawn.normals[on_wall])
        yield pose2_from_row(place), ScanView(0.0, points, OrientedPoints.from_scan(points), np.zeros(2))
