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
    """Which sections of the path are connected, and the loops that wait for others to agree.

    Parameters
    ----------
    least_path_m
        Path length that the places of a set must cover, and the keyframes that return to them.
    """

    def __init__(self, least_path_m: float) -> None:
        self._least_path_m = least_path_m
        self._begins: list[int] = []
        # For each section, the first one to which it is connected.
        self._joined = [0]
        self._waiting: list[LoopCandidate] = []
        self._likeliest: LoopCandidate | None = None

    def begin(self, key: int) -> None:
        """Start a section: nothing measured the motion to a keyframe."""
        self._begins.append(key)
        self._joined.append(len(self._joined))

    def crossed(self, loop: LoopCandidate) -> tuple[int, int] | None:
        """Return the two sections that only a loop connects; None if they are one."""
        ends = self._stretch(loop.place), self._stretch(loop.keyframe)
        return None if ends[0] == ends[1] else ends

    def believed(
        self,
        loops: Iterable[LoopCandidate],
        rows: FloatArray,
        travelled_m: Sequence[float],
        chain: UncertaintyGraph,
    ) -> list[LoopCandidate]:
        """Return the loops to use now: without those that wait, with those that now agree.

        Parameters
        ----------
        loops
            Verified just now.
        rows
            (n, 3) current estimates, projected onto the plane.
        travelled_m
            (n,) path length from the start.
        chain
            Relative uncertainty of keyframes of one section.
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
            travelled = [[travelled_m[one.place], travelled_m[one.keyframe]] for one in agreeing]
            if np.ptp(travelled, axis=0).min() >= self._least_path_m:
                taken += agreeing
                self._likeliest = None
                self._joined = [crossed[0] if one == crossed[1] else one for one in self._joined]
                chosen = {id(one) for one in agreeing}
                self._waiting = [one for one in self._waiting if id(one) not in chosen]
        return taken

    def likeliest(self, key: int) -> LoopCandidate | None:
        """Return the newest of the largest waiting set, if it is in the section of a keyframe."""
        loop = self._likeliest
        return loop if loop is not None and self._stretch(loop.keyframe) == self._stretch(key) else None

    def alone(self) -> list[LoopCandidate]:
        """Return the loops that still wait, as rejected."""
        return [replace(loop, accepted=False, reason=_ALONE) for loop in self._waiting]

    def stretch_of(self, key: int) -> range:
        """Return the keyframes around one without a gap between."""
        n = int(np.searchsorted(self._begins, key, side="right"))
        ends = [0, *self._begins]
        return range(ends[n], ends[n + 1]) if n + 1 < len(ends) else range(ends[n], key + 1)

    def _stretch(self, key: int) -> int:
        """Return the first section to which that of a keyframe is connected."""
        return self._joined[int(np.searchsorted(self._begins, key, side="right"))]
