"""The exact floor plan of a home in a height band, and the drivable cells in it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from slam.errors import ConfigError
from slam.measurements import BoolArray, FloatArray
from slam.simulation.home_model import Home, Int32Array, Part

FREE = -1
_HAIR_M = 1e-7  # parts that only touch a cell or a height do not fill it


@dataclass(frozen=True, slots=True)
class TrueGrid:
    """A ground truth grid.

    Attributes
    ----------
    occupied
        (rows, cols), row 0 is the lowest y: a cell is occupied if any part of it is.
    resolution_m
        Side of a cell.
    origin_xy
        Lower-left corner of cell (0, 0), a multiple of the resolution, map frame.
    obstacle_id
        (rows, cols) id of the obstacle, -1 if free. If two share a cell: the higher id, so furniture has
        priority over the wall behind it.
    """

    occupied: BoolArray
    resolution_m: float
    origin_xy: tuple[float, float]
    obstacle_id: Int32Array


def true_grid(home: Home, z_low_m: float, z_high_m: float, resolution_m: float) -> TrueGrid:
    """Rasterise every solid in a height band, exactly.

    Parameters
    ----------
    z_low_m, z_high_m
        Limits of the band; solids that only touch it from below or above are outside.
    resolution_m
        Side of a cell.

    Raises
    ------
    ConfigError
        An empty band or a cell without a size.
    """
    if not (z_low_m < z_high_m and resolution_m > 0.0):
        raise ConfigError(
            f"true grid from z {z_low_m} to {z_high_m} m in cells of {resolution_m} m; "
            "give a band and a cell above zero"
        )
    box = np.stack([obstacle.box for obstacle in home.obstacles])
    low = np.floor(box[:, 0, :2].min(axis=0) / resolution_m + 1e-6)
    high = np.ceil(box[:, 1, :2].max(axis=0) / resolution_m - 1e-6)
    origin = (float(low[0] * resolution_m), float(low[1] * resolution_m))
    cols, rows = (high - low).astype(int)
    obstacle_id = np.full((rows, cols), FREE, dtype=np.int32)
    for owner, part in zip(home.obstacle_of_part, home.parts, strict=True):
        if part.z_low_m < z_high_m - _HAIR_M and part.z_high_m > z_low_m + _HAIR_M:
            _stamp(obstacle_id, part, int(owner), origin, resolution_m)
    return TrueGrid(obstacle_id != FREE, resolution_m, origin, obstacle_id)


def occupied_cells(
    parts: Iterable[Part], origin_xy: tuple[float, float], shape: tuple[int, int], resolution_m: float
) -> BoolArray:
    """Cells (rows, cols) that any part covers, at any height."""
    cells = np.full(shape, FREE, dtype=np.int32)
    for part in parts:
        _stamp(cells, part, 0, origin_xy, resolution_m)
    return np.asarray(cells != FREE)


def _stamp(
    cells: Int32Array, part: Part, owner: int, origin_xy: tuple[float, float], resolution_m: float
) -> None:
    """Write the owner into every cell that intersects the footprint (separating axes)."""
    corners = part.corners_xy() - origin_xy
    first = np.maximum(np.floor(corners.min(axis=0) / resolution_m).astype(int), 0)
    last = np.minimum(np.ceil(corners.max(axis=0) / resolution_m).astype(int), cells.shape[::-1])
    if (first >= last).any():
        return
    half = 0.5 * resolution_m
    x = (np.arange(first[0], last[0])[None, :] + 0.5) * resolution_m - (part.center_xy[0] - origin_xy[0])
    y = (np.arange(first[1], last[1])[:, None] + 0.5) * resolution_m - (part.center_xy[1] - origin_xy[1])
    c, s = math.cos(part.yaw_rad), math.sin(part.yaw_rad)
    reach = half * (abs(c) + abs(s))  # of the cell along the part's axes
    spread = 0.5 * np.ptp(corners, axis=0)  # of the part along the cell's axes
    meets = (np.abs(x) < half + spread[0] - _HAIR_M) & (np.abs(y) < half + spread[1] - _HAIR_M)
    meets &= np.abs(c * x + s * y) < part.half_xy[0] + reach - _HAIR_M
    meets &= np.abs(c * y - s * x) < part.half_xy[1] + reach - _HAIR_M
    cells[first[1] : last[1], first[0] : last[0]][meets] = owner


def drivable_cells(occupied: BoolArray, resolution_m: float, radius_m: float) -> BoolArray:
    """Cells whose centre is farther than the radius from every occupied cell, (rows, cols).

    Everything outside the grid counts as occupied.
    """
    padded = np.pad(occupied, 1, constant_values=True)
    distance: FloatArray = ndimage.distance_transform_edt(~padded)[1:-1, 1:-1]
    # Distances are from centre to centre; the edge of the occupied cell is half a cell closer.
    return np.asarray((distance - 0.5) * resolution_m > radius_m)


def largest_region(drivable: BoolArray) -> BoolArray:
    """The largest region of drivable cells connected by edges; all False if there is none."""
    labels, count = ndimage.label(drivable)
    if count == 0:
        return np.zeros_like(drivable)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray(labels == np.argmax(sizes))
