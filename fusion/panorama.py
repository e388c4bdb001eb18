"""Depth images as panoramas: ranges at equal bearings and slopes, and the curves cut from them.

The columns of a pinhole camera are not equally spaced in angle, its pixels are depths and not ranges, and
a tilted or rotated camera has no level rows. A panorama corrects all three: column k looks along one
bearing, row v along one slope (the tangent of the elevation), so a point of range r in row v is
``slope * r`` above the camera.

Slices of a depth image at one known height, and the pixels around them, are at the resolution of the
image.
"""

# mypy: allow-untyped-decorators
from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.checks import instance
from fusion.curves import (
    EDGE_M,
    HEIGHT_STEP_M,
    NEAREST_M,
    SAMPLE_STEP_RAD,
    STEEPEST,
    Curve,
    DepthImage,
    Float32Array,
    FloatArray,
    IntArray,
)
from fusion.kernel import kernel

_MOST_ROWS = 121


@dataclass(frozen=True)
class Lookup:
    """Pixel of the image for each sample of its panorama.

    Attributes
    ----------
    pixel
        (rows, columns) flat index into the image, -1 outside.
    range_of_depth
        (rows, columns) factor from depth to range.
    slopes
        (rows,) decreasing: row 0 looks highest, as in an image.
    bearings_rad
        (columns,) increasing, relative to the viewing direction of the camera.
    """

    pixel: IntArray
    range_of_depth: Float32Array
    slopes: Float32Array
    bearings_rad: FloatArray


@dataclass(frozen=True)
class CurveStack:
    """Candidates for the curve that the lidar sees: one per height.

    Attributes
    ----------
    ranges_m
        (V, W) ``nan`` if there is no range.
    start_angle_rad, step_rad
        Bearing of the first column in the common level frame, and the step.
    heights_m
        (V,) height of each candidate above the camera.
    """

    ranges_m: Float32Array
    start_angle_rad: float
    step_rad: float
    heights_m: FloatArray

    def bearings_rad(self) -> FloatArray:
        """(W,) bearings of the columns."""
        return self.start_angle_rad + self.step_rad * np.arange(self.ranges_m.shape[1], dtype=np.float64)

    def curve(self, v: int) -> Curve:
        """Return candidate v."""
        return Curve(self.ranges_m[v], self.start_angle_rad, self.step_rad)


Depths: TypeAlias = DepthImage | Sequence[DepthImage]


def as_images(depth: Depths) -> tuple[DepthImage, ...]:
    """Return one or more images as a tuple.

    Raises
    ------
    ValueError
        If there is none, or it is no depth image.
    """
    images = tuple(depth) if isinstance(depth, Sequence) else (depth,)
    if not images:
        raise ValueError("depth is empty; give fusion.DepthImage(depth_m, intrinsics), or several")
    return tuple(instance(image, DepthImage, "depth") for image in images)


def yaw_of(image: DepthImage) -> float:
    """Return the bearing of the optical axis in the level frame."""
    axis = image.R_level_camera[:, 2]
    return math.atan2(axis[1], axis[0])


def lookup_of(image: DepthImage, step_rad: float) -> Lookup:
    """Return the panorama lookup of a camera, relative to its viewing direction."""
    yaw = yaw_of(image)
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ image.R_level_camera
    # Rounded because the yaw varies with the robot's motion; the rest must match the cached key.
    tilt = tuple(np.round(R, 5).ravel().tolist())
    camera = image.intrinsics
    height, width = image.depth_m.shape
    return _lookup((height, width), (camera.fx, camera.fy, camera.cx, camera.cy), tilt, step_rad)


