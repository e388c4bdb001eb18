"""Decide whether a session belongs to a map, and join the two if so, in three steps.

All readings along the path must determine the session's pose; scans along it must match the map there; and
the optimisation of both together must keep most of those loops. Each step may reject the session.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fusion.showing import one_line
from slam.config import Config
from slam.graph.loop_candidate import LoopCandidate
from slam.outputs.finished_map import Map
from slam.sessions.loop_matching import matcher_of
from slam.sessions.placing import BEND_RAD, SIGHT_SIGMA_M, SIGHT_SIGMA_RAD, Placing, place
from slam.sessions.session_join import JoinedMap, join
from slam.sessions.sides import Side, sides_of
from slam.storage.map_contents import MapContents

# Minimum number of loops between two sessions.
_LEAST_LOOPS = 3


@dataclass(frozen=True, slots=True)
class Connection:
    """Result of an attempt to join a session to a map.

    Attributes
    ----------
    placing
        Pose of the session in the map.
    loops
        Every attempt to match a keyframe of the session to the map.
    joined
        The joined map; None if they do not connect.
    reason
        Why they do not connect, in a few words; empty if they do.
    """

    placing: Placing
    loops: Sequence[LoopCandidate]
    joined: JoinedMap | None
    reason: str

    __repr__ = one_line


def connect(known: Map, session: Map) -> Connection:
    """Join a session to a map of the same kind, with the settings of the map.

    Raises
    ------
    ScanweaveError
        If the joined grid would have too many cells.
    """
    config = known.config
    own, keyframes = set(_readings(known.contents)), len(session.contents.node_poses)
    shared = sum(reading in own for reading in _readings(session.contents))
    # Real readings are never bit-identical: if half are shared, one log is a part of the other.
    if shared > 0.5 * min(keyframes, len(known.contents.node_poses)):
        reason = f"{shared} of its {keyframes} keyframes are in the map already"
        return Connection(Placing(), (), None, reason)
    sides = sides_of(known.contents, session.contents, config)
    placing = place(*sides, config)
    if not placing.confident:
        return Connection(placing, (), None, _unplaced(placing))
    loops = _find_loops(known, session, placing, sides[1], config)
    accepted = sum(loop.accepted for loop in loops)
    if accepted < _LEAST_LOOPS:
        reason = f"only {accepted} of {len(loops)} readings match the map there; {_LEAST_LOOPS} are needed"
        return Connection(placing, loops, None, reason)
    joined = join(known, session, placing, loops, config)
    if joined.loops_kept < max(_LEAST_LOOPS, 0.5 * joined.loops_between):
        reason = (
            f"only {joined.loops_kept} of the {joined.loops_between} loops between them hold when both are "
            "optimised together"
        )
        return Connection(placing, loops, None, reason)
    return Connection(placing, loops, joined, "")


def _find_loops(known: Map, session: Map, placing: Placing, way: Side, config: Config) -> list[LoopCandidate]:
    """Try to match keyframes along a session to places of the map near where they are expected.

    Returns
    -------
    Every candidate, its ``place`` a keyframe of the map, its ``keyframe`` numbered after those of the map.
    """
    matcher, tried, next_m = matcher_of(known, session, config), list[LoopCandidate](), -np.inf
    for key, pose in enumerate(way.bases):
        if way.path_m[key] < next_m:
            continue
        T_map_session, distance_m = placing.nearest(pose, way.bases)
        loops = matcher.tried(key, T_map_session, SIGHT_SIGMA_M + BEND_RAD * distance_m, SIGHT_SIGMA_RAD)
        tried += loops
        next_m = way.path_m[key] + matcher.every_m
    return tried


def _readings(contents: MapContents) -> Iterator[Hashable]:
    """Return the readings of each keyframe, including those that an edit removed."""
    if contents.clouds is not None:
        yield from (contents.clouds.digest(key) for key in range(len(contents.clouds)))
    elif contents.planar:
        for scan in contents.measured_scans:
            if scan is not None:
                yield scan.stamp_s, scan.sensor, np.abs(scan.ranges_m).tobytes()
    elif contents.frames is not None:
        for index in range(len(contents.frames)):
            yield contents.frames.head(index).stamp_s, contents.frames.jpeg(index)


def _unplaced(placing: Placing) -> str:
    """Return why a placing is not certain."""
    if not placing.anchors:
        return "none of its places was recognised in the map"
    if placing.nats < placing.least_nats:
        return (
            f"the evidence for its likeliest place in the map is {placing.nats:.1f} nats, "
            f"{placing.least_nats:.1f} are needed"
        )
    return (
        f"two places in the map look alike, with evidence of {placing.nats:.1f} and "
        f"{placing.rival_nats:.1f} nats"
    )
