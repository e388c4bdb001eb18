"""Loops along bare corridors: they determine the heading and the offset across, and leave the way along open.

All places of a corridor look alike, and so do corridors. Such loops may therefore confirm that the path runs
along a corridor again, where the estimate nearly knows it; they never find the corridor.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from slam.config.stages import LoopConfig
from slam.graph.claim_trial import ClaimTrial, contradicted_by_chance
from slam.graph.consistent_sets import ClaimSets, claimed
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.loop_closure import LoopCloser
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.graph.stretches import Stretches
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.measurements import FloatArray


class CorridorClaims:
    """Finds sets of loops that leave a direction undetermined, where nothing else is left to be found.

    Parameters
    ----------
    sets
        Gives the chain by which the claims of a set must agree along the path.
    """

    def __init__(
        self, closer: LoopCloser, stretches: Stretches, trial: ClaimTrial, sets: ClaimSets, config: LoopConfig
    ) -> None:
        self._closer, self._stretches, self._trial = closer, stretches, trial
        self._sets, self._config = sets, config
        self._returned: set[tuple[int, int]] = set()

    def believed(
        self, poses: FloatArray, known: UncertaintyGraph, loops: Sequence[LoopCandidate]
    ) -> list[LoopCandidate]:
        """Return the claims of all sets that are long enough and that no other set contradicts, none twice.

        Parameters
        ----------
        poses
            (n, 3) keyframe poses by the current estimate.
        """
        claims = self._sets.empty()
        for number in self._stretches.untied(loops, bare=True):
            key = int(self._stretches.keys[number])
            for place, covariance in self._closer.propose(key, poses, known, wide=True):
                # What GNC has rejected since is not returned again: the search ends.
                is_new = (place, key) not in self._returned
                if is_new and (claim := self._verify(place, key, poses, covariance)):
                    claims.add(claim)
        way_m, least_m = self._closer.submaps.travelled_m, 2.0 * self._config.reach_m
        sets = [one for one in claims.largest() if np.ptp([way_m(c.keyframe) for c in one]) >= least_m]
        # Where two corridors are equally possible, neither is believed.
        doubtful = set[int]()
        for n, m in combinations(range(len(sets)), 2):
            if entailed := claims.entailed(sets[n], sets[m]):
                start, end, motion = entailed
                if not known.motion(start, end, poses).agrees(motion):
                    doubtful |= {n, m}
        believed = [_corroborated(one) for n, one in enumerate(sets) if n not in doubtful]
        few = contradicted_by_chance(self._config)
        found = [claim for one in believed if one and self._trial.contradicted(one) <= few for claim in one]
        self._returned |= {(claim.place, claim.keyframe) for claim in found}
        return found

    def _verify(
        self, place: int, key: int, poses: FloatArray, covariance: FloatArray
    ) -> LoopCandidate | None:
        """Match a keyframe to a place; None unless it fits where the estimate expects it."""
        guess = Motion(between(poses[place], poses[key]), covariance)
        claim = self._closer.verify(place, key, guess.pose, covariance, confirming=True)
        if not claim.accepted or not guess.agrees(found := claimed(claim)):
            return None
        # The estimate must lead into the same corridor, not only into its neighbourhood.
        across = np.linalg.eigh(found.covariance[:2, :2])[1][:, 0]
        across_m = abs(float(across @ (found.pose - guess.pose)[:2]))
        return claim if across_m <= 0.5 * self._config.reach_m else None


def _corroborated(claims: list[LoopCandidate]) -> list[LoopCandidate]:
    """Return a set without a lone claim that leaves no direction open: doors along a corridor look alike."""
    is_open = [claim.motion is not None and claim.motion.degenerate for claim in claims]
    return [
        claim for claim, is_one in zip(claims, is_open, strict=True) if is_one or is_open.count(False) > 1
    ]