@lru_cache(maxsize=32)
def _lookup(
    shape: tuple[int, int], pinhole: tuple[float, ...], tilt: tuple[float, ...], step_rad: float
) -> Lookup:
    """Rows have the angular resolution of the image; columns are ``step_rad`` apart."""
    fx, fy, cx, cy = pinhole
    R = np.array(tilt).reshape(3, 3)
    edge = _border(shape)
    rays = np.column_stack([(edge[:, 1] - cx) / fx, (edge[:, 0] - cy) / fy, np.ones(len(edge))]) @ R.T
    bearings = np.arctan2(rays[:, 1], rays[:, 0])
    slopes = rays[:, 2] / np.hypot(rays[:, 0], rays[:, 1])
    first, last = math.ceil(bearings.min() / step_rad), math.floor(bearings.max() / step_rad)
    fall = 1.0 / max(fx, fy)
    top = math.floor(min(slopes.max(), STEEPEST) / fall)
    bottom = math.ceil(max(slopes.min(), -STEEPEST) / fall)
    columns = np.arange(first, last + 1) * step_rad
    if not columns.size:
        raise ValueError(
            f"a lens of {pinhole} sees less than a sample of {shape}; give fx, fy, cx, cy in pixels"
        )
    rows = np.arange(top, bottom - 1, -1) * fall
    across, up = np.meshgrid(columns, rows)
    optical = np.stack([np.cos(across), np.sin(across), up], axis=-1) @ R
    ahead = np.where(optical[..., 2] > 1e-3, optical[..., 2], np.nan)
    col, row = np.round(fx * optical[..., 0] / ahead + cx), np.round(fy * optical[..., 1] / ahead + cy)
    inside = (col >= 0) & (col < shape[1]) & (row >= 0) & (row < shape[0])
    pixel = np.where(inside, row * shape[1] + col, -1).astype(np.int32)
    scale = np.where(inside, 1.0 / ahead, np.nan).astype(np.float32)
    return Lookup(pixel, scale, rows.astype(np.float32), columns)


def _border(shape: tuple[int, int]) -> FloatArray:
    """Return (N, 2) row and column of the pixels on the border of an image."""
    rows, cols = np.indices(shape)
    edge = (rows == 0) | (rows == shape[0] - 1) | (cols == 0) | (cols == shape[1] - 1)
    return np.column_stack([rows[edge], cols[edge]]).astype(np.float64)


def height_slices(image: DepthImage, heights_m: FloatArray) -> CurveStack:
    """Find, for every height, the nearest surface seen there, over all bearings of one camera.

    Parameters
    ----------
    heights_m
        (V,) heights above the camera, evenly spaced and increasing; a pixel counts for the nearest one.
    """
    lookup = lookup_of(image, SAMPLE_STEP_RAD)
    spacing = float(heights_m[1] - heights_m[0]) if heights_m.size > 1 else 0.02
    stack = np.full((heights_m.size, lookup.bearings_rad.size), np.inf, dtype=np.float32)
    _drop_into_heights(
        np.ascontiguousarray(image.depth_m, dtype=np.float32).ravel(),
        lookup.pixel,
        lookup.range_of_depth,
        lookup.slopes,
        image.range_max_m,
        (float(heights_m[0]), spacing),
        stack,
    )
    stack[np.isinf(stack)] = np.nan
    start = yaw_of(image) + float(lookup.bearings_rad[0])
    return CurveStack(stack, start, SAMPLE_STEP_RAD, np.asarray(heights_m, dtype=np.float64))


def join(stacks: Sequence[CurveStack]) -> CurveStack:
    """Join the stacks of several cameras as if they had one centre; the nearest surface counts.

    Every stack is moved by at most half a sample, so that all samples are at multiples of the step.
    """
    step = stacks[0].step_rad
    firsts = [round(stack.start_angle_rad / step) for stack in stacks]
    first = min(firsts)
    end = max(at + stack.ranges_m.shape[1] for at, stack in zip(firsts, stacks, strict=True))
    joined = np.full((len(stacks[0].ranges_m), end - first), np.nan, dtype=np.float32)
    for at, stack in zip(firsts, stacks, strict=True):
        window = joined[:, at - first : at - first + stack.ranges_m.shape[1]]
        np.fmin(window, stack.ranges_m, out=window)
    return CurveStack(joined, first * step, step, stacks[0].heights_m)


