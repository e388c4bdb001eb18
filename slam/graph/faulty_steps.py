"""Steps of a chain that may be grossly wrong: a few are, wherever nothing but wheels told them.

Long stretches that both wheels and matches tell show how far wheels are off as a rule; that is less than they
claim, for a claim must cover jumps. So a step of wheels alone is two edges: one as certain as wheels are as a
rule, which may be refused, and one that allows what they claim.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.estimation import FEWEST, median_to_sigma
from slam.config.stages import GraphConfig
from slam.graph.keyframe_graph import KeyframeGraph, row_of, unmeasured
from slam.graph.pose_graph import Edge, EdgeKind
from slam.graph.relative_uncertainty import composed, inverse, moved
from slam.matching.motion import Motion
from slam.measurements import FloatArray


def settle_wheels(graph: KeyframeGraph) -> None:
    """Let the steps that wheels alone tell be as certain as wheels have proved, unless loops refuse that."""
    edges = graph.graph.edges
    alone = [n for n, edge in enumerate(edges) if edge.kind is EdgeKind.WHEEL and edge.trusted]
    steps = np.zeros(len(graph), np.bool_)
    steps[[edges[n].source for n in alone]] = True
    told = np.cumsum(steps)
    longer = [
        edge
        for edge in edges
        if edge.kind is EdgeKind.WHEEL
        and edge.target - edge.source > 1
        and told[edge.target - 1] - told[edge.source] + steps[edge.source] == 0
    ]
    if not alone or len(longer) < FEWEST:
        return
    rows = graph.rows()
    ends = np.array([(edge.source, edge.target) for edge in longer])
    claimed = np.array([row_of(edge.T_source_target) for edge in longer])
    off = composed(inverse(claimed), composed(inverse(rows[ends[:, 0]]), rows[ends[:, 1]]))
    off[:, 2] = np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    sigmas = np.sqrt([np.diag(edge.covariance) for edge in longer])
    scale = np.minimum(median_to_sigma() * np.median(np.abs(off) / sigmas, axis=0), 1.0)
    for n in alone:
        edge = edges[n]
        edges[n] = replace(edge, covariance=edge.covariance * np.outer(scale, scale), trusted=False)
        graph.add_edge(replace(edge, kind=EdgeKind.ASSUMED))


class FaultySteps:
    """What a claim asks of a chain one step of which is wrong.

    Parameters
    ----------
    edges
        Of the graph: how far wrong a step may be is what of its edges cannot be refused, but no more than what
        nothing measured.
    least_m
        A step as certain as this is not wrong; nor one that turns the surroundings no more than this.
    lever_m
        How far these are.
    """

    def __init__(self, edges: Sequence[Edge], config: GraphConfig, least_m: float, lever_m: float) -> None:
        limit = np.linalg.inv(unmeasured(config, planar=True))
        held: dict[int, FloatArray] = {}
        for edge in edges:
            if edge.target == edge.source + 1:
                information = np.linalg.inv(edge.covariance) if edge.trusted else np.zeros((3, 3))
                if edge.kind is EdgeKind.LIDAR:
                    information = information + limit
                held[edge.source] = held.get(edge.source, np.zeros((3, 3))) + information
        free = np.linalg.inv(np.array([*held.values()]).reshape(-1, 3, 3))
        sigmas = np.sqrt(np.diagonal(free, axis1=1, axis2=2)) * [1.0, 1.0, lever_m]
        unsure = sigmas.max(axis=1, initial=0.0) > least_m
        self._steps = np.array([*held], np.int64)[unsure]
        self._free = free[unsure]

    def squared_mahalanobis(
        self, start: int, end: int, expected: Motion, claimed: FloatArray, poses: FloatArray
    ) -> float:
        """Squared sigmas by which a claim is off, at the least, where one step on the way is wrong.

        Parameters
        ----------
        expected
            The end seen from the start, were no step wrong.
        claimed
            (3,) the same, as claimed.
        poses
            (n, 3) of all keyframes, map frame.

        Returns
        -------
        Infinite where no step on the way may be wrong.
        """
        within = (self._steps >= start) & (self._steps < end)
        steps, free = self._steps[within], self._free[within]
        if not len(steps):
            return np.inf
        # From each step's end to the end of the way, and what the step must have been.
        rest = composed(inverse(poses[steps + 1]), poses[[end]])
        to_step = composed(inverse(poses[[start]]), poses[steps])
        needed = composed(composed(inverse(to_step), claimed[None]), inverse(rest))
        off = composed(inverse(composed(inverse(poses[steps]), poses[steps + 1])), needed)
        off[:, 2] = np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi
        covariances = free + moved(np.repeat(expected.covariance[None], len(steps), axis=0), rest)
        squares = np.einsum("ki,ki->k", off, np.linalg.solve(covariances, off[..., None])[..., 0])
        return float(squares.min())
