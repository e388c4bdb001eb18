"""A coloured cloud seen from above, as a picture of a bounded size."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.evaluation.report_figures import MapPicture
from slam.mapping.dense_map import ColoredCloud
from slam.measurements import BoolArray, FloatArray

_LONG_SIDE_PX = 1000
_GROUND = 244  # grey where nothing was seen
# Stray points far off would shrink everything else.
_OUTSIDE_PERCENT = 0.1
# Cosines between a normal and the upward direction: ever narrower cones around the floors and tables.
_CONES = (0.8, 0.9, 0.95, 0.97)
_LEAST_SHARE = 0.02
# A surface that faces down further than this is seen from below only: a ceiling.
_FACING_DOWN = -0.3


def cloud_from_above(
    cloud: ColoredCloud, positions_m: FloatArray, *, pixel_m: float, level: bool
) -> tuple[MapPicture, FloatArray] | None:
    """Look down on a cloud; of points in one pixel the highest is seen, ceilings are looked through.

    Parameters
    ----------
    cloud
        In the map frame.
    positions_m
        (N, 3) trajectory, map frame.
    pixel_m
        Least side of a pixel: the distance of the points.
    level
        Find out which way is up; otherwise it is z. A hand-held camera does not know it, yet most of what
        faces up is a floor or a table.

    Returns
    -------
    The picture, and the trajectory (N, 2) in its frame; None where there is nothing to see.
    """
    points = cloud.points_map.astype(np.float64)
    if not len(points):
        return None
    turn = _levelling(cloud.normals_map) if level else np.eye(3)
    seen = cloud.normals_map @ turn[2] > _FACING_DOWN
    points, colors = points[seen] @ turn.T, cloud.colors[seen]
    if not len(points):
        return None
    path_xy = (positions_m @ turn.T)[:, :2]
    low, high = np.percentile(points[:, :2], [_OUTSIDE_PERCENT, 100.0 - _OUTSIDE_PERCENT], axis=0)
    low, high = np.minimum(low, path_xy.min(axis=0)), np.maximum(high, path_xy.max(axis=0))
    resolution_m = max(pixel_m, float((high - low).max()) / _LONG_SIDE_PX)
    columns, rows = (np.floor((high - low) / resolution_m).astype(int) + 1).tolist()
    image = np.full((rows, columns, 3), _GROUND, dtype=np.uint8)
    painted = np.zeros((rows, columns), dtype=np.bool_)
    cells = np.floor((points[:, :2] - low) / resolution_m).astype(int)
    inside = ((cells >= 0) & (cells < [columns, rows])).all(axis=1)
    # Of values assigned to one pixel the last one stays: the highest.
    order = np.flatnonzero(inside)[np.argsort(points[inside, 2], kind="stable")]
    at = rows - 1 - cells[order, 1], cells[order, 0]
    image[at], painted[at] = colors[order], True
    _close_gaps(image, painted)
    return MapPicture(image, resolution_m, (float(low[0]), float(low[1]))), path_xy


def _close_gaps(image: NDArray[np.uint8], painted: BoolArray) -> None:
    """Paint single pixels between two painted ones: the points' grid and the picture's do not agree."""
    across = painted[:, :-2] & painted[:, 2:] & ~painted[:, 1:-1]
    image[:, 1:-1][across] = image[:, :-2][across]
    upward = painted[:-2] & painted[2:] & ~painted[1:-1]
    upward[:, 1:-1] &= ~across[1:-1]
    image[1:-1][upward] = image[:-2][upward]


def _levelling(normals: NDArray[np.float32]) -> FloatArray:
    """Rotation (3, 3) that turns what most surfaces near z face into z, by the least angle."""
    up = np.array([0.0, 0.0, 1.0])
    for cosine in _CONES:
        around = normals[normals @ up > cosine]
        if len(around) < _LEAST_SHARE * len(normals):
            break
        mean = around.mean(axis=0, dtype=np.float64)
        up = mean / np.linalg.norm(mean)
    # Rodrigues' formula for the axis up x z, whose length is the sine and up's z the cosine.
    x, y, z = up
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    turn: FloatArray = np.eye(3) + cross + cross @ cross / (1.0 + z)
    return turn
