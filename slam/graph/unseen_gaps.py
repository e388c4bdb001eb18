"""Loops across a gap without measurements, where no other edge contradicts a false loop.

If only a guess connects two stretches of the path, any single loop between them fits the graph, true or
false. As in the plane (`slam.graph.consistent_sets`), several loops must agree with each other.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np

from slam.graph.consistent_sets import ClaimSets
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.measurements import FloatArray

_ALONE = "no other loop across the unobserved gap agrees"


class UnseenGaps:
    """Which stretches of the way are joined, and the loops that wait for others to agree.

    Parameters
    ----------
    least_path_m
        Way along which the places of a set must lie, and the keyframes that come back to them.
    """

    def __init__(self, least_path_m: float) -> None:
        self._least_path_m = least_path_m
        self._begins: list[int] = []
        # Of each stretch, the first one that it is joined with.
        self._joined = [0]
        self._waiting: list[LoopCandidate] = []
        self._likeliest: LoopCandidate | None = None

    def begin(self, key: int) -> None:
        """Nothing saw the way to a keyframe."""
        self._begins.append(key)
        self._joined.append(len(self._joined))

    def crossed(self, loop: LoopCandidate) -> tuple[int, int] | None:
        """The two stretches that nothing but a loop joins; None if they are one."""
        ends = self._stretch(loop.place), self._stretch(loop.keyframe)
        return None if ends[0] == ends[1] else ends

    def believed(
        self,
        loops: Iterable[LoopCandidate],
        rows: FloatArray,
        travelled_m: Sequence[float],
        chain: UncertaintyGraph,
    ) -> list[LoopCandidate]:
        """Loops as they may be taken now: those that wait are left out, those that agree by now come along.

        Parameters
        ----------
        loops
            Verified just now.
        rows
            (n, 3) current estimates seen from above.
        travelled_m
            (n,) way from the start.
        chain
            How uncertain keyframes of one stretch are of each other.
        """
        taken = list[LoopCandidate]()
        for loop in loops:
            crossed = self.crossed(loop) if loop.accepted else None
            if crossed is None:
                taken.append(loop)
                continue
            self._waiting.append(loop)
            sets = ClaimSets(rows, np.array(travelled_m), chain, 2.0 * self._least_path_m)
            same = [one for one in self._waiting if self.crossed(one) == crossed]
            for one in compress(same, sets.near(loop, same)):
                sets.add(one)
            sets.add(loop)
            agreeing = sets.largest()[0]
            self._likeliest = agreeing[-1] if len(agreeing) > 1 else None
            ways_m = [[travelled_m[one.place], travelled_m[one.keyframe]] for one in agreeing]
            if np.ptp(ways_m, axis=0).min() >= self._least_path_m:
                taken += agreeing
                self._likeliest = None
                self._joined = [crossed[0] if one == crossed[1] else one for one in self._joined]
                chosen = {id(one) for one in agreeing}
                self._waiting = [one for one in self._waiting if id(one) not in chosen]
        return taken

    def likeliest(self, key: int) -> LoopCandidate | None:
        """The newest of the largest set that waits, if it tells where a keyframe is; it may be false."""
        loop = self._likeliest
        return loop if loop is not None and self._stretch(loop.keyframe) == self._stretch(key) else None

    def alone(self) -> list[LoopCandidate]:
        """Loops that still wait, as refused."""
        return [replace(loop, accepted=False, reason=_ALONE) for loop in self._waiting]

    def stretch_of(self, key: int) -> range:
        """The keyframes around one that nothing unseen parts from it."""
        n = int(np.searchsorted(self._begins, key, side="right"))
        ends = [0, *self._begins]
        return range(ends[n], ends[n + 1]) if n + 1 < len(ends) else range(ends[n], key + 1)

    def _stretch(self, key: int) -> int:
        """The first stretch that that of a keyframe is joined with."""
        return self._joined[int(np.searchsorted(self._begins, key, side="right"))]
