"""Test which points are inside a polygon, by the even-odd rule: a polygon that crosses itself has holes."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.measurements import BoolArray, FloatArray


def inside(points: FloatArray, polygon: FloatArray) -> BoolArray:
    """Return (N,) whether points (N, 2) are in a closed polygon of (M, 2) corners."""
    is_inside = np.zeros(len(points), np.bool_)
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    (in_box,) = np.nonzero(((points >= low) & (points <= high)).all(axis=1))
    x, y = points[in_box].T
    odd = np.zeros(len(in_box), np.bool_)
    # Whether a ray from each point along x crosses the outline an odd number of times.
    for (from_x, from_y), (to_x, to_y) in zip(np.roll(polygon, 1, axis=0), polygon, strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (y - from_y) / (to_y - from_y)
            odd ^= ((from_y > y) != (to_y > y)) & (x < from_x + share * (to_x - from_x))
    is_inside[in_box] = odd
    return is_inside


def cells_inside(
    polygon: FloatArray, shape: tuple[int, ...], resolution_m: float, T_map_grid: gtsam.Pose2
) -> BoolArray:
    """Return (rows, cols) whether the cell centres of a grid are in a polygon of the map."""
    row, col = np.mgrid[: shape[0], : shape[1]]
    middles = (np.column_stack([col.reshape(-1), row.reshape(-1)]) + 0.5) * resolution_m
    turn = T_map_grid.rotation().matrix()
    return inside(middles @ turn.T + T_map_grid.translation(), polygon).reshape(shape)
