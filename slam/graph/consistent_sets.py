"""Find place claims that agree with each other: pairwise consistency, in sets.

Mangelson, Dominic, Eustice and Vasudevan, "Pairwise consistent measurement set maximization for robust
multi-robot map merging", ICRA 2018. Two claims are consistent if the cycle through both, and the chain
between their ends, closes within its covariance, Eq. (7). The largest set of consistent claims is a maximum
clique; here it is found by a greedy search.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

import numpy as np

from slam.graph.keyframe_graph import from_above
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.matching.motion import Motion
from slam.matching.planar import adjoint, between, compose, rotate_covariance
from slam.measurements import BoolArray, FloatArray

# Returns the relative covariance of two keyframes.
Known: TypeAlias = Callable[[int, int], Motion]


class ClaimSets:
    """Verified candidates, and which of them agree.

    Parameters
    ----------
    poses
        (n, 3) keyframe poses by the first optimisation, projected onto the plane.
    travelled_m
        (n,) path length from the start to each.
    reach_m
        Claims farther apart along the path do not support each other: the chain between may be bent.
    """

    def __init__(
        self, poses: FloatArray, travelled_m: FloatArray, chain: UncertaintyGraph, reach_m: float
    ) -> None:
        self._poses, self._travelled_m = poses, travelled_m
        self._chain, self._reach_m = chain, reach_m
        self._claims: list[LoopCandidate] = []
        self._agree = np.zeros((0, 0), np.bool_)
        self._motions: dict[tuple[int, int], Motion] = {}

    def empty(self) -> ClaimSets:
        """Return new sets, without claims, of the same path."""
        return ClaimSets(self._poses, self._travelled_m, self._chain, self._reach_m)

    def add(self, claim: LoopCandidate) -> None:
        """Add a claim."""
        agree = self.near(claim, self._claims)
        for n in np.flatnonzero(agree).tolist():
            agree[n] = self._consistent(claim, self._claims[n])
        self._agree = np.pad(self._agree, ((0, 1), (0, 1)))
        self._agree[-1, :-1] = self._agree[:-1, -1] = agree
        self._claims.append(claim)

    def remove(self, claims: Iterable[LoopCandidate]) -> None:
        """Remove claims."""
        removed = {id(claim) for claim in claims}
        rest = [n for n, claim in enumerate(self._claims) if id(claim) not in removed]
        self._claims = [self._claims[n] for n in rest]
        self._agree = self._agree[np.ix_(rest, rest)]

    def largest(self) -> list[list[LoopCandidate]]:
        """Return disjoint sets of claims that all agree, the largest first."""
        return [[self._claims[n] for n in members] for members in largest_cliques(self._agree)]

    def entailed(
        self, one: Sequence[LoopCandidate], other: Sequence[LoopCandidate]
    ) -> tuple[int, int, Motion] | None:
        """Return a place of each set, the second equal or later, and the motion between them by both.

        None if their keyframes are too far apart.
        """
        travelled_m = [self._travelled_m[[claim.keyframe for claim in claims]] for claims in (one, other)]
        apart_m = np.abs(np.subtract.outer(*travelled_m))
        if apart_m.min() > self._reach_m:
            return None
        n, m = np.unravel_index(apart_m.argmin(), apart_m.shape)
        a, b = sorted((one[int(n)], other[int(m)]), key=lambda claim: claim.place)
        onward = after(claimed(a), self.way(a.keyframe, b.keyframe))
        return a.place, b.place, after(onward, claimed(b).inverse())

    def near(self, one: LoopCandidate, others: Sequence[LoopCandidate]) -> BoolArray:
        """Return (n,) which claims have another keyframe close to that of one, and a close place."""
        ends = np.array([*map(_ends, others)], np.int64).reshape(-1, 2)
        apart_m = np.abs(self._travelled_m[ends] - self._travelled_m[[*_ends(one)]]).max(axis=1)
        near: BoolArray = (ends[:, 1] != one.keyframe) & (apart_m <= self._reach_m)
        return near

    def _consistent(self, one: LoopCandidate, other: LoopCandidate) -> bool:
        """Return whether the cycle of two claims and the chain between their ends closes."""
        claims = [claimed(claim) for claim in (one, other)]
        places, keyframes = (self.way(a, b) for a, b in zip(_ends(one), _ends(other), strict=True))
        first = after(claims[0], keyframes)
        return first.agrees(after(places, claims[1]))

    def way(self, start: int, end: int) -> Motion:
        """Return the motion from one keyframe to another by the chain, with its covariance."""
        if start == end:
            return Motion(np.zeros(3), np.zeros((3, 3)))
        if (start, end) not in self._motions:
            self._motions[start, end] = self._chain.motion(start, end, self._poses)
        return self._motions[start, end]


def largest_cliques(agree: BoolArray) -> list[list[int]]:
    """Return disjoint sets that all agree, the largest first; (n, n) symmetric, False on its diagonal.

    Each starts with the claim with most agreements, and adds those that agree with most of the rest.
    """
    remaining, ones = np.ones(len(agree), np.bool_), agree.astype(np.float32)  # counted by BLAS
    cliques = []
    while remaining.any():
        candidates, members = remaining.copy(), list[int]()
        while candidates.any():
            counts = np.where(candidates, ones @ candidates, -1)
            members.append(int(counts.argmax()))
            candidates &= agree[members[-1]]
        remaining[members] = False
        cliques.append(sorted(members))
    return sorted(cliques, key=len, reverse=True)


def _ends(claim: LoopCandidate) -> tuple[int, int]:
    return claim.place, claim.keyframe


def claimed(claim: LoopCandidate) -> Motion:
    """Return the pose of the keyframe in the frame of the place, projected onto the plane."""
    return from_above(claim.edge(0))


def after(one: Motion, other: Motion) -> Motion:
    """Return the composition of two motions."""
    back = adjoint(between(other.pose, np.zeros(3)))
    covariance = rotate_covariance(back, one.covariance) + other.covariance
    return Motion(compose(one.pose, other.pose), covariance)
