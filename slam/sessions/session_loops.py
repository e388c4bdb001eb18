"""Loops between the keyframes of a session and those of the map that it is joined to."""

from __future__ import annotations

import numpy as np

from slam.config import Config
from slam.graph.loop_candidate import LoopCandidate
from slam.outputs.finished_map import Map
from slam.sessions.loop_matching import matcher_of
from slam.sessions.placing import BEND_RAD, SIGHT_SIGMA_M, SIGHT_SIGMA_RAD, Placing
from slam.sessions.sides import Side


def find_loops(known: Map, session: Map, placing: Placing, way: Side, config: Config) -> list[LoopCandidate]:
    """Try to match keyframes along a session to places of the map near where they are expected.

    Parameters
    ----------
    way
        The session's.

    Returns
    -------
    Every candidate, its ``place`` a keyframe of the map, its ``keyframe`` numbered after those of the map.
    """
    matcher, tried, next_m = matcher_of(known, session, config), list[LoopCandidate](), -np.inf
    for key, pose in enumerate(way.bases):
        if way.path_m[key] < next_m:
            continue
        T_map_session, distance_m = placing.nearest(pose, way.bases)
        found = matcher.tried(key, T_map_session, SIGHT_SIGMA_M + BEND_RAD * distance_m, SIGHT_SIGMA_RAD)
        tried += found
        next_m = way.path_m[key] + matcher.every_m
    return tried
