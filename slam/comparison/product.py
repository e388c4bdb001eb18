"""What a run hands to its scores, whoever made it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from slam.estimates import Trajectory
from slam.mapping.occupancy_grid import StateGrid
from slam.measurements import FloatArray


@dataclass(frozen=True, slots=True)
class AcceptedLoop:
    """A loop of the final graph: pose of the base at the second stamp seen from the first, planar."""

    place_stamp_s: float
    keyframe_stamp_s: float
    xyt: FloatArray


@dataclass(frozen=True, slots=True)
class Product:
    """A finished run.

    Attributes
    ----------
    trajectory
        Of the base, map frame.
    plane
        The occupancy grid at the lidar's height; None if there is none.
    decision
        The navigation map; None if no camera made one.
    loops
        Accepted ones; None if the method closes none or the robot leaves the floor.
    keyframe_stamps_s
        (K,) moments at which a loop could have been closed.
    loops_tried
        Candidates, accepted or not.
    warnings
        One line each.
    """

    trajectory: Trajectory
    plane: StateGrid | None = None
    decision: StateGrid | None = None
    loops: Sequence[AcceptedLoop] | None = None
    keyframe_stamps_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    loops_tried: int = 0
    warnings: tuple[str, ...] = ()
