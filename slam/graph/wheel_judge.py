"""At the end of a run the wheels judge between a match and the cameras that contradict it.

Beforehand nobody knows how exact wheels are, and a wide guess takes no side. A whole run shows it, by what
the matches between keyframes say of the same motions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.graph.pose_graph import Edge, EdgeKind
from slam.matching.planar import between
from slam.measurements import FloatArray, row_from_pose2

_LEAST_STEPS = 40  # that matches and wheels both tell, or the wheels' noise is not known
_FARTHEST_SCALES = 4.0  # a rarer difference is a slip or a wrong match, and tells no noise
_MEDIAN_TO_SIGMA = 1.4826
_CONTRADICTION = 11.3  # squared sigmas of three degrees of freedom, 99 %
_SIDE = 4.0  # the wheels take a side that is nearer to them by so many squared sigmas


def outvoted_cameras(edges: Sequence[Edge]) -> dict[int, Edge]:
    """Steps by cameras that contradict the match and the wheels, by their number, told as unsure as they are.

    Parameters
    ----------
    edges
        Of a planar graph; only those between a keyframe and the next count.

    Returns
    -------
    The edges with covariances so wide that the match is one sigma away.
    """
    steps = [(n, edge) for n, edge in enumerate(edges) if edge.target == edge.source + 1]
    matches = {edge.target: edge for _, edge in steps if edge.kind is EdgeKind.LIDAR}
    wheels = {edge.target: edge for _, edge in steps if edge.kind is EdgeKind.WHEEL}
    scales = _shown_scales(matches, wheels)
    if scales is None:
        return {}
    found = {}
    for number, camera in steps:
        match, wheel = matches.get(camera.target), wheels.get(camera.target)
        if camera.kind is not EdgeKind.RGBD or match is None or wheel is None:
            continue
        contradiction = _squares(match, camera)
        if contradiction <= _CONTRADICTION:
            continue
        exact = replace(wheel, covariance=wheel.covariance * np.outer(scales, scales))
        if _squares(exact, match) + _SIDE < _squares(exact, camera):
            found[number] = replace(camera, covariance=camera.covariance * contradiction)
    return found


def _shown_scales(matches: dict[int, Edge], wheels: dict[int, Edge]) -> FloatArray | None:
    """(3,) by which the wheels' sigmas are too wide, at most 1; None where too few steps tell."""
    both = [key for key, match in matches.items() if match.trusted and key in wheels]
    if len(both) < _LEAST_STEPS:
        return None
    off = np.array([_offset(wheels[key], matches[key]) for key in both])
    scale = _MEDIAN_TO_SIGMA * np.median(np.abs(off), axis=0)
    near = np.clip(off, -_FARTHEST_SCALES * scale, _FARTHEST_SCALES * scale)
    told = np.mean([np.diag(wheels[key].covariance) for key in both], axis=0)
    # The difference holds the match's noise too: wheels are not thought more exact than shown.
    return np.minimum(1.0, np.sqrt((near**2).mean(axis=0) / told))


def _squares(one: Edge, other: Edge) -> float:
    """Squared distance of two motions in their common standard deviations."""
    offset = _offset(one, other)
    return float(offset @ np.linalg.solve(one.covariance + other.covariance, offset))


def _offset(one: Edge, other: Edge) -> FloatArray:
    """(3,) from where one motion ends to where another does."""
    return between(row_from_pose2(one.T_source_target), row_from_pose2(other.T_source_target))
