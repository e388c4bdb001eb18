"""A differential drive that follows a path by pure pursuit, within limits of speed and acceleration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.measurements import FloatArray

STEP_S = 0.02  # twist is constant within a step, so poses in between are exact arcs

_TURN_GAIN = 2.5  # 1/s: angular rate per radian of heading error; 2 v / lookahead for the usual values
_STANDING_TURN_RAD = 0.7  # above this heading error, the robot turns on the spot
_ARRIVED_M = 0.08


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """Limits of the wheels.

    Attributes
    ----------
    speed_m_s, turn_rate_rad_s
        Largest speed (forward only) and turn rate.
    acceleration_m_s2, turn_acceleration_rad_s2
        Largest change of them.
    """

    speed_m_s: float = 0.5
    turn_rate_rad_s: float = 0.8
    acceleration_m_s2: float = 0.5
    turn_acceleration_rad_s2: float = 1.6


def follow_path(
    path_m: FloatArray,
    speed_share: FloatArray,
    start_yaw_rad: float,
    limits: DriveLimits,
    lookahead_m: float,
    duration_s: float,
    *,
    closed: bool,
) -> tuple[FloatArray, FloatArray]:
    """Drive along a path from its first point.

    Parameters
    ----------
    path_m
        (N, 2) closely spaced points, map frame.
    speed_share
        (N,) allowed share of the top speed at each point, above 0 up to 1.
    duration_s
        Longest drive.
    closed
        The path is a loop; otherwise the robot brakes and stops at its end.

    Returns
    -------
    FloatArray
        (M, 3) rows of x, y, yaw (not wrapped), `STEP_S` apart.
    FloatArray
        (M, 2) rows of speed and turn rate, constant from one row to the next.
    """
    follower = _Follower(path_m, speed_share, limits, lookahead_m, closed)
    x, y, yaw = float(path_m[0, 0]), float(path_m[0, 1]), start_yaw_rad
    speed = turn = 0.0
    poses, twists = [], []
    for _ in range(math.ceil(duration_s / STEP_S - 1e-9) + 1):
        wanted_speed, wanted_turn = follower.command(x, y, yaw)
        speed += limited(wanted_speed - speed, limits.acceleration_m_s2 * STEP_S)
        turn += limited(wanted_turn - turn, limits.turn_acceleration_rad_s2 * STEP_S)
        poses.append((x, y, yaw))
        twists.append((speed, turn))
        if follower.arrived and speed == 0.0 and turn == 0.0:
            break
        x, y, yaw = advance(x, y, yaw, speed, turn, STEP_S)
    return np.array(poses), np.array(twists)


def advance(
    x_m: float, y_m: float, yaw_rad: float, speed: float, turn: float, time_s: float
) -> tuple[float, float, float]:
    """Return the pose after a time of constant twist: an exact arc."""
    angle = turn * time_s
    half = 0.5 * angle
    # sin(a/2) / (a/2): the chord for an arc of length one.
    chord = speed * time_s * (math.sin(half) / half) if half else speed * time_s
    heading = yaw_rad + half
    return x_m + chord * math.cos(heading), y_m + chord * math.sin(heading), yaw_rad + angle


class _Follower:
    """Target point on the path for pure pursuit."""

    def __init__(
        self,
        path_m: FloatArray,
        speed_share: FloatArray,
        limits: DriveLimits,
        lookahead_m: float,
        closed: bool,
    ) -> None:
        self._x, self._y = path_m[:, 0].tolist(), path_m[:, 1].tolist()
        self._share = speed_share.tolist()
        lengths = np.linalg.norm(np.diff(path_m, axis=0), axis=1)
        self._left_m = np.concatenate([np.cumsum(lengths[::-1])[::-1], [0.0]]).tolist()
        self._limits, self._lookahead_m, self._closed = limits, lookahead_m, closed
        self._at = 0
        self.arrived = False

    def command(self, x: float, y: float, yaw: float) -> tuple[float, float]:
        """Return the desired speed and angular rate."""
        distance = self._advance(x, y)
        limits, at = self._limits, self._at
        bearing = math.remainder(math.atan2(self._y[at] - y, self._x[at] - x) - yaw, 2.0 * math.pi)
        if not self._closed and at == len(self._x) - 1 and distance < _ARRIVED_M:
            self.arrived = True
        if self.arrived:
            return 0.0, 0.0
        speed = limits.speed_m_s * self._share[at] * max(0.0, 1.0 - abs(bearing) / _STANDING_TURN_RAD)
        if not self._closed:
            left_m = max(0.0, self._left_m[at] + distance - 0.5 * _ARRIVED_M)
            speed = min(speed, math.sqrt(1.6 * limits.acceleration_m_s2 * left_m))
        # Near the goal angle, no faster than can be braked in time.
        brakes = math.sqrt(1.6 * limits.turn_acceleration_rad_s2 * abs(bearing))
        turn = min(_TURN_GAIN * abs(bearing), limits.turn_rate_rad_s, brakes)
        return speed, math.copysign(turn, bearing)

    def _advance(self, x: float, y: float) -> float:
        """Advance to the first point at the lookahead distance; return its distance."""
        count = len(self._x)
        while True:
            distance = math.hypot(self._x[self._at] - x, self._y[self._at] - y)
            if distance >= self._lookahead_m:
                return distance
            if self._at + 1 < count:
                self._at += 1
            elif self._closed:
                self._at = 0
            else:
                return distance


def limited(change: float, limit: float) -> float:
    """Return a change, clipped at the limit."""
    return max(-limit, min(limit, change))
