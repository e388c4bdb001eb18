"""Gravity at the keyframes, in the form that enters the graph of the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slam.matching.upright import Gravity
from slam.measurements import GRAVITY_M_S2
from slam.odometry.imu_readings import FORCE_WALK


def apart_in_time(directions: dict[int, Gravity]) -> dict[int, Gravity]:
    """Return directions by keyframe, with covariances scaled by the number that shares one error.

    The accelerometer's bias tilts gravity, and stays the same until it has drifted by its uncertainty: the
    directions of that time count as one.
    """
    stamps_s = np.array([gravity.stamp_s for gravity in directions.values()])
    scaled = {}
    for key, gravity in directions.items():
        shared_s = (gravity.sigma_rad * GRAVITY_M_S2 / FORCE_WALK) ** 2
        sharing = int(np.count_nonzero(np.abs(stamps_s - gravity.stamp_s) <= 0.5 * shared_s))
        scaled[key] = replace(gravity, sigma_rad=gravity.sigma_rad * float(np.sqrt(sharing)))
    return scaled
