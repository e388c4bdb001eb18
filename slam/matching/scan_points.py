"""Convert a lidar sweep to points with surface normals, in the base frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np

from fusion.kernel import ZERO, kernel
from slam.config.stages import ScanConfig
from slam.measurements import BoolArray, Float32Array, FloatArray, LaserScan

# A surface patch is a line when its thickness is below this: floor [m2] plus share of its length squared.
_LINE_THICKNESS = 0.02
# The largest distance of surfels to which a point is matched.
_WALL_SPACING_M = 0.2
# A line with a less certain direction is fitted again over more neighbours.
_GREATEST_NORMAL_SIGMA_RAD = 0.06


def _no_points() -> Float32Array:
    return np.zeros((0, 2), np.float32)


@dataclass(frozen=True)
class ScanPoints:
    """The returns of one sweep.

    Attributes
    ----------
    points_base
        (M, 2) metres, base frame.
    normals_base
        (M, 2) unit normals that face the sensor; zero where the neighbourhood is no line.
    walls_base, wall_normals_base
        (K, 2) each: points between readings that are far apart on a wall seen at a flat angle. They belong to
        a map, but not to a scan that is matched.
    """

    points_base: Float32Array
    normals_base: Float32Array
    walls_base: Float32Array = field(default_factory=_no_points)
    wall_normals_base: Float32Array = field(default_factory=_no_points)

    @classmethod
    def none(cls) -> ScanPoints:
        """Return no points."""
        return cls(_no_points(), _no_points())

    def __len__(self) -> int:
        return int(self.points_base.shape[0])

    def oriented(self) -> tuple[Float32Array, Float32Array]:
        """Return the points with a normal: (K, 2) points and (K, 2) normals."""
        return self._oriented

    @cached_property
    def _oriented(self) -> tuple[Float32Array, Float32Array]:
        """Computed once: a scan is queried several times."""
        # By indices: a mask of rows takes numpy twice as long.
        known = ((self.normals_base[:, 0] != 0.0) | (self.normals_base[:, 1] != 0.0)).nonzero()[0]
        return self.points_base.take(known, axis=0), self.normals_base.take(known, axis=0)


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
    beams = scan.ranges_m.size
    points, usable = np.empty((beams, 2)), np.empty(beams, np.bool_)
    directions = _directions(scan.start_angle_rad, scan.step_rad, beams)
    _points_of(scan.ranges_m, directions, range_min_m, range_max_m, points, usable)
    yaw_rad, at = scan.T_base_laser.theta(), scan.T_base_laser.translation()
    placed = math.cos(yaw_rad), math.sin(yaw_rad), float(at[0]), float(at[1])
    walls = np.empty((2, beams, 2), np.float32)
    while (count := _walls_between(points, usable, *placed, *walls)) > walls.shape[1]:
        walls = np.empty((2, count, 2), np.float32)
    oriented = _with_normals(points, usable, abs(scan.step_rad), neighbours, placed)
    return ScanPoints(*oriented, walls[0, :count], walls[1, :count])


def points_by(settings: ScanConfig, scan: LaserScan) -> ScanPoints:
    """Return `extract_points` with the configuration."""
    return extract_points(scan, settings.range_min_m, settings.range_max_m, settings.neighbours)


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
    return ScanPoints(*_with_normals(points, usable, step_rad, neighbours, (1.0, 0.0, 0.0, 0.0)))


def _with_normals(
    points: FloatArray,
    usable: BoolArray,
    step_rad: float,
    neighbours: int,
    placed: tuple[float, float, float, float],
) -> tuple[Float32Array, Float32Array]:
    """The usable ones of (N, 2) points, and their normals, base frame; see `_line_normals`."""
    onward = np.zeros(points.shape, np.bool_)
    oriented, normals = np.empty((2, *points.shape), np.float32)
    count = _line_normals(points, usable, step_rad, neighbours, onward, *placed, oriented, normals)
    return oriented[:count], normals[:count]


@lru_cache(maxsize=8)
def _directions(start_angle_rad: float, step_rad: float, count: int) -> FloatArray:
    """(count, 2) unit vectors along the beams."""
    bearings = start_angle_rad + step_rad * np.arange(count, dtype=np.float64)
    return np.column_stack([np.cos(bearings), np.sin(bearings)])


@kernel
def _points_of(ranges, directions, range_min_m, range_max_m, points, usable):  # type: ignore[no-untyped-def]
    """The point of every reading, laser frame, and whether it is within the limits."""
    for i in range(ranges.size):
        range_m = np.float64(ranges[i])
        usable[i] = range_min_m < range_m < range_max_m
        reach_m = range_m if usable[i] else 0.0
        points[i, 0] = reach_m * directions[i, 0]
        points[i, 1] = reach_m * directions[i, 1]


@kernel
def _walls_between(points, usable, cos, sin, at_x, at_y, walls, normals):  # type: ignore[no-untyped-def]
    """How many points lie on walls between neighbouring beams far apart whose four readings are on one line.

    They go to ``walls`` and ``normals`` (K, 2), base frame, where there is room. Nothing can stand between
    two neighbouring beams but what is smaller than they are apart.
    """
    count = ZERO
    for i in range(1, points.shape[0] - 2):
        if not (usable[i - 1] and usable[i] and usable[i + 1] and usable[i + 2]):
            continue
        dx = points[i + 1, 0] - points[i, 0]
        dy = points[i + 1, 1] - points[i, 1]
        if dx * dx + dy * dy <= _WALL_SPACING_M * _WALL_SPACING_M:
            continue
        length = math.hypot(dx, dy)
        dx /= length
        dy /= length
        straight = True
        for side in range(-1, 2, 2):
            # From the nearer end of the gap to the reading beyond it.
            j = i + (1 + side) // 2
            ax = points[j + side, 0] - points[j, 0]
            ay = points[j + side, 1] - points[j, 1]
            along = side * (ax * dx + ay * dy)
            # A close reading hardly determines the direction: two objects in a row are no wall.
            thickest = _LINE_THICKNESS * (1.0 + along / length)
            straight = straight and 3.0 * along > length and abs(ay * dx - ax * dy) <= thickest
        if not straight:
            continue
        facing = 1.0 if dy * points[i, 0] - dx * points[i, 1] <= 0.0 else -1.0
        parts = math.ceil(length / _WALL_SPACING_M)
        for n in range(parts + 1):
            if count < walls.shape[0]:
                x = points[i, 0] + n * length / parts * dx
                y = points[i, 1] + n * length / parts * dy
                walls[count, 0] = cos * x - sin * y + at_x
                walls[count, 1] = sin * x + cos * y + at_y
                normals[count, 0] = facing * (cos * dy + sin * dx)
                normals[count, 1] = facing * (sin * dy - cos * dx)
            count += 1
    return count


@kernel
def _line_normals(  # type: ignore[no-untyped-def]
    points, usable, step_rad, neighbours, onward, cos, sin, at_x, at_y, oriented, normals
):
    """Principal-axis line fit over the connected neighbours of each beam; how many are usable.

    They go to ``oriented``, their normals to ``normals`` (N, 2), base frame; zero where it is no line.

    A fine beam spacing with a noisy range makes short patches whose direction is noise: where the fit says
    so, it is done again over four times as many neighbours.

    ``onward`` (N, 2) is for how the surface goes on from each beam to the one before and to the one after.
    """
    for i in range(points.shape[0] - 1):
        x = points[i, 0]
        y = points[i, 1]
        next_x = points[i + 1, 0]
        next_y = points[i + 1, 1]
        dx = next_x - x
        dy = next_y - y
        gap = math.sqrt(dx * dx + dy * dy) if usable[i] and usable[i + 1] else math.inf
        # A surface seen at up to 72 degrees incidence spaces its points 3 beam widths apart.
        onward[i, 1] = gap <= 0.1 + 3.0 * math.sqrt(x * x + y * y) * step_rad
        onward[i + 1, 0] = gap <= 0.1 + 3.0 * math.sqrt(next_x * next_x + next_y * next_y) * step_rad
    count = ZERO
    for i in range(points.shape[0]):
        if not usable[i]:
            continue
        x = points[i, 0]
        y = points[i, 1]
        angle_rad = 0.0
        sigma_rad = math.inf
        reach = neighbours
        for _ in range(2):
            sx = sy = sxx = sxy = syy = 0.0
            members = 1.0
            for side in range(2):
                j = i
                for hop in range(reach):
                    if not onward[j, side]:
                        break
                    j += 2 * side - 1
                    dx = points[j, 0] - x
                    dy = points[j, 1] - y
                    # Two neighbours a side are always taken; more only while the patch stays small.
                    if hop >= 2 and dx * dx + dy * dy > 0.3**2:
                        break
                    sx += dx
                    sy += dy
                    sxx += dx * dx
                    sxy += dx * dy
                    syy += dy * dy
                    members += 1.0
            mean_x = sx / members
            mean_y = sy / members
            cxx = sxx / members - mean_x * mean_x
            cxy = sxy / members - mean_x * mean_y
            cyy = syy / members - mean_y * mean_y
            difference = cxx - cyy
            spread = math.sqrt(difference * difference + 4.0 * cxy * cxy)
            long_axis = 0.5 * (cxx + cyy + spread)
            short_axis = max(0.5 * (cxx + cyy - spread), 0.0)
            thickest = _LINE_THICKNESS**2 + _LINE_THICKNESS * long_axis
            sigma_rad = math.inf
            if members > 2.5 and long_axis >= 1e-6 and short_axis <= thickest:
                sigma_rad = math.sqrt(short_axis / (long_axis * members))
                angle_rad = 0.5 * math.atan2(2.0 * cxy, difference)
            if sigma_rad <= _GREATEST_NORMAL_SIGMA_RAD:
                break
            reach *= 4
        nx = ny = 0.0
        if sigma_rad < math.inf:
            nx = -math.sin(angle_rad)
            ny = math.cos(angle_rad)
            if nx * x + ny * y > 0.0:
                nx, ny = -nx, -ny
        oriented[count, 0] = cos * x - sin * y + at_x
        oriented[count, 1] = sin * x + cos * y + at_y
        normals[count, 0] = cos * nx - sin * ny
        normals[count, 1] = sin * nx + cos * ny
        count += 1
    return count
