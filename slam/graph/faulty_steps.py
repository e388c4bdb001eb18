"""Steps of a chain that may be grossly wrong: a few are, wherever nothing but wheels told them.

Long stretches that both wheels and matches tell show how far wheels are off as a rule; that is less than they
claim, for a claim must cover jumps. So a step of wheels alone is two edges: one as certain as wheels are as a
rule, which may be refused, and one that allows what they claim.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST, median_to_sigma
from slam.graph.keyframe_graph import KeyframeGraph, row_of
from slam.graph.loop_closure import position_sigmas
from slam.graph.pose_graph import Edge, EdgeKind
from slam.graph.relative_uncertainty import composed, inverse, moved
from slam.matching.motion import Motion
from slam.measurements import FloatArray


def settle_steps(graph: KeyframeGraph, reach_m: float) -> None:
    """Let no step be freer than it can be, and wheels that alone tell one be as certain as they have proved.

    Parameters
    ----------
    reach_m
        Two scans that match see the same: they are no farther apart than this.
    """
    edges = graph.graph.edges
    matched = {edge.source for edge in edges if edge.kind is EdgeKind.LIDAR}
    limit = np.diag(np.square([reach_m, reach_m, math.pi]))
    for step, free in zip(*_free_steps(edges), strict=True):
        if step in matched and position_sigmas(free[None])[0] > reach_m:
            here, there = (graph.graph.pose(key) for key in (step, step + 1))
            graph.add_edge(
                Edge(int(step), int(step) + 1, here.between(there), limit, EdgeKind.ASSUMED, trusted=True)
            )
    _settle_wheels(graph)


def _settle_wheels(graph: KeyframeGraph) -> None:
    """Two edges for each step of wheels alone, see above, where enough long stretches were told by both."""
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
        Of the graph: how far wrong a step may be is told by those of its edges that cannot be refused.
    least_m
        A step as certain as this is not wrong; nor one that turns the surroundings no more than this.
    lever_m
        How far these are.
    """

    def __init__(self, edges: Sequence[Edge], least_m: float, lever_m: float) -> None:
        steps, free = _free_steps(edges)
        sigmas = np.sqrt(np.diagonal(free, axis1=1, axis2=2)) * [1.0, 1.0, lever_m]
        unsure = sigmas.max(axis=1, initial=0.0) > least_m
        self._steps, self._free = steps[unsure], free[unsure]

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


def _free_steps(edges: Sequence[Edge]) -> tuple[NDArray[np.int64], FloatArray]:
    """(K,) where each step begins, and (K, 3, 3) how uncertain what cannot be refused leaves it."""
    held: dict[int, FloatArray] = {}
    for edge in edges:
        if edge.trusted and edge.target == edge.source + 1:
            held[edge.source] = held.get(edge.source, np.zeros((3, 3))) + np.linalg.inv(edge.covariance)
    free = np.linalg.inv(np.array([*held.values()]).reshape(-1, 3, 3))
    return np.array([*held], np.int64), free
