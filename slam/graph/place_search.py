"""Loop search over the whole map: recognise a stretch of the path wherever the estimate puts it.

During mapping, `slam.graph.loop_closure` closes loops within the uncertainty of the estimate. If the chain is
bent, places are found by their appearance instead, and accepted only in sets: claims that agree with each
other along the path (`slam.graph.consistent_sets`), that the surroundings confirm (`slam.graph.claim_trial`),
and that one fault of the chain explains, or several faults if the set is much longer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fusion.estimation import gate
from slam.config.stages import GraphConfig, LoopConfig, MatchConfig
from slam.graph.claim_trial import ClaimTrial, contradicted_by_chance
from slam.graph.consistent_sets import ClaimSets, Known, claimed
from slam.graph.corridor_claims import CorridorClaims
from slam.graph.edge import GUESSES, Edge
from slam.graph.faulty_steps import FaultySteps
from slam.graph.followed_claims import FollowedClaims
from slam.graph.keyframe_graph import graph_of, guessed_steps
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.loop_closure import LoopCloser, position_sigmas
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.graph.stretches import Stretches
from slam.heap import give_back
from slam.matching.motion import Motion
from slam.measurements import BoolArray, FloatArray
from slam.result_cache import COMPUTED, ResultCache


class _Judged(NamedTuple):
    """Cost of a set: squared sigmas by which it bends the known motion, and a gate for each fault.

    Also the sigma of the known motion in metres, and the poses (n, 3), corrected if there are several faults.
    """

    cost: float
    sigma_m: float
    poses: FloatArray | None


class PlaceSearch:
    """Searches a finished run round by round, each from the estimate that the last one led to."""

    def __init__(
        self,
        closer: LoopCloser,
        config: LoopConfig,
        match: MatchConfig,
        graph: GraphConfig,
        result_cache: ResultCache = COMPUTED,
    ) -> None:
        self._closer, self._submaps, self._result_cache = closer, closer.submaps, result_cache
        self._config, self._match, self._graph = config, match, graph
        # The gate of GNC, and the way over which claims may support each other.
        self._gate, self._reach_m = gate(3, config.inlier_probability), 2.0 * config.least_path_m
        self._few = contradicted_by_chance(config)
        self._stretches: Stretches | None = None
        self._sets: ClaimSets | None = None
        self._trial: ClaimTrial | None = None
        self._corridors: CorridorClaims | None = None
        self._tried: set[tuple[int, int]] = set()
        # What sets cost by this estimate; infinite by an earlier one, if nothing was refused since.
        self._judged: dict[tuple[tuple[int, int], ...], _Judged] = {}
        self._kept = np.zeros(0, np.bool_)
        # Whether the estimate is another than the one that places nearby were tried from.
        self._corrected = False
        self._faulty: FaultySteps | None = None
        self._followed: FollowedClaims | None = None

    def search(
        self,
        poses: FloatArray,
        stamps_s: FloatArray,
        edges: Sequence[Edge],
        kept: BoolArray,
        loops: Sequence[LoopCandidate],
    ) -> list[LoopCandidate]:
        """Loops that the estimate of the last optimisation lets one believe, none twice.

        Parameters
        ----------
        poses
            (n, 3) of all keyframes, map frame.
        stamps_s
            (n,) of them.
        edges, kept
            Of the graph, and which of them the optimisation has kept.
        """
        if not self._config.enabled or len(poses) < 2:
            return []
        faulty = FaultySteps(edges, kept, poses, stamps_s, self._graph, self._config, self._match)
        settings, sparse = (self._submaps, self._config, self._match), self._submaps.sparse
        if self._stretches is None or not sparse:
            guessed = faulty.lone.unseen[:-1] | guessed_steps(
                edges, kept, len(poses), self._graph.lost_sigma_m
            )
            self._submaps.lay(poses, (1 + np.flatnonzero(guessed)).tolist())
        if (stretches := self._stretches) is None:
            give_back()
            self._stretches = stretches = Stretches(*settings)
        if sparse:
            self._followed = self._followed or FollowedClaims(*settings, stretches.window_m)
            return self._follow(stretches, self._followed, poses, faulty, loops)
        if self._sets is None:
            # Where scans lie far apart only the whole run has told how far wheels can be believed.
            self._corrected = stretches.spacing_m > 0.5 * self._config.reach_m
            # Claims on both sides of a step that may be grossly wrong say nothing of each other.
            measured = {edge.source for edge in faulty.held if edge.kind not in GUESSES}
            sure = (edge for edge in faulty.held if edge.trusted or edge.source in measured)
            chain = graph_of(len(poses), (edge for edge in sure if edge.loop is None))
            self._sets = ClaimSets(poses.copy(), self._submaps.ways_m(), chain, self._reach_m)
            self._trial = ClaimTrial(self._closer, stretches, self._sets, self._config, self._reach_m)
            self._corridors = CorridorClaims(self._closer, stretches, self._trial, self._sets, self._config)
        self._faulty, known = faulty, faulty.known
        # More loops make no way less certain.
        more, self._kept = bool((kept[: len(self._kept)] >= self._kept).all()), kept
        self._judged = {one: test for one, test in self._judged.items() if more and math.isinf(test.cost)}
        if self._corrected:
            # A loop or two across a gap rule out no other place, but tell where to try again.
            if near := self._closer.close_again(poses, graph_of(len(poses), faulty.held), loops):
                return near
            self._corrected = False
        if believed := self._believed(poses, known):
            return believed
        # Then anywhere: past a gap, a match may have been found in a corridor that looks the same.
        for off_m in (0.0, math.inf):
            possible = partial(self._possible, stretches, poses=poses, known=known, off_m=off_m)
            pairs = [
                (place, number)
                for number in stretches.untied(loops)
                for place in stretches.candidates(number, *possible(number))
                if (place, number) not in self._tried
            ]
            self._tried.update(pairs)
            test = {one: self._verify(stretches, *one) for one in sorted(pairs)}  # each place drawn once
            for claim in filter(None, map(test.__getitem__, pairs)):
                self._sets.add(claim)
            if believed := self._believed(poses, known):
                return believed
        assert self._corridors is not None
        found = self._corridors.believed(poses, known, loops)
        self._corrected = bool(found)
        return found

    def _follow(
        self,
        stretches: Stretches,
        followed: FollowedClaims,
        poses: FloatArray,
        faulty: FaultySteps,
        loops: Sequence[LoopCandidate],
    ) -> list[LoopCandidate]:
        """Search as `search`, where each claim is followed along both ways.

        Where that finds nothing also where steps that wheels alone tell may have led.
        """
        known, loose = (partial(one.motion, poses=poses) for one in (faulty.known, faulty.loose))
        untied = stretches.untied(loops)
        keys = stretches.keys[untied].tolist()
        for wider in (False, True):
            for number, key in zip(untied, keys, strict=True):
                possible, apart_m = self._possible(stretches, number, poses, faulty.known, 0.0)
                if wider:
                    possible = ~possible & self._possible(stretches, number, poses, faulty.loose, 0.0)[0]
                for place in stretches.candidates(number, possible, apart_m):
                    if (place, number) not in self._tried:
                        self._tried.add((place, number))
                        if found := self._searched(stretches, place, number):
                            followed.follow(int(stretches.keys[place]), key, np.array(found))
            if believed := followed.believed(keys, poses, known, loose, faulty):
                return believed
        return []

    def _possible(
        self, stretches: Stretches, number: int, poses: FloatArray, known: UncertaintyGraph, off_m: float
    ) -> tuple[BoolArray, FloatArray]:
        """(K,) the stretches to which a set, as long as can be, could move one; and how far from it they are.

        It may be off by ``off_m`` on top. What is as certain as places are wide is tried during mapping.
        """
        key = int(stretches.keys[number])
        sigmas_m = position_sigmas(known.relative_covariances(key, stretches.keys, poses))
        most_m = math.sqrt(self._gate * self._reach_m / stretches.spacing_m) * sigmas_m
        apart_m = np.hypot(*(poses[stretches.keys, :2] - poses[key, :2]).T)
        window_m = math.sqrt(2.0) * stretches.window_m
        possible = apart_m <= window_m + most_m + off_m
        return possible & ((self._followed is not None) | (most_m > self._config.reach_m)), apart_m

    def _searched(self, stretches: Stretches, place: int, number: int) -> list[float]:
        """The pose of a stretch at another; nothing if none is found."""

        def pose() -> list[float]:
            found = stretches.search(place, number)
            return found.pose.tolist() if found.found else []

        return self._result_cache.cached("place", float(number), pose)

    def _verify(self, stretches: Stretches, place: int, number: int) -> LoopCandidate | None:
        """Search the pose of a stretch at another; what is found as a claim."""
        if not (found := self._searched(stretches, place, number)):
            return None
        sigma = self._match.coarse_cell_m / self._config.sigmas
        covariance = np.diag(np.square([sigma, sigma, sigma / self._config.reach_m]))
        there, key = stretches.keys[[place, number]].tolist()
        candidate = self._closer.verify(there, key, np.array(found), covariance)
        motion = candidate.motion if candidate.accepted else None
        return None if motion is None or motion.degenerate else candidate

    def _believed(self, poses: FloatArray, known: UncertaintyGraph) -> list[LoopCandidate]:
        """The most plausible set; the estimate that it leads to judges the next."""
        sets, trial = self._sets, self._trial
        assert sets is not None and trial is not None
        seen, reach_m = partial(known.motion, poses=poses), self._config.reach_m
        ways_m = self._submaps.travelled_m  # from the start to the keyframes of a set
        found = [one for one in sets.largest() if np.ptp([ways_m(m.keyframe) for m in one]) >= reach_m]
        names = [tuple((claim.place, claim.keyframe) for claim in one) for one in found]
        for name, one in zip(names, found, strict=True):
            if name not in self._judged:
                self._judged[name] = self._cost(one, seen)
        plain = np.array([self._judged[name].cost for name in names])

        def judged(n: int) -> _Judged:
            if self._judged[names[n]].poses is None:
                self._judged[names[n]] = self._with_faults(found[n], seen, self._judged[names[n]])
            return self._judged[names[n]]

        def gain(n: int) -> float:
            return self._gate * len(found[n]) - judged(n).cost

        def order() -> Iterator[int]:
            # Plausible sets first, of them the nearest: there chance has the least room.
            yield from sorted(np.flatnonzero(plain <= self._gate).tolist(), key=lambda n: judged(n).sigma_m)
            yield from sorted(np.flatnonzero(plain > self._gate).tolist(), key=lambda n: judged(n).cost)

        # Faults cost a gate at least: they are looked for only where that decides.
        most = self._gate * np.array([len(one) for one in found]) - np.minimum(plain, self._gate)
        for n in order():
            gained = gain(n)
            if judged(n).cost > 2.0 * self._gate and gained <= 0.0:
                continue
            rivals = (m for m in np.flatnonzero(2.0 * most > gained).tolist() if m != n)
            offs = ((m, self._contradiction(sets.entailed(found[n], found[m]), seen)) for m in rivals)
            able = (m for m, off in offs if 2.0 * off > gained and gained < 2.0 * gain(m) < 2.0 * off)
            # Places that contradict each other are no rival.
            if any(self._longer(judged(m)) * trial.contradicted(found[m]) <= self._few for m in able):
                continue
            if more := self._confirmed(found[n], found, judged(n), poses, known):
                sets.remove(more)
                self._corrected = True
                return more
        return []

    def _confirmed(
        self,
        members: list[LoopCandidate],
        found: Sequence[list[LoopCandidate]],
        judged: _Judged,
        poses: FloatArray,
        known: UncertaintyGraph,
    ) -> list[LoopCandidate]:
        """Return a set with the claims that follow from it, if its surroundings fit and hardly contradict."""
        trial, stretches, reach_m = self._trial, self._stretches, self._config.reach_m
        assert trial is not None and stretches is not None
        longer = self._longer(judged)
        fits, refused = trial.hold(members)
        # One that fits where it cannot be shows that these places look alike.
        more = [one for one in fits if self._follows(one, known, judged)]
        held = len(members) + 2 * len(more) - len(fits) - refused
        if longer > 1.0:
            held += self._borne_out(members, found, partial(known.motion, poses=poses))
        # As long as it is seen from either end; where all of the map would pass, as a loop must be.
        anywhere = math.sqrt(self._gate) * judged.sigma_m > np.ptp(poses[:, :2], axis=0).max()
        least_m = longer * (self._config.least_path_m if anywhere else 2.0 * reach_m)
        enough = held * stretches.spacing_m >= least_m
        return [*members, *more] if enough and longer * trial.contradicted(members) <= self._few else []

    def _longer(self, judged: _Judged) -> float:
        """Return how many times as long a set must be, and contradict less, if it needs several faults."""
        return max(1.0, judged.cost / self._gate - 1.0)

    def _borne_out(
        self, members: Sequence[LoopCandidate], found: Sequence[list[LoopCandidate]], known: Known
    ) -> int:
        """Return how many other keyframes nearby have claims in sets that agree, minus claims that disagree.

        Sets that agree count only if the path between their places is known; all that disagree count.
        """
        assert self._sets is not None
        same, otherwise = set[int](), 0
        for other in found:
            way = None if other is members else self._sets.entailed(members, other)
            if way is None:
                continue
            off = self._contradiction(way, known)
            between_m = position_sigmas(known(*way[:2]).covariance[None])
            if off > 2.0 * self._gate:
                otherwise += len(other)
            elif off <= self._gate and between_m[0] <= self._config.reach_m:
                same |= {claim.keyframe for claim in other}
        return len(same - {claim.keyframe for claim in members}) - otherwise

    def _cost(self, members: Sequence[LoopCandidate], known: Known) -> _Judged:
        """Return the cost of a set without faults; infinite if it adds no information.

        That is so if the known motion is as certain as a search. The poses are None if faults may explain it.
        """
        assert self._faulty is not None
        expected = [known(one.place, one.keyframe) for one in members]
        sigma_m = float(np.median(position_sigmas(np.array([way.covariance for way in expected]))))
        if self._config.sigmas * sigma_m < self._match.coarse_cell_m:
            return _Judged(math.inf, sigma_m, self._faulty.poses)
        if not math.isfinite(sigma_m):
            return _Judged(0.0, sigma_m, self._faulty.poses)
        both = zip(expected, map(claimed, members), strict=True)
        plain = [way.widened(said.covariance).squared_mahalanobis(said.pose) for way, said in both]
        cost = float(np.median(plain))
        return _Judged(cost, sigma_m, self._faulty.poses if cost <= self._gate else None)

    def _with_faults(self, members: Sequence[LoopCandidate], known: Known, plain: _Judged) -> _Judged:
        """Return the cost with faults of the path if these explain it better: each costs a gate."""
        assert self._faulty is not None
        expected = [known(one.place, one.keyframe) for one in members]
        asked = [self._bend(one, way) for one, way in zip(members, expected, strict=True)]
        cost = self._explained(*np.median(asked, axis=0).tolist())
        if cost > 2.0 * self._gate:
            n = int(np.argsort([possible for _, _, possible in asked])[len(asked) // 2])
            ends = members[n].place, members[n].keyframe
            # What a gate for each claim does not pay is never believed.
            most = min(cost, self._gate * len(members))
            together, led = self._faulty.shared(*ends, expected[n], claimed(members[n]), most)
            if together < cost:
                return _Judged(together, plain.sigma_m, led)
        return _Judged(cost, plain.sigma_m, self._faulty.poses)

    def _follows(self, one: LoopCandidate, known: UncertaintyGraph, judged: _Judged) -> bool:
        """Whether a claim asks no more than a set; of several faults, where they have moved the poses to."""
        assert self._faulty is not None and judged.poses is not None
        way = known.motion(one.place, one.keyframe, judged.poses)
        if judged.poses is not self._faulty.poses:
            return way.agrees(claimed(one))
        bend = self._bend(one, way)
        return min(bend[0], bend[2]) <= judged.cost + self._gate

    def _contradiction(self, entailed: tuple[int, int, Motion] | None, known: Known) -> float:
        """Squared sigmas by which what is known must be wrong for both of two sets to be true, as `_cost`."""
        if entailed is None:
            return 0.0
        assert self._faulty is not None
        start, end, said = entailed
        return self._explained(*self._faulty.explain(start, end, known(start, end), said))

    def _explained(self, plain: float, likeliest: float, possible: float) -> float:
        """As it is, or a gate and what is left where one fault explains it better."""
        return plain if plain <= self._gate + likeliest else self._gate + possible

    def _bend(self, claim: LoopCandidate, way: Motion) -> tuple[float, float, float]:
        """Squared sigmas by which a claim is off what is known, see `FaultySteps.explain`."""
        assert self._faulty is not None
        return self._faulty.explain(claim.place, claim.keyframe, way, claimed(claim))
