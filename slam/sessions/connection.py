"""Whether a session belongs into a map, and the two joined where it does: found out in three steps.

All that was seen on the way must tell where the session lies; scans along it must match the map there;
and the optimisation of both together must keep most of those loops. Each may say no.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.showing import one_line
from slam.graph.loop_closure import LoopCandidate
from slam.localization.known_map import Walls
from slam.outputs.finished_map import Map
from slam.sessions.placing import Placing, place
from slam.sessions.session_join import JoinedMap, join
from slam.sessions.session_loops import find_loops

# Loops between two sessions at least.
_LEAST_LOOPS = 3


@dataclass(frozen=True, slots=True)
class Connection:
    """What became of an attempt to join a session to a map.

    Attributes
    ----------
    placing
        Where the session lies.
    loops
        Every attempt to match a keyframe of the session to the map.
    joined
        The two as one; None where they do not connect.
    reason
        Why not, in a few words; empty where they do.
    """

    placing: Placing
    loops: Sequence[LoopCandidate]
    joined: JoinedMap | None
    reason: str

    __repr__ = one_line


def connect(known: Map, session: Map) -> Connection:
    """Join a session to a map, both planar and with scans, by the settings of the map.

    Raises
    ------
    ScanweaveError
        Where the joined grid would have too many cells.
    """
    config = known.config
    shared = _shared_scans(known, session)
    # Real scans never repeat to the last digit: where half are shared, one log is a part of the other.
    if shared > 0.5 * min(len(session.keyframe_scans), len(known.keyframe_scans)):
        reason = f"{shared} of its {len(session.keyframe_scans)} keyframes are in the map already"
        return Connection(Placing(), (), None, reason)
    placing = place(Walls(known.contents, config), Walls(session.contents, config), config)
    if not placing.confident:
        return Connection(placing, (), None, _unplaced(placing))
    loops = find_loops(known, session, placing, config)
    accepted = sum(loop.accepted for loop in loops)
    if accepted < _LEAST_LOOPS:
        reason = f"only {accepted} of {len(loops)} scans match the map where they should, {_LEAST_LOOPS} must"
        return Connection(placing, loops, None, reason)
    joined = join(known, session, placing, loops, config)
    if joined.loops_kept < max(_LEAST_LOOPS, 0.5 * joined.loops_between):
        reason = (
            f"only {joined.loops_kept} of the {joined.loops_between} loops between them hold when both are "
            "optimised together"
        )
        return Connection(placing, loops, None, reason)
    return Connection(placing, loops, joined, "")


def _shared_scans(known: Map, session: Map) -> int:
    """How many keyframe scans of the session are the map's own, time and every range."""
    measured = (known.contents.measured_scans, session.contents.measured_scans)
    ours, theirs = (
        # What an edit has taken away was measured all the same.
        [(scan.stamp_s, scan.sensor, np.abs(scan.ranges_m).tobytes()) for scan in scans if scan is not None]
        for scans in measured
    )
    known_scans = set(ours)
    return sum(scan in known_scans for scan in theirs)


def _unplaced(placing: Placing) -> str:
    """Why a placing is not certain."""
    if not placing.anchors:
        return "no place of it was recognised in the map"
    if placing.nats < placing.least_nats:
        return (
            f"the evidence for its likeliest place in the map is {placing.nats:.1f} nats, "
            f"{placing.least_nats:.1f} are needed"
        )
    return (
        f"two places in the map are alike, with evidence of {placing.nats:.1f} and "
        f"{placing.rival_nats:.1f} nats"
    )
