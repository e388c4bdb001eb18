"""From a lidar sweep to points with surface normals, in the base frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from slam.measurements import BoolArray, Float32Array, FloatArray, LaserScan

# A surface patch is a line when its thickness is below this: floor [m2] plus share of its length squared.
_LINE_THICKNESS_FLOOR_M2 = 0.02**2
_LINE_THICKNESS_SHARE = 0.02
# A line whose direction is less sure than this is fitted again over more neighbours.
_GREATEST_NORMAL_SIGMA_RAD = 0.06


@dataclass(frozen=True, slots=True)
class ScanPoints:
    """The returns of one sweep.

    Attributes
    ----------
    points_base
        (M, 2) metres, base frame.
    normals_base
        (M, 2) unit normals that face the sensor; zero where the neighbourhood is no line.
    """

    points_base: Float32Array
    normals_base: Float32Array

    def __len__(self) -> int:
        return int(self.points_base.shape[0])

    def oriented(self) -> tuple[Float32Array, Float32Array]:
        """Only the points that have a normal: (K, 2) points and (K, 2) normals."""
        known = (self.normals_base != 0.0).any(axis=1)
        return self.points_base[known], self.normals_base[known]


def extract_points(scan: LaserScan, range_min_m: float, range_max_m: float, neighbours: int) -> ScanPoints:
    """Turn a sweep into base-frame points, each with the normal of its local line.

    Parameters
    ----------
    scan
        The sweep; ``inf`` and ``nan`` readings are left out.
    range_min_m, range_max_m
        Readings outside are left out.
    neighbours
        How many beams on each side may join the line fit; they stop at a gap in the surface.
    """
    bearings = scan.bearings_rad()
    ranges = scan.ranges_m.astype(np.float64)
    with np.errstate(invalid="ignore"):
        usable = (ranges > range_min_m) & (ranges < range_max_m)
    ranges = np.where(usable, ranges, 0.0)
    points = np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])
    normals = _line_normals(points, usable, abs(scan.step_rad), neighbours)
    mount = scan.T_base_laser
    cos, sin = math.cos(mount.theta()), math.sin(mount.theta())
    rotation_t = np.array([[cos, sin], [-sin, cos]])
    points_base = points[usable] @ rotation_t + np.array([mount.x(), mount.y()])
    return ScanPoints(points_base.astype(np.float32), (normals[usable] @ rotation_t).astype(np.float32))


def orient_points(points: FloatArray, range_min_m: float, range_max_m: float, neighbours: int) -> ScanPoints:
    """Give points their normals, as `extract_points` does those of a sweep.

    Parameters
    ----------
    points
        (M, 2) finite, in any order, all seen from the frame's origin: of one sweep.
    range_min_m, range_max_m, neighbours
        As in `extract_points`; points outside are left out.
    """
    bearings = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearings, kind="stable")
    points, ranges = points[order], np.hypot(points[order, 0], points[order, 1])
    usable = (ranges > range_min_m) & (ranges < range_max_m)
    # Most beams met something: the usual step between points is that between beams.
    step_rad = float(np.median(np.diff(bearings[order]))) if len(points) > 1 else 0.0
    normals = _line_normals(points, usable, step_rad, neighbours)
    return ScanPoints(points[usable].astype(np.float32), normals[usable].astype(np.float32))


@numba.njit(cache=True)
def _line_normals(points: FloatArray, usable: BoolArray, step_rad: float, neighbours: int) -> FloatArray:
    """Principal-axis line fit over the connected neighbours of each beam; zero where it is no line.

    A fine beam spacing with a noisy range makes short patches whose direction is noise: where the fit says
    so, it is done again over four times as many neighbours.
    """
    count = points.shape[0]
    normals = np.zeros((count, 2))
    for i in range(count):
        if not usable[i]:
            continue
        line = _fit_line(points, usable, step_rad, i, neighbours)
        if line[1] > _GREATEST_NORMAL_SIGMA_RAD:
            line = _fit_line(points, usable, step_rad, i, 4 * neighbours)
        if math.isinf(line[1]):
            continue
        nx = -math.sin(line[0])
        ny = math.cos(line[0])
        facing = 1.0 if nx * points[i, 0] + ny * points[i, 1] <= 0.0 else -1.0
        normals[i, 0] = facing * nx
        normals[i, 1] = facing * ny
    return normals


@numba.njit(cache=True)
def _fit_line(
    points: FloatArray, usable: BoolArray, step_rad: float, i: int, neighbours: int
) -> tuple[float, float]:
    """Direction of the line through beam i and up to ``neighbours`` a side, and its standard deviation.

    Both in radians; the standard deviation is infinite where the points make no line.
    """
    sx = sy = sxx = sxy = syy = 0.0
    members = 1
    for direction in (-1, 1):
        j = i
        for hop in range(neighbours):
            following = j + direction
            if following < 0 or following >= points.shape[0] or not usable[following]:
                break
            range_m = math.hypot(points[j, 0], points[j, 1])
            # A surface seen at up to 72 degrees incidence spaces its points 3 beam widths apart.
            gap = math.hypot(points[following, 0] - points[j, 0], points[following, 1] - points[j, 1])
            if gap > 0.1 + 3.0 * range_m * step_rad:
                break
            dx = points[following, 0] - points[i, 0]
            dy = points[following, 1] - points[i, 1]
            # Two neighbours a side are always taken; more only while the patch stays small.
            if hop >= 2 and math.hypot(dx, dy) > 0.3:
                break
            j = following
            sx += dx
            sy += dy
            sxx += dx * dx
            sxy += dx * dy
            syy += dy * dy
            members += 1
    if members < 3:
        return 0.0, math.inf
    cxx = sxx / members - (sx / members) ** 2
    cxy = sxy / members - (sx / members) * (sy / members)
    cyy = syy / members - (sy / members) ** 2
    spread = math.sqrt((cxx - cyy) ** 2 + 4.0 * cxy * cxy)
    long_axis = 0.5 * (cxx + cyy + spread)
    short_axis = max(0.5 * (cxx + cyy - spread), 0.0)
    if long_axis < 1e-6 or short_axis > _LINE_THICKNESS_FLOOR_M2 + _LINE_THICKNESS_SHARE * long_axis:
        return 0.0, math.inf
    sigma_rad = math.sqrt(short_axis / (long_axis * members))
    return 0.5 * math.atan2(2.0 * cxy, cxx - cyy), sigma_rad
