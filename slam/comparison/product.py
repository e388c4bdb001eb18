"""The result of a run of any method, for scoring."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from slam.estimates import Trajectory
from slam.mapping.occupancy_grid import StateGrid
from slam.measurements import FloatArray


@dataclass(frozen=True, slots=True)
class AcceptedLoop:
    """A loop of the final graph: planar pose of the base at the second stamp relative to the first."""

    place_stamp_s: float
    keyframe_stamp_s: float
    xyt: FloatArray


@dataclass(frozen=True, slots=True)
class Product:
    """A finished run.

    Attributes
    ----------
    trajectory
        Trajectory of the base in the map frame.
    plane
        The occupancy grid at the lidar's height; None if there is none.
    decision
        The navigation map; None without cameras.
    loops
        Accepted loops; None if the method has no loop closure or the robot moves in 3D.
    keyframe_stamps_s
        (K,) stamps at which a loop could have been closed.
    loops_tried
        Number of candidates, accepted or not.
    warnings
        Warnings of one line each.
    """

    trajectory: Trajectory
    plane: StateGrid | None = None
    decision: StateGrid | None = None
    loops: Sequence[AcceptedLoop] | None = None
    keyframe_stamps_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    loops_tried: int = 0
    warnings: tuple[str, ...] = ()
