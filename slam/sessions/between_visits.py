"""How certain it is where one visit lies against another, place by place."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.measurements import FloatArray, row_from_pose2
from slam.storage.map_contents import MapContents


class BetweenVisits:
    """The edges that hold between the keyframes of two visits, asked by `slam.sessions.changes.compare`.

    Parameters
    ----------
    contents
        A planar map that holds both.
    before, after
        The keyframes of each.
    """

    def __init__(self, contents: MapContents, before: NDArray[np.int64], after: NDArray[np.int64]) -> None:
        self._poses, self._before, self._after = contents.keyframe_poses, before, after
        self._graph = UncertaintyGraph()
        for _ in self._poses:
            self._graph.add_node()
        for factor in contents.factors:
            if factor.kept:
                edge = factor.edge
                motion = row_from_pose2(edge.T_source_target)
                self._graph.add_edge(edge.source, edge.target, motion, edge.covariance)

    def __call__(
        self, before: NDArray[np.int64], after: NDArray[np.int64], point_m: FloatArray
    ) -> FloatArray:
        """Covariance (2, 2) of a point (2,) as two visits have it, along the axes of the map.

        Of the keyframes of both that saw it, by the most certain way from one of the first to the one of the
        second that was nearest; infinite where none leads there.
        """
        if not len(before) or not len(after):
            return np.full((2, 2), np.inf)
        seen_from = self._after[after]
        start = int(seen_from[np.hypot(*(self._poses[seen_from, :2] - point_m).T).argmin()])
        found = self._graph.relative_covariances(start, self._before[before], self._poses)
        x, y, yaw = self._poses[start]
        c, s = math.cos(yaw), math.sin(yaw)
        # In GTSAM's tangent of the start a turn moves the point about it.
        lever = np.array([[c, -s, -(point_m[1] - y)], [s, c, point_m[0] - x]])
        at_point = lever @ found @ lever.T
        return np.asarray(at_point[np.argmin(np.trace(at_point, axis1=1, axis2=2))])
