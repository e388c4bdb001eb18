"""Kernel that finds the cells that a depth image saw as free, from the floor to the top of the height band.

A cell is free for a robot if nothing stands in it at any height of the band. One ray covers one height: a ray
that passes over a low box says nothing about the box. So every ray records at which heights it passed a cell,
and a cell is free only if all heights are recorded and the floor was seen in it.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import Float32Array, FloatArray

HeightMask: TypeAlias = NDArray[np.uint64]
Box: TypeAlias = tuple[int, int, int, int]


@kernel
def view_box(
    depth_m: Float32Array, rays: Float32Array, T_grid_camera: FloatArray, reach_m: float, cell_m: float
) -> Box:
    """Return (first row, first col, rows, cols) of the cells that contain the camera and all readings.

    Parameters
    ----------
    depth_m
        (H, W), 0 where there is no reading.
    rays
        (H, W, 2) x/z and y/z in the optical frame.
    T_grid_camera
        (4, 4) of the optical frame in the lattice's axes, z up from the floor.
    reach_m
        Farther depths are cut to this.
    """
    low_x = high_x = T_grid_camera[0, 3]
    low_y = high_y = T_grid_camera[1, 3]
    for row in range(depth_m.shape[0]):
        for col in range(depth_m.shape[1]):
            depth = min(np.float64(depth_m[row, col]), reach_m)
            if depth > 0.0:
                a, b = rays[row, col, 0], rays[row, col, 1]
                x = T_grid_camera[0, 0] * a + T_grid_camera[0, 1] * b + T_grid_camera[0, 2]
                y = T_grid_camera[1, 0] * a + T_grid_camera[1, 1] * b + T_grid_camera[1, 2]
                x = T_grid_camera[0, 3] + depth * x
                y = T_grid_camera[1, 3] + depth * y
                low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
    first_row, first_col = math.floor(low_y / cell_m), math.floor(low_x / cell_m)
    return (
        first_row,
        first_col,
        math.floor(high_y / cell_m) + 1 - first_row,
        math.floor(high_x / cell_m) + 1 - first_col,
    )


@kernel
def holes_cleared(depth_m: Float32Array) -> Float32Array:
    """Fill holes of a depth image for free space: up to the nearer of the readings below and above.

    The surface in a hole is too far, too near, dark or of glass. An object on the floor in front of the
    reading below would occlude it, and a hanging one the reading above. A hole at the border of the image
    remains.

    Parameters
    ----------
    depth_m
        (H, W) upright, or upside down; 0 where there is no reading.
    """
    cleared = depth_m.copy()
    for col in range(depth_m.shape[1]):
        last = -1
        for row in range(depth_m.shape[0]):
            if depth_m[row, col] > 0.0:
                if last >= 0:
                    nearer = min(depth_m[last, col], depth_m[row, col])
                    for hole in range(last + 1, row):
                        cleared[hole, col] = nearer
                last = row
    return cleared


@kernel(error_model="numpy")
def heights_seen(
    depth_m: Float32Array,
    rays: Float32Array,
    T_grid_camera: FloatArray,
    box: Box,
    cell_m: float,
    reach_m: float,
    band_m: tuple[float, float],
    bins: int,
    noise: tuple[float, float, float],
    margin_sigmas: float,
    strides: tuple[int, int],
) -> HeightMask:
    """Return the heights at which each cell was seen as free.

    Parameters
    ----------
    depth_m, rays, T_grid_camera, cell_m, reach_m
        As in `view_box`, whose result is ``box``; a reading beyond ``reach_m`` frees what is before it.
    band_m, bins
        Lower and upper end of the height band, and into how many heights it is divided, up to 31.
    noise
        floor_m, share and per_m of the depth's standard deviation (`fusion.RangeNoise`).
    margin_sigmas
        A ray frees nothing nearer to its end than so many standard deviations.
    strides
        Every how many rows and columns a ray is followed; the floor is looked for in every pixel.

    Returns
    -------
    (rows, cols) with the lowest bit where the floor was seen, and two bits a height above it, one a half.
    """
    mask = np.zeros((box[2], box[3]), np.uint64)
    low, high = band_m
    camera_x, camera_y = T_grid_camera[0, 3] / cell_m - box[1], T_grid_camera[1, 3] / cell_m - box[0]
    camera_z = T_grid_camera[2, 3]
    for row in range(depth_m.shape[0]):
        for col in range(depth_m.shape[1]):
            depth = np.float64(depth_m[row, col])
            if not 0.0 < depth < math.inf:
                continue
            a, b = rays[row, col, 0], rays[row, col, 1]
            dx = (T_grid_camera[0, 0] * a + T_grid_camera[0, 1] * b + T_grid_camera[0, 2]) / cell_m
            dy = (T_grid_camera[1, 0] * a + T_grid_camera[1, 1] * b + T_grid_camera[1, 2]) / cell_m
            dz = T_grid_camera[2, 0] * a + T_grid_camera[2, 1] * b + T_grid_camera[2, 2]
            sigma = noise[0] + noise[1] * depth + noise[2] * depth * depth
            end_z = camera_z + depth * dz
            # Far below the floor there is only a mirror image.
            if depth <= reach_m and end_z <= low and end_z >= -low - 4.0 * sigma * abs(dz):
                at_row, at_col = int(camera_y + depth * dy), int(camera_x + depth * dx)
                if at_row < box[2] and at_col < box[3]:
                    mask[at_row, at_col] |= np.uint64(1)
            if row % strides[0] == 0 and col % strides[1] == 0:
                end = min(depth - margin_sigmas * sigma, reach_m)
                if end > 0.0:
                    _follow(mask, camera_x, camera_y, camera_z, dx, dy, dz, end, low, high, 2 * bins)
    return mask


@kernel
def free_heights(mask: HeightMask, board: NDArray[np.int16], steps: int) -> None:
    """Put ``steps`` of evidence into the heights of (rows, cols, heights) that were seen through in full."""
    for row in range(board.shape[0]):
        for col in range(board.shape[1]):
            bits = mask[row, col]
            if bits & np.uint64(1):
                board[row, col, 0] = steps
            halves, height = bits >> np.uint64(1), 1
            while halves:
                if halves & np.uint64(3) == np.uint64(3):
                    board[row, col, height] = steps
                halves >>= np.uint64(2)
                height += 1


@kernel(error_model="numpy")
def _follow(
    mask: HeightMask,
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    end: float,
    low: float,
    high: float,
    halves: int,
) -> None:
    """Note one ray's heights, in halves, in the cells that it passes: a step a cell along its longer axis."""
    begin = 0.0
    # Only while it is inside the band.
    if dz < 0.0:
        begin, end = max(begin, (high - z) / dz), min(end, (low - z) / dz)
    elif dz > 0.0:
        begin, end = max(begin, (low - z) / dz), min(end, (high - z) / dz)
    elif not low < z < high:
        return
    longer = max(abs(dx), abs(dy))
    if not (begin < end and longer > 0.0):
        return
    step = 1.0 / longer
    a_meter = halves / (high - low)
    at = begin
    while at < end:
        until = min(at + step, end)
        middle = 0.5 * (at + until)
        row, col = int(y + middle * dy), int(x + middle * dx)
        if 0 <= row < mask.shape[0] and 0 <= col < mask.shape[1]:
            one = int((z + at * dz - low) * a_meter)
            other = int((z + until * dz - low) * a_meter)
            for half in range(max(0, min(one, other)), min(halves - 1, max(one, other)) + 1):
                mask[row, col] |= np.uint64(2) << np.uint64(half)
        at = until
