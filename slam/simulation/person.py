"""A person who walks through the home and avoids the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.errors import ConfigError
from slam.measurements import FloatArray
from slam.simulation.home_model import Home
from slam.simulation.steering import DriveLimits
from slam.simulation.tour import Tour, plan_tour

_STEP_S = 0.1
_RADIUS_M, _HEIGHT_M = 0.22, 1.8
_LIMITS = DriveLimits(speed_m_s=0.9, turn_rate_rad_s=2.5, acceleration_m_s2=1.5, turn_acceleration_rad_s2=8.0)
_POLITE_M = 0.9  # distance of the centres below which the person waits or steps back
_ASIDE_M = 0.55  # below this distance, the person has stepped aside, out of sight


@dataclass(frozen=True, slots=True)
class Walk:
    """Trajectory of the person.

    Attributes
    ----------
    positions_m
        (N, 2) map frame, 0.1 s apart; NaN while out of sight.
    """

    positions_m: FloatArray

    def at(self, time_s: float) -> tuple[float, float] | None:
        """Return the position at a time since the start; None while out of sight."""
        share = min(max(time_s / _STEP_S, 0.0), len(self.positions_m) - 1.0)
        before = int(share)
        after = min(before + 1, len(self.positions_m) - 1)
        x, y = (1.0 - (share - before)) * self.positions_m[before] + (share - before) * self.positions_m[
            after
        ]
        return None if math.isnan(x) else (float(x), float(y))


def plan_walk(home: Home, robot: Tour, seed: int) -> Walk:
    """Plan a walk as long as the robot's tour, through the same rooms in another order.

    Raises
    ------
    ConfigError
        No room for a person.
    """
    # Starts half way, so that the person is not at the robot's start.
    try:
        path = plan_tour(home, _RADIUS_M, _HEIGHT_M, seed, 1.5 * robot.duration_s + 60.0, _LIMITS)
    except ConfigError as error:
        raise ConfigError(f"no room for a person: {error}; simulate without the person") from error
    count = math.ceil(robot.duration_s / _STEP_S) + 1
    robots = robot.poses_at(_STEP_S * np.arange(count, dtype=np.float64))[:, :2]
    at_s = min(0.5 * path.lap_s, 0.3 * path.duration_s)
    positions = np.empty((count, 2))
    for index in range(count):
        choices = [at_s + _STEP_S, at_s, max(0.0, at_s - _STEP_S)]
        places = path.poses_at(np.array(choices))[:, :2]
        distances = np.linalg.norm(places - robots[index], axis=1)
        polite = np.flatnonzero(distances >= _POLITE_M)
        choice = int(polite[0]) if polite.size else int(np.argmax(distances))
        at_s = choices[choice]
        positions[index] = places[choice] if distances[choice] >= _ASIDE_M else np.nan
    return Walk(positions)
