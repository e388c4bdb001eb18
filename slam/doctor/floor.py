"""Finds the floor under a sensor from its points."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from fusion.estimation import FEWEST, SETTLED, gate
from slam.matching.upright import upright_of
from slam.measurements import FloatArray

# Limits of a correct mounting: tilt in radians, height in metres.
ANGLE_RAD, LEVER_M = math.radians(5.0), 0.15
# Minimum share of points on the floor, and maximum share of points below it.
_SEEN, _BELOW = 0.03, 0.02
_BINS = 40  # of the height, so that a bin is as wide as the noise of a depth camera


def floor_below_m(points: FloatArray, up: FloatArray) -> float | None:
    """Distance to the lowest horizontal surface below a sensor; None if there is none.

    Parameters
    ----------
    points
        (N, 3) in the sensor's frame.
    up
        (3,) up direction in that frame.
    """
    heights = points @ up
    below = -heights[heights < 0.0]
    if len(below) < FEWEST or len(below) <= _BELOW * len(heights):
        return None
    lowest = float(np.quantile(below, 1.0 - _BELOW * len(heights) / len(below)))
    width = lowest / _BINS
    counts, edges = np.histogram(below, np.arange(0.0, lowest + 4.0 * width, width))
    near = np.flatnonzero(counts >= _SEEN * len(heights))
    if not near.size or edges[near[-1]] < 0.75 * lowest:
        return None
    among = below[np.abs(below - edges[near[-1]] - 0.5 * width) < 1.5 * width]
    return float(np.median(among))


def upright_mounting(
    turns: FloatArray, stretches: Sequence[FloatArray], T_base_lidar: gtsam.Pose3
) -> gtsam.Pose3 | None:
    """Return the mounting of a lidar that is tilted although the log does not contain this.

    A robot on a floor rotates about the vertical. If that axis is tilted in the base frame, and perpendicular
    to it is a floor as far below as the log says, the rotation in the log is wrong. The correction is the
    smallest rotation, of a lidar on its head after a rotation about its forward axis.

    Parameters
    ----------
    turns
        (N, 3) rotation vectors of its steps, lidar's frame.
    stretches
        (M, 3) points of one cloud of each stretch, lidar's frame.
    T_base_lidar
        The mounting in the log.

    Returns
    -------
    ``T_base_lidar``; None if the log is right, or the evidence is not sufficient.
    """
    stated, height_m = T_base_lidar.rotation(), T_base_lidar.z()
    if len(turns) < FEWEST or height_m < LEVER_M:
        return None
    points, spread, axes = np.concatenate(stretches), *np.linalg.eigh(turns.T @ turns)
    points = points[np.linalg.norm(points, axis=1) > height_m - LEVER_M]  # nearer is the robot, no floor
    stated_up = np.asarray(stated.matrix())[2]
    up = axes[:, 2] * math.copysign(1.0, axes[:, 2] @ stated_up)

    def stands(up: FloatArray) -> bool:
        below_m = floor_below_m(points, up)
        return below_m is not None and abs(below_m - height_m) < LEVER_M

    on_head = not stands(up) and stands(-up)
    up = -up if on_head else up
    sigma_rad = math.sqrt(spread[1] / max(spread[2] * len(turns), SETTLED))
    tilt_rad = math.acos(float(np.clip(up @ stated_up, -1.0, 1.0)))
    if tilt_rad < ANGLE_RAD + gate() ** 0.5 * sigma_rad or not stands(up) or stands(stated_up):
        return None
    turned = stated.compose(gtsam.Rot3.Roll(math.pi)) if on_head else stated
    upright = upright_of(-np.asarray(turned.rotate(up))).compose(turned)
    return gtsam.Pose3(upright, T_base_lidar.translation())
