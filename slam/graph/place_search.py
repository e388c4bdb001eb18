"""Loops over the whole map: a stretch of the way is recognised wherever the estimate takes it to be.

What `slam.graph.loop_closure` closes while mapping lies within the uncertainty of the estimate. Where the chain is
bent, places are found by their appearance instead, and believed only in sets: claims that agree with each other
along the way (`slam.graph.consistent_sets`), and that together weigh more than the chain that they contradict.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from fusion.estimation import gate
from slam.config.stages import LoopConfig, MatchConfig
from slam.graph.consistent_sets import Claim, consistent, largest_sets
from slam.graph.loop_closure import LoopCandidate, LoopCloser
from slam.graph.pose_graph import Edge
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.graph.stretches import Stretches
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.measurements import BoolArray, FloatArray, row_from_pose2
from slam.result_cache import COMPUTED, ResultCache

log = logging.getLogger(__name__)


class PlaceSearch:
    """Searches a finished run round by round, each from the estimate that the last one led to."""

    def __init__(
        self,
        closer: LoopCloser,
        config: LoopConfig,
        match: MatchConfig,
        result_cache: ResultCache = COMPUTED,
    ) -> None:
        self._closer, self._submaps = closer, closer.submaps
        self._config, self._match, self._result_cache = config, match, result_cache
        self._sets: list[list[LoopCandidate]] | None = None

    def search(
        self, poses: FloatArray, edges: Sequence[Edge], kept: BoolArray, loops: Sequence[LoopCandidate]
    ) -> list[LoopCandidate]:
        """Loops that the estimate of the last optimisation lets one believe, none twice.

        Parameters
        ----------
        poses
            (n, 3) of all keyframes, map frame.
        edges, kept
            Of the graph, and which of them the optimisation has kept.
        loops
            All candidates so far.
        """
        if not self._config.enabled or len(poses) < 2:
            return []
        if self._sets is None:
            chain = graph_of(len(poses), (edge for edge in edges if edge.loop is None))
            found = self._claims(loops)
            self._sets = [s for s in self._grouped(found, chain) if self._long_enough(s)]
        return self._believed(poses, graph_of(len(poses), np.array(edges, object)[kept]))

    def _claims(self, loops: Sequence[LoopCandidate]) -> list[LoopCandidate]:
        """Whatever untied stretches look like, verified."""
        stretches = Stretches(self._submaps, self._config, self._match)
        sigma = self._match.coarse_cell_m / self._config.sigmas
        covariance = np.diag([sigma, sigma, sigma / self._config.reach_m]) ** 2
        claims = []
        for number in stretches.untied(loops):
            for place in stretches.alike(number):
                found = self._result_cache.cached(
                    "place",
                    float(number),
                    lambda place=place, number=number: self._pose(stretches, place, number),
                )
                if not found:
                    continue
                keys = int(stretches.keys[place]), int(stretches.keys[number])
                candidate = self._closer.verify(*keys, np.array(found), covariance)
                if candidate.accepted and candidate.motion is not None and not candidate.motion.degenerate:
                    claims.append(candidate)
        return claims

    @staticmethod
    def _pose(stretches: Stretches, place: int, number: int) -> list[float]:
        found = stretches.search(place, number)
        return found.pose.tolist() if found.found else []

    def _grouped(self, found: Sequence[LoopCandidate], chain: UncertaintyGraph) -> list[list[LoopCandidate]]:
        """Consistent sets."""
        way_m, reach = self._submaps.travelled_m, 3.0 * self._config.least_path_m
        poses = np.array([self._submaps.pose(key) for key in range(len(self._submaps))])
        ways: dict[tuple[int, int], Motion] = {}

        def way(a: int, b: int) -> Motion:
            if (a, b) not in ways:
                covariance = (
                    chain.relative_covariances(b, np.array([a]), poses)[0] if a != b else np.zeros((3, 3))
                )
                ways[a, b] = Motion(between(poses[a], poses[b]), covariance)
            return ways[a, b]

        agree = np.zeros((len(found), len(found)), np.bool_)
        for i, one in enumerate(found):
            for j, other in enumerate(found[:i]):
                if (
                    one.keyframe == other.keyframe
                    or max(
                        abs(way_m(one.keyframe) - way_m(other.keyframe)),
                        abs(way_m(one.place) - way_m(other.place)),
                    )
                    > reach
                ):
                    continue
                agree[i, j] = agree[j, i] = consistent(
                    _claim(one), _claim(other), way(one.place, other.place), way(one.keyframe, other.keyframe)
                )
        return [[found[k] for k in members] for members in largest_sets(agree)]

    def _long_enough(self, members: Sequence[LoopCandidate]) -> bool:
        way_m = [self._submaps.travelled_m(one.keyframe) for one in members]
        return max(way_m) - min(way_m) >= 2.0 * self._config.reach_m

    def _believed(self, poses: FloatArray, uncertainty: UncertaintyGraph) -> list[LoopCandidate]:
        """The sets that weigh more than what contradicts them, the weightiest of each neighbourhood."""
        gains = np.array([self._gain(s, poses, uncertainty) for s in self._sets])
        near_m = 3.0 * self._config.least_path_m
        taken: list[int] = []
        for n in np.argsort(-gains, kind="stable").tolist():
            if gains[n] <= 0.0:
                break
            if all(self._apart_m(self._sets[n], self._sets[m]) > near_m for m in taken):
                taken.append(n)
        believed = [one for n in taken for one in self._sets[n]]
        self._sets = [s for n, s in enumerate(self._sets) if n not in taken]
        return believed

    def _gain(
        self, members: Sequence[LoopCandidate], poses: FloatArray, uncertainty: UncertaintyGraph
    ) -> float:
        """What GNC's cost loses by keeping all of a set rather than refusing it: in squared sigmas."""
        squares = []
        for one in members:
            covariance = uncertainty.relative_covariances(one.keyframe, np.array([one.place]), poses)[0]
            if not np.isfinite(covariance).all():
                squares.append(0.0)
                continue
            claim = _claim(one).motion
            expected = Motion(between(poses[one.place], poses[one.keyframe]), covariance)
            squares.append(expected.widened(claim.covariance).squared_mahalanobis(claim.pose))
        return len(members) * gate(3, self._config.inlier_probability) - float(np.median(squares))

    def _apart_m(self, one: Sequence[LoopCandidate], other: Sequence[LoopCandidate]) -> float:
        """Way between the keyframes of two sets."""
        ways = [np.array([self._submaps.travelled_m(c.keyframe) for c in s]) for s in (one, other)]
        return float(max(ways[0].min() - ways[1].max(), ways[1].min() - ways[0].max()))


def graph_of(nodes: int, edges) -> UncertaintyGraph:
    """How uncertain nodes are of each other by some edges alone."""
    graph = UncertaintyGraph()
    for _ in range(nodes):
        graph.add_node()
    for edge in edges:
        graph.add_edge(edge.source, edge.target, row_from_pose2(edge.T_source_target), edge.covariance)
    return graph


def _claim(candidate: LoopCandidate) -> Claim:
    """What a verified candidate claims."""
    assert candidate.motion is not None
    motion = candidate.motion
    return Claim(
        candidate.place,
        candidate.keyframe,
        Motion(row_from_pose2(motion.T_reference_base), motion.covariance),
    )
