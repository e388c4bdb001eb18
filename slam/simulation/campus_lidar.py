"""Simulates a lidar on a campus: walls, glass, and people who walk by."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from slam.measurements import FloatArray, LaserScan, pose2_from_row
from slam.simulation.campus_drive import travelled_m
from slam.simulation.campus_plan import Campus
from slam.simulation.floor_plan import cast_rays
from slam.simulation.steering import STEP_S

RANGE_MAX_M = 80.0
_T_BASE_LASER = gtsam.Pose2(0.1, 0.0, 0.0)
_BEAMS, _STEP_RAD = 180, math.radians(1.0)
_START_RAD = -0.5 * (_BEAMS - 1) * _STEP_RAD
_RANGE_SIGMA_M, _RANGE_DECIMALS = 0.01, 2  # a SICK LMS reports whole centimetres
_GLASS_SHARE = 0.6  # share of the beams that go through
_RADIUS_M, _POLITE_M = 0.2, 0.5  # radius of a person, and distance between a person's and the robot's centre
_CORNERS = 8


class CampusLidar:
    """A lidar, and the people of a drive.

    Each person walks for a while on a straight line ahead of the robot beside its path, towards it or away.

    Parameters
    ----------
    poses_xyt
        (N, 3) poses of the base during the drive, `STEP_S` apart.
    rng
        Random generator, used first for people, then for each scan.
    """

    def __init__(
        self, campus: Campus, poses_xyt: FloatArray, encounters_per_m: float, rng: np.random.Generator
    ) -> None:
        self._campus, self._poses, self._rng = campus, poses_xyt, rng
        driven_m = travelled_m(poses_xyt)
        count = round(driven_m[-1] * encounters_per_m)
        first = np.searchsorted(driven_m[:-1], rng.uniform(0.0, driven_m[-1], count))
        self._begin_s, self._stay_s = first * STEP_S, rng.uniform(5.0, 20.0, count)
        heading = poses_xyt[first, 2]
        along = np.column_stack([np.cos(heading), np.sin(heading)])
        aside = rng.choice([-1.0, 1.0], (count, 1)) * rng.uniform(0.4, 0.7, (count, 1))
        self._start_m = poses_xyt[first, :2] + rng.uniform(2.0, 12.0, (count, 1)) * along
        self._start_m += aside * np.column_stack([-along[:, 1], along[:, 0]])
        self._velocity = rng.uniform(-1.2, 1.2, (count, 1)) * along

    def scan(self, step: int, stamp_s: float) -> LaserScan:
        """Return the scan at a step of the drive, taken at an instant."""
        laser = pose2_from_row(self._poses[step]) * _T_BASE_LASER
        origin = np.array([laser.x(), laser.y()])
        bearings = laser.theta() + _START_RAD + _STEP_RAD * np.arange(_BEAMS, dtype=np.float64)
        solid = np.concatenate([self._campus.walls_m, self._people(step)])
        solid_m, glass_m = (
            cast_rays(_near(segments, origin), origin, bearings) for segments in (solid, self._campus.glass_m)
        )
        through = self._rng.random(_BEAMS) < _GLASS_SHARE
        ranges_m = np.where(through, solid_m, np.minimum(solid_m, glass_m))
        ranges_m = np.round(ranges_m + _RANGE_SIGMA_M * self._rng.standard_normal(_BEAMS), _RANGE_DECIMALS)
        reported_m = np.where(ranges_m < RANGE_MAX_M, ranges_m, np.inf).astype(np.float32)
        return LaserScan(stamp_s, reported_m, _START_RAD, _STEP_RAD, RANGE_MAX_M, _T_BASE_LASER)

    def _people(self, step: int) -> FloatArray:
        """Return the outlines of all persons present, (8 n, 4), at a least distance from the robot."""
        since_s = step * STEP_S - self._begin_s
        about = (since_s >= 0.0) & (since_s < self._stay_s)
        places = self._start_m[about] + since_s[about, None] * self._velocity[about]
        places = places[np.linalg.norm(places - self._poses[step, :2], axis=1) > _POLITE_M]
        angles = 2.0 * math.pi / _CORNERS * np.arange(_CORNERS)
        corners = places[:, None] + _RADIUS_M * np.column_stack([np.cos(angles), np.sin(angles)])
        return np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 4)


def _near(segments_m: FloatArray, origin_m: FloatArray) -> FloatArray:
    """Return the segments that may be within the range."""
    away_m = np.linalg.norm(0.5 * (segments_m[:, :2] + segments_m[:, 2:]) - origin_m, axis=1)
    return segments_m[
        away_m < RANGE_MAX_M + 0.5 * np.linalg.norm(segments_m[:, 2:] - segments_m[:, :2], axis=1)
    ]
