"""The walls of a drawn map: where its free space ends, each side of a wall facing the room that it bounds."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from fusion.estimation import TINY
from slam.localization.whole_map_field import BLUR
from slam.mapping.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import transform_points
from slam.measurements import Float32Array, row_from_pose2


def drawn_walls(grid: OccupancyGrid) -> OrientedPoints:
    """A point in the middle of each wall cell for every side on which it is free there, map frame.

    Normals point away from what is occupied around the free cell: what a scan from there would see. A wall of
    one cell between two rooms has both.
    """
    states = grid.states()
    wall = states == OCCUPIED
    # So wide that the steps of a slanted wall are smoothed away.
    filled = np.pad(ndimage.gaussian_filter(wall.astype(np.float32), BLUR, mode="nearest"), 1, "edge")
    walls, free = np.pad(wall, 1), np.pad(states == FREE, 1)
    slope_y, slope_x = (np.gradient(filled, axis=axis) for axis in (0, 1))
    cells, normals = list[Float32Array](), list[Float32Array]()
    for row, column in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        found = np.argwhere(free & np.roll(walls, (-row, -column), (0, 1)))
        away = -np.column_stack([slope_x[tuple(found.T)], slope_y[tuple(found.T)]])
        length = np.hypot(*away.T)
        sided = length > TINY
        normals.append(away[sided] / length[sided, None])
        cells.append(np.asarray(found[sided] + (row, column), np.float32)[:, ::-1])
    middles = (np.concatenate(cells) - np.float32(0.5)) * np.float32(grid.resolution_m)
    corner = row_from_pose2(grid.T_map_grid)
    turned = transform_points(np.concatenate(normals), np.array([0.0, 0.0, corner[2]]))
    return OrientedPoints(
        transform_points(middles, corner).astype(np.float32), np.asarray(turned, np.float32)
    )
