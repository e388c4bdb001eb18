"""A loop candidate, accepted or rejected."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from slam.estimates import MotionEstimate
from slam.graph.edge import Edge, EdgeKind
from slam.matching.motion import Motion
from slam.measurements import one_line, row_from_pose2

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class LoopCandidate:
    """One attempt to close a loop, accepted or not.

    Attributes
    ----------
    place, keyframe
        Node of the known place, and node that may have returned to it.
    half_width_m, half_yaw_rad
        Half size of the search window.
    score
        Mean likelihood of the search: 1 if the window was too small to need a search, the lowest accepted
        score if no pose reached it.
    motion
        Pose of ``keyframe`` in the frame of ``place``; None if no match was found.
    accepted
        Whether the loop is in the final graph.
    reason
        Why it was rejected; empty if accepted.

    Examples
    --------
    >>> import numpy as np, slam
    >>> bearings = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    >>> ranges_m = np.minimum(3.0 / np.abs(np.cos(bearings)), 2.0 / np.abs(np.sin(bearings) + 1e-9))
    >>> points = ranges_m[:, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])  # a room
    >>> loop = slam.check_loop(points, points)
    >>> loop.accepted, loop.reason, loop.motion.converged, loop.edge(number=0).kind is slam.EdgeKind.LOOP
    (True, '', True, True)
    >>> loop.refused("a person says that these are two rooms").accepted
    False
    """

    place: int
    keyframe: int
    half_width_m: float
    half_yaw_rad: float
    score: float
    motion: MotionEstimate | None
    accepted: bool
    reason: str

    __repr__ = one_line

    def refused(self, reason: str) -> LoopCandidate:
        """Return the same candidate, rejected."""
        return replace(self, accepted=False, reason=reason)

    def edge(self, number: int) -> Edge:
        """Return the edge of an accepted loop; ``number`` is its index among the candidates."""
        assert self.motion is not None
        ends, pose, spread = (self.place, self.keyframe), self.motion.T_reference_base, self.motion.covariance
        return Edge(*ends, pose, spread, EdgeKind.LOOP, trusted=False, loop=number)


def judged(
    loops: Sequence[LoopCandidate], edges: Iterable[Edge], kept: Iterable[bool]
) -> list[LoopCandidate]:
    """Return the loop candidates with the decisions of an optimisation about their edges."""
    verdicts = list(loops)
    for edge, keep in zip(edges, kept, strict=True):
        if edge.loop is None:
            continue
        loop = verdicts[edge.loop]
        verdicts[edge.loop] = (
            replace(loop, accepted=True, reason="")
            if keep
            else loop.refused("disagrees with the other loops (GNC)")
        )
    return verdicts


def report(kind: str, candidate: LoopCandidate) -> None:
    """Log one INFO line per candidate."""
    verdict = "accepted" if candidate.accepted else f"refused, {candidate.reason}"
    ends = candidate.keyframe, candidate.place
    log.info(
        "%s %d -> %d: %s (score %.2f, window %.2f m)",
        *(kind, *ends, verdict, candidate.score, candidate.half_width_m),
    )


def found_motion(candidate: LoopCandidate) -> Motion:
    """Return the planar motion of an accepted candidate."""
    assert candidate.motion is not None
    return Motion(row_from_pose2(candidate.motion.T_reference_base), candidate.motion.covariance)