@kernel
def _drop_into_heights(
    depth: Float32Array,
    pixel: IntArray,
    range_of_depth: Float32Array,
    slopes: Float32Array,
    range_max_m: float,
    grid: tuple[float, float],
    stack: NDArray[np.float32],
) -> None:
    """Write the range of every pixel into its column and height, if it is the nearest; in place."""
    lowest, spacing = grid
    for row in range(pixel.shape[0]):
        slope = slopes[row]
        for col in range(pixel.shape[1]):
            at = pixel[row, col]
            if at < 0:
                continue
            measured = depth[at]
            if not 0.0 < measured <= range_max_m:
                continue
            reach = measured * range_of_depth[row, col]
            v = math.floor((slope * reach - lowest) / spacing + 0.5)
            if 0 <= v < stack.shape[0] and reach < stack[v, col]:
                stack[v, col] = reach


@dataclass(frozen=True)
class ImageView:
    """View of one camera for the repair, at the resolution of its image.

    Attributes
    ----------
    curve
        Ranges at the bearings of the columns.
    low_m, high_m
        Limits of the heights that are as good as that of the curve.
    """

    curve: Curve
    lookup: Lookup
    low_m: float
    high_m: float

    def heights(self, nearest_m: float) -> FloatArray:
        """Return heights to check, so that no row of pixels is missed.

        Parameters
        ----------
        nearest_m
            Smallest range of the lidar's surfaces: there the rows are closest to each other.
        """
        # One step beyond the equally good heights, because walls are vertical.
        low, high = self.low_m - HEIGHT_STEP_M, self.high_m + HEIGHT_STEP_M
        fall = float(self.lookup.slopes[0] - self.lookup.slopes[1])
        rows = min(_MOST_ROWS, 2 + int(np.ceil((high - low) / (nearest_m * fall))))
        return np.linspace(low, high, rows)


def native_step_rad(image: DepthImage) -> float:
    """Return the angle between two columns in the middle of an image."""
    return 1.0 / max(image.intrinsics.fx, image.intrinsics.fy)


def native_slice(image: DepthImage, height_m: float) -> Curve:
    """Find in each column the nearest surface at a height above the camera."""
    step = native_step_rad(image)
    lookup = lookup_of(image, step)
    ranges = _slice(
        np.ascontiguousarray(image.depth_m, dtype=np.float32).ravel(),
        lookup.pixel,
        lookup.range_of_depth,
        lookup.slopes,
        height_m,
        image.range_max_m,
    )
    return Curve(ranges, yaw_of(image) + float(lookup.bearings_rad[0]), step)


@kernel
def _slice(
    depth: Float32Array,
    pixel: IntArray,
    range_of_depth: Float32Array,
    slopes: Float32Array,
    height_m: float,
    range_max_m: float,
) -> NDArray[np.float32]:
    """Return (W,) ranges; computed row by row, as the image is in memory."""
    columns = pixel.shape[1]
    best = np.full(columns, np.nan, np.float32)
    error = np.full(columns, np.inf)
    fall = slopes[0] - slopes[1]
    bounds = (height_m / NEAREST_M, height_m / (1.5 * range_max_m))
    first = max(0, math.floor((slopes[0] - max(bounds)) / fall) - 3)
    last = min(slopes.size - 1, math.ceil((slopes[0] - min(bounds)) / fall) + 3)
    for row in range(first, last + 1):
        slope = slopes[row]
        for col in range(columns):
            at = pixel[row, col]
            if at < 0:
                continue
            value = depth[at]
            if not 0.0 < value <= range_max_m:
                continue
            reach = value * range_of_depth[row, col]
            error_m = abs(slope * reach - height_m)
            # The tolerance is half a pixel, plus noise and the quantisation of the height.
            if error_m > 0.5 * (fall * reach + HEIGHT_STEP_M):
                continue
            nearer = reach < best[col] - EDGE_M
            if np.isnan(best[col]) or nearer or (error_m < error[col] and reach < best[col] + EDGE_M):
                best[col], error[col] = reach, error_m
    return best
