"""Plans a car's drive through a town: along its lane, around sharp corners, at the fastest safe speed."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy import interpolate, ndimage

from slam.measurements import FloatArray
from slam.simulation.route import resample
from slam.simulation.street_plan import LANE_M, Ground, Town

_SPEED_M_S, _SLOWEST_M_S = 8.0, 0.5
SIDEWARD_M_S2, _ONWARD_M_S2 = 2.5, 1.5
_CORNER_M = 5.0  # radius
_SPACING_M, _SMOOTHING_M = 0.25, 0.8
_TOWN_M = 1500.0  # of planned path


@dataclass(frozen=True, slots=True)
class StreetDrive:
    """Motion of the car, twice differentiable in time.

    Attributes
    ----------
    planar
        x, y and yaw (not wrapped) of the base as functions of seconds since the start.
    duration_s
        Duration of the planned drive.
    path_m
        Distance driven as a function of seconds.
    """

    planar: interpolate.CubicSpline
    path_m: interpolate.CubicSpline
    duration_s: float
    ground: Ground

    def poses_at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Rotations (N, 3, 3) and positions (N, 3) of the base in the map: on the road, perpendicular to it.

        Parameters
        ----------
        times_s
            (N,) seconds since the start.
        """
        x, y, yaw = self.planar(times_s).T
        return road_poses(self.ground, x, y, yaw)


def road_poses(
    ground: Ground, x: FloatArray, y: FloatArray, yaw: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotations (N, 3, 3) and positions (N, 3) of objects on the road with a heading."""
    rise_x, rise_y = ground.slope(x, y)
    up = np.column_stack([-rise_x, -rise_y, np.ones_like(x)])
    up /= np.linalg.norm(up, axis=1)[:, None]
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.cos(yaw) * rise_x + np.sin(yaw) * rise_y])
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    rotations = np.stack([ahead, np.cross(up, ahead), up], axis=2)
    return rotations, np.column_stack([x, y, ground.height_m(x, y)])


def drive_street(town: Town, rng: np.random.Generator, sideward_m_s2: float = SIDEWARD_M_S2) -> StreetDrive:
    """Drive around one block first, to revisit places, then at random; or straight through a tunnel.

    Parameters
    ----------
    sideward_m_s2
        Lateral acceleration in corners.
    """
    corners = _lane(town, _junctions(town, rng))
    path = resample(_rounded(corners), _SPACING_M)
    sigma = _SMOOTHING_M / _SPACING_M
    path = resample(ndimage.gaussian_filter1d(path, sigma, axis=0, mode="nearest"), _SPACING_M)
    steps = np.diff(path, axis=0)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    step_m = np.linalg.norm(steps, axis=1)
    turn = np.abs(np.gradient(headings)) / step_m
    speeds = np.minimum(_SPEED_M_S, np.sqrt(sideward_m_s2 / np.maximum(turn, 1e-6)))
    speeds[0] = _SLOWEST_M_S
    for order in (1, -1):
        ordered = speeds[::order]
        for index in range(1, len(ordered)):
            limit = ordered[index - 1] ** 2 + 2.0 * _ONWARD_M_S2 * float(step_m[index])
            ordered[index] = min(float(ordered[index]), limit**0.5)
    speeds = ndimage.gaussian_filter1d(speeds, 2.0 * sigma, mode="nearest")
    middles = 0.5 * (path[1:] + path[:-1])
    apart_m = np.linalg.norm(np.diff(middles, axis=0), axis=1)
    times = np.concatenate([[0.0], np.cumsum(2.0 * apart_m / (speeds[1:] + speeds[:-1]))])
    driven = np.concatenate([[0.0], np.cumsum(apart_m)])
    planar = interpolate.CubicSpline(times, np.column_stack([middles, headings]))
    return StreetDrive(planar, interpolate.CubicSpline(times, driven), float(times[-1]), town.ground)


def _junctions(town: Town, rng: np.random.Generator) -> FloatArray:
    """Crossings (N, 2) of a random walk without U-turns."""
    if town.tunnel_m is not None:
        return np.array([[town.low_m[0] + 5.0, 0.0], [town.high_m[0] - 20.0, 0.0]])
    column, row = int(rng.integers(0, 3)), int(rng.integers(0, 3))
    block = [(column, row), (column + 1, row), (column + 1, row + 1), (column, row + 1)]
    block = block[::-1] if rng.random() < 0.5 else block
    walk, way_m = [*block, *block[:3]], 0.0
    while way_m < _TOWN_M:
        (before_x, before_y), (x, y) = walk[-2:]
        onward = [
            (x + right, y + up)
            for right, up in ((1, 0), (-1, 0), (0, 1), (0, -1))
            if 0 <= x + right < len(town.across_x) and 0 <= y + up < len(town.across_y)
        ]
        onward.remove((before_x, before_y))
        straight = (2 * x - before_x, 2 * y - before_y)
        turns = [exit_ for exit_ in onward if exit_ != straight]
        walk.append(
            straight if straight in onward and rng.random() < 0.35 else turns[rng.integers(len(turns))]
        )
        way_m += 50.0
    return np.array([(town.across_x[column], town.across_y[row]) for column, row in walk])


def _lane(town: Town, junctions: FloatArray) -> FloatArray:
    """Corners (N, 2) of the path on the right side of the streets."""
    steps = np.diff(junctions, axis=0)
    along = steps / np.linalg.norm(steps, axis=1)[:, None]
    right = LANE_M * np.column_stack([along[:, 1], -along[:, 0]])
    inner = []
    for place, (before, after), (one, other) in zip(
        junctions[1:-1], itertools.pairwise(along), itertools.pairwise(right), strict=True
    ):
        inner.append(place + one + (other if abs(before @ after) < 0.5 else 0.0))
    start = junctions[0] + right[0] + (along[0] * 15.0 if town.tunnel_m is None else 0.0)
    return np.array([start, *inner, junctions[-1] + right[-1]])


def _rounded(corners: FloatArray) -> FloatArray:
    """Replace the corners of a polyline by arcs, (N, 2)."""
    points = [corners[:1]]
    for before, corner, after in zip(corners, corners[1:], corners[2:], strict=False):
        back = (before - corner) / np.linalg.norm(before - corner)
        onward = (after - corner) / np.linalg.norm(after - corner)
        if abs(back @ onward) < 0.5:
            centre = corner + _CORNER_M * (back + onward)
            turn = np.linspace(0.0, 0.5 * np.pi, 12)[:, None]
            points.append(centre - _CORNER_M * (np.cos(turn) * onward + np.sin(turn) * back))
    return np.vstack([*points, corners[-1:]])
