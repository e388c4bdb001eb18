"""Footprint of the robot: the cells under it are free of obstacles."""

from __future__ import annotations

import gtsam
import numpy as np

from fusion.bayes import evidence_steps
from slam.mapping.evidence_tiles import Board

# Probability that a cell under the robot is occupied; the pose may be a little off.
_UNDER_ROBOT = 0.2


def footprint_board(pose: gtsam.Pose2, radius_m: float, cell_m: float) -> Board | None:
    """Return the evidence of a keyframe's pose on the lattice; None if no whole cell is under the robot.

    Parameters
    ----------
    radius_m
        Radius of the disc around the base that the robot covers.
    """
    x, y, reach = pose.x() / cell_m, pose.y() / cell_m, radius_m / cell_m - 0.5 * np.sqrt(2.0)
    if reach <= 0.0:
        return None
    first_row, first_col = int(np.floor(y - reach)), int(np.floor(x - reach))
    side = int(np.ceil(2.0 * reach)) + 1
    rows = first_row + np.arange(side) + 0.5 - y
    cols = first_col + np.arange(side) + 0.5 - x
    under = rows[:, None] ** 2 + cols[None, :] ** 2 <= reach**2
    return Board(np.where(under, evidence_steps(_UNDER_ROBOT), 0).astype(np.int16), first_row, first_col)
