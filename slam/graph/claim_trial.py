"""Test the consequences of a set of place claims: if they are true, everything along both paths must match.

Two corridors look alike for a while, but not for long.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from slam.config.stages import LoopConfig
from slam.graph.consistent_sets import ClaimSets, after, claimed
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.loop_closure import LoopCloser, position_sigmas
from slam.graph.stretches import Stretches
from slam.graph.submaps import SubmapStore
from slam.matching.motion import Motion
from slam.matching.planar import between


class ClaimTrial:
    """Verifies the keyframes between and beyond the claims of a set.

    Parameters
    ----------
    reach_m
        Path length beyond a set that is verified.
    """

    def __init__(
        self, closer: LoopCloser, stretches: Stretches, sets: ClaimSets, config: LoopConfig, reach_m: float
    ) -> None:
        self._closer, self._stretches, self._sets = closer, stretches, sets
        self._submaps: SubmapStore = closer.submaps
        self._config, self._reach_m = config, reach_m
        self._tried: dict[tuple[int, int], LoopCandidate] = {}

    def hold(self, members: Sequence[LoopCandidate]) -> tuple[list[LoopCandidate], int]:
        """Return the matching claims that follow from a set, and the number of keyframes without a match."""
        more, refused = list[LoopCandidate](), 0
        for key, nearest in self._along(members):
            verdicts = self._verdicts(nearest, key) if key != nearest.keyframe else []
            fits = [one for one in verdicts if one.accepted]
            refused += bool(verdicts) and not fits
            more += [one for one in fits if one.motion is not None and not one.motion.degenerate][:1]
        return more, refused

    def contradicted(self, members: Sequence[LoopCandidate]) -> float:
        """Return the share of points by which both ends of a set contradict each other, along all of it.

        Two places may look alike, but each also sees how far it is free. A point of one contradicts the other
        where that has seen through it, or through what stands before it, see `LocalMap.contradicted`.
        """
        shares = [
            (self._passed(place, key, guess), self._passed(key, place, guess.inverse()))
            for key, nearest in self._along(members)
            for place, guess in [*self._guesses(nearest, key)][:1]
        ]
        return float(np.mean(shares or [(0.0, 0.0)], axis=0).max())

    def _passed(self, place: int, key: int, at: Motion) -> float:
        """Return the share of points of a scan that contradict a place, drawn without crossing a gap."""
        return self._submaps.surroundings(place, own=True).contradicted(self._submaps.scan(key), *at)

    def _along(self, members: Sequence[LoopCandidate]) -> Iterator[tuple[int, LoopCandidate]]:
        """Yield the keyframes around those of a set, each with the nearest claim along the path."""
        path_m = self._submaps.travelled_m
        members_m = np.array([path_m(member.keyframe) for member in members])
        for key in self._stretches.between(members_m.min() - self._reach_m, members_m.max() + self._reach_m):
            yield key, members[int(np.abs(members_m - path_m(key)).argmin())]

    def _guesses(self, member: LoopCandidate, key: int) -> Iterator[tuple[int, Motion]]:
        """Yield the places from which a keyframe may be visible by a claim, and its pose in their frames."""
        expected = after(claimed(member), self._sets.way(member.keyframe, key))
        for place in self._places(member.place, expected, key):
            guess = after(self._sets.way(place, member.place), expected)
            if self._config.sigmas * position_sigmas(guess.covariance[None])[0] > self._config.reach_m:
                return
            yield place, guess

    def _verdicts(self, member: LoopCandidate, key: int) -> list[LoopCandidate]:
        """Match a keyframe to the places that a claim predicts, up to the first that fits."""
        verdicts: list[LoopCandidate] = []
        for place, guess in self._guesses(member, key):
            if (place, key) not in self._tried:
                self._tried[place, key] = self._closer.verify(place, key, guess.pose, guess.covariance)
            verdicts.append(self._tried[place, key])
            if verdicts[-1].accepted:
                break
        return verdicts

    def _places(self, place: int, expected: Motion, key: int) -> list[int]:
        """Return places around one on the same pass from which a pose may be visible, nearest first."""
        path_m, config = self._submaps.travelled_m, self._config
        around = self._stretches.between(path_m(place) - self._reach_m, path_m(place) + self._reach_m)
        relative = [between(self._submaps.pose(place), self._submaps.pose(one)) for one in around]
        apart_m = [math.dist(one[:2], expected.pose[:2]) for one in relative]
        chosen: list[int] = []
        for n in np.argsort(apart_m, kind="stable").tolist():
            if len(chosen) == config.near or apart_m[n] > self._stretches.window_m:
                break
            if not chosen and apart_m[n] > self._submaps.wide_m(config.reach_m, 1.0):
                break
            is_far = all(abs(path_m(around[n]) - path_m(one)) > self._stretches.spacing_m for one in chosen)
            if is_far and path_m(key) - path_m(around[n]) > self._submaps.least_path_m:
                chosen.append(around[n])
        return chosen


def contradicted_by_chance(config: LoopConfig) -> float:
    """Return the largest share of points by which both ends of a true set may contradict each other."""
    return config.sigmas * (1.0 - config.inlier_probability)
