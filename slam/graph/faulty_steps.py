"""Steps of a chain that may be grossly wrong: a few are, wherever nothing but wheels told them.

Long stretches that both wheels and matches tell show how far wheels are off as a rule; that is less than they
claim, for a claim must cover jumps. So a step of wheels alone is two edges: one as certain as wheels are as a
rule, which may be refused, and one that allows what they claim.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST, ROUNDS, TINY, gate, median_to_sigma
from slam.config.stages import GraphConfig, LoopConfig, MatchConfig
from slam.graph.edge import GUESSES, Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph, graph_of, lone_steps, row_of, together, unmeasured
from slam.graph.relative_uncertainty import UncertaintyGraph, composed, inverse, moved
from slam.matching.motion import Motion
from slam.matching.planar import adjoint, between, compose, rotate_covariance
from slam.measurements import BoolArray, FloatArray, pose2_from_row, row_from_pose2


def settle_wheels(
    graph: KeyframeGraph, least_m: float, poses: FloatArray, stamps_s: FloatArray, config: GraphConfig
) -> None:
    """Let steps that wheels alone tell be as certain as wheels have proved, unless loops refuse that.

    Then as they claim; where loops refuse that, too, as what nothing measured. Proved on long stretches that
    matches tell throughout. Where scans lie so far apart that there are hardly any, on single steps of
    ``least_m`` and more, in the directions that a match tells better; and then along corridors, too.

    ``poses`` (n, 3) are where the wheels alone have the keyframes of ``stamps_s`` (n,).
    """
    edges = graph.graph.edges
    alone = [n for n, edge in enumerate(edges) if edge.kind is EdgeKind.WHEEL and edge.trusted]
    steps = np.zeros(len(graph), np.bool_)
    steps[[edges[n].source for n in alone]] = True
    longer = [
        edge
        for edge in edges
        if edge.kind is EdgeKind.WHEEL
        and edge.target - edge.source > 1
        and not steps[edge.source : edge.target].any()
    ]
    sparse = len(longer) < FEWEST
    errors = _calibrated_by_steps(edges, poses, least_m) if sparse else _errors_of_stretches(graph, longer)
    if not alone or len(errors) < FEWEST:
        return
    counts = np.isfinite(errors).sum(axis=0)
    errors[:, counts < FEWEST] = np.inf
    scale = np.minimum(median_to_sigma() * np.nanmedian(np.abs(errors), axis=0), 1.0)
    for n, edge in enumerate(edges[:-1] if sparse else []):
        # Of the two in a corridor the first tells the way, and of the turn nothing; the next the turn.
        if edge.kind is EdgeKind.WHEEL and edge.covariance[2, 2] > math.pi**2:
            for k, shares in ((n, [*scale[:2], 1.0]), (n + 1, [1.0, 1.0, scale[2]])):
                edges[k] = replace(edges[k], covariance=edges[k].covariance * np.outer(shares, shares))
    for n in alone:
        edge = edges[n]
        edges[n] = replace(edge, covariance=edge.covariance * np.outer(scale, scale), trusted=False)
        free = unmeasured(config, max(abs(stamps_s[edge.target] - stamps_s[edge.source]), 1.0), planar=True)
        # Both together are what wheels claim; where scans lie far apart too few loops tell of a step.
        claimed = edge.covariance @ np.linalg.solve(free, edge.covariance + free)
        both = [(edge.covariance, True)] if sparse else [(edge.covariance + free, True), (claimed, False)]
        for covariance, trusted in both:
            graph.add_edge(replace(edge, kind=EdgeKind.ASSUMED, covariance=covariance, trusted=trusted))


def _errors_of_stretches(graph: KeyframeGraph, longer: Sequence[Edge]) -> FloatArray:
    """(K, 3) errors of wheels on long stretches, in the sigmas that they claim."""
    rows = graph.rows()
    ends = np.array([(edge.source, edge.target) for edge in longer])
    claimed = np.array([row_of(edge.T_source_target) for edge in longer])
    off = _off(claimed, composed(inverse(rows[ends[:, 0]]), rows[ends[:, 1]]))
    return off / np.sqrt([np.diag(edge.covariance) for edge in longer])


def _calibrated_by_steps(edges: list[Edge], poses: FloatArray, least_m: float) -> FloatArray:
    """Let wheels tell what single matched steps have shown: how long a metre is, how much it and a turn turn.

    Radii that differ turn a robot at each metre, a wrong base at each turn: where scans lie far apart that
    bends a map more than all noise. (K, 3) errors are left on steps of ``least_m`` and more, in the sigmas
    that wheels claim; not a number where a match is less sure.
    """
    single = [edge for edge in edges if edge.target == edge.source + 1]
    wheels = together(edge for edge in single if edge.kind is EdgeKind.WHEEL)
    matches = together(edge for edge in single if edge.kind is EdgeKind.LIDAR)
    both = [(wheels[ends], match) for ends, match in matches.items() if ends in wheels]
    if sum(math.hypot(*match.pose[:2]) >= least_m for _, match in both) < FEWEST:
        return np.zeros((0, 3))
    # What was learned on the way changed with it.
    alone = _off(poses[:-1], poses[1:])
    told = alone[[source for source, target in matches if (source, target) in wheels]]
    found = np.array([match.pose for _, match in both])
    variances, known = (
        np.array([np.diag(motion.covariance) for motion in motions]) for motions in zip(*both, strict=True)
    )
    ways_m = np.hypot(told[:, 0], told[:, 1])
    longer_m = np.hypot(found[:, 0], found[:, 1]) - ways_m
    (stretch,) = _fitted(ways_m[:, None], longer_m, known[:, :2].sum(axis=1))
    # By what was found, which is all but certain: noise in what explains would make it explain less.
    bend, swell = _fitted(np.column_stack([ways_m, found[:, 2]]), _off(found, told)[:, 2], known[:, 2])

    def calibrated(steps: FloatArray) -> FloatArray:
        turned = (steps[:, 2] - bend * np.hypot(steps[:, 0], steps[:, 1])) / (1.0 + swell)
        half = np.pad(0.5 * (turned - steps[:, 2])[:, None], ((0, 0), (2, 0)))
        return composed(composed(half, steps * [1.0 + stretch, 1.0 + stretch, 1.0]), half)

    steps = np.zeros_like(alone)
    sources = [source for source, _ in wheels]
    steps[sources] = alone[sources]
    way = list(accumulate(calibrated(steps), compose, initial=np.zeros(3)))
    for n, edge in enumerate(edges):
        if edge.kind is EdgeKind.WHEEL:
            step = pose2_from_row(between(way[edge.source], way[edge.target]))
            edges[n] = replace(edge, T_source_target=step)
    errors = np.where(known < variances, _off(calibrated(told), found) / np.sqrt(variances), np.nan)
    return errors[np.hypot(found[:, 0], found[:, 1]) >= least_m]


def _fitted(design: FloatArray, measured: FloatArray, variances: FloatArray) -> FloatArray:
    """Small shares by least squares, with Cauchy's weights about the scale of the surest residuals."""
    values: FloatArray = np.zeros(design.shape[1])
    sure = variances <= np.median(variances)
    for _ in range(ROUNDS):
        off = measured - design @ values
        scale = median_to_sigma() * float(np.median(np.abs(off[sure])))
        weighted = design / (scale**2 + off**2 + variances)[:, None]
        # What the steps leave open is no larger than one in so many.
        information = weighted.T @ design + FEWEST**2 * np.eye(len(values))
        values = np.asarray(np.linalg.solve(information, weighted.T @ measured), np.float64)
    return values


def believed_edges(edges: Sequence[Edge], kept: BoolArray, poses: FloatArray) -> list[Edge]:
    """Edges that an optimisation has kept; where it has refused one of a step, all that may be are in doubt.

    They are as uncertain then as they are apart: only loops can tell which of them was right.
    """
    doubts: dict[tuple[int, int], FloatArray] = {}
    for edge, keep in zip(edges, kept, strict=True):
        if not keep and edge.loop is None:
            found = between(poses[edge.source], poses[edge.target])
            off = between(row_from_pose2(edge.T_source_target), found)
            ends = edge.source, edge.target
            doubts[ends] = doubts.get(ends, np.zeros((3, 3))) + np.outer(off, off)
    held = []
    for edge, keep in zip(edges, kept, strict=True):
        doubt = None if edge.trusted or edge.loop is not None else doubts.get((edge.source, edge.target))
        if doubt is not None:
            held.append(replace(edge, covariance=edge.covariance + doubt))
        elif keep:
            held.append(edge)
    return held


class FaultySteps:
    """What a claim asks of a chain a part of which is wrong: one step, or all steps of a gap.

    Parameters
    ----------
    edges, poses
        Of the graph: how far wrong a step may be is told by those of its edges that cannot be refused. Where
        it was matched, that is no more than what nothing measured in a second, or, less likely, in its time.
    kept
        (E,) which of them the optimisation has kept.
    stamps_s
        (n,) of the keyframes: in the time of a part the robot went and turned no farther than it does as a
        rule, and what is told on top, however many claims say so.
    config, loops, match
        What nothing measured; the share of the steps that are no faster than that rule, and how far
        surroundings reach; how far a step moves these at least that is wrong.

    Attributes
    ----------
    held
        The edges that are believed, loops among them.
    known
        How uncertain keyframes are of each other by these.
    unseen
        (n,) whether wheels alone tell the step from a keyframe to the next.
    share
        Of these steps, that is grossly wrong.
    """

    def __init__(
        self,
        edges: Sequence[Edge],
        kept: BoolArray,
        poses: FloatArray,
        stamps_s: FloatArray,
        config: GraphConfig,
        loops: LoopConfig,
        match: MatchConfig,
    ) -> None:
        self._poses, self._gate = poses, gate(3, loops.inlier_probability)
        limit = unmeasured(config, planar=True)
        single = [edge for edge in edges if edge.target == edge.source + 1]
        sources = np.array([edge.source for edge in single], np.int64)
        claimed = np.array([edge.covariance for edge in single]).reshape(-1, 3, 3)
        sure = [edge.trusted or edge.kind is EdgeKind.ASSUMED for edge in single]  # also what wheels claim
        trusted = np.array(sure, np.bool_)[:, None, None]
        measured = np.array([edge.kind not in GUESSES for edge in single], np.bool_)
        guessed = np.ones(len(poses), np.bool_)
        guessed[sources[measured]] = False
        # Of a second, and of its own time: what is disputed is no less open than that.
        longer = np.maximum(np.abs(took_s := np.diff(stamps_s)), 1.0)[sources]
        limits = limit * np.stack([np.ones_like(longer), longer])[..., None, None] ** 2
        most = np.where(trusted, limit, limits + claimed)
        information = np.where(measured[:, None, None], np.linalg.inv(most), 0.0)
        information += np.where(trusted, np.linalg.inv(claimed), 0.0)
        held = np.zeros((len(poses), 2, 3, 3))
        np.add.at(held, sources, information.swapaxes(0, 1))
        open_: FloatArray = np.linalg.inv(held[steps := np.unique(sources)]).astype(np.float64)
        moves_m = np.sqrt(np.diagonal(open_[:, 0], axis1=1, axis2=2)) * [1.0, 1.0, loops.reach_m]
        wrong = moves_m.max(axis=1) > match.coarse_cell_m
        parts: list[tuple[int, int, FloatArray]] = []
        for step, free in zip(steps[wrong].tolist(), open_[wrong], strict=True):
            if parts and parts[-1][1] == step and guessed[step] and guessed[step - 1]:
                first, _, before = parts.pop()
                back = adjoint(between(poses[step + 1], poses[step]))
                turned = np.stack([rotate_covariance(back, one) for one in before])
                parts.append((first, step + 1, turned + free))
            else:
                parts.append((step, step + 1, free))
        self._ends = np.array([part[:2] for part in parts], np.int64).reshape(-1, 2)
        self._free = np.array([part[2] for part in parts]).reshape(-1, 2, 3, 3)
        numbers = np.full(len(poses), -1)
        for n, (first, last) in enumerate(self._ends):
            numbers[first:last] = n
        self.held = believed_edges(edges, kept, poses)
        self.known = graph_of(len(poses), self.held, numbers)
        speeds = _moves(_off(poses[:-1], poses[1:])) / np.where(took_s > 0.0, took_s, np.inf)[:, None]
        begun, ended = self._ends.T
        time_s = np.abs(stamps_s[ended] - stamps_s[begun])[:, None]
        told = _moves(_off(poses[begun], poses[ended]))
        self.unseen, _, self.share = lone_steps(edges, kept, len(poses), config.lost_sigma_m)
        self._farthest = told + time_s * np.quantile(speeds, loops.inlier_probability, axis=0)

    @cached_property
    def loose(self) -> UncertaintyGraph:
        """How uncertain keyframes are of each other where all steps that wheels alone tell may be wrong."""
        alone = (e.kind is EdgeKind.WHEEL and self.unseen[e.source : e.target].any() for e in self.held)
        return graph_of(len(self._poses), (e for e, one in zip(self.held, alone, strict=True) if not one))

    @cached_property
    def _bounded(self) -> FloatArray:
        """(P, 2, 3, 3) how wrong each part may be; no more than the way round it allows."""
        bounded = self._free.copy()
        for n, (first, last) in enumerate(self._ends.tolist()):
            # Seen from its other end: the step's covariance is in the frame where it ends.
            around = self.known.relative_covariances(last, np.array([first]), self._poses, without=n)[0]
            if np.isfinite(around).all():
                bounded[n] = np.linalg.inv(np.linalg.inv(bounded[n]) + np.linalg.inv(around))
        return bounded

    def explain(self, start: int, end: int, known: Motion, claim: Motion) -> tuple[float, float, float]:
        """Squared sigmas by which a claim is off what is known, and what is left of them, at the least.

        Left where any part is wrong, and one that the robot can have moved so; infinite where there is none.
        What is known and the claim are the end seen from the start.
        """
        if not np.isfinite(known.covariance).all():
            return 0.0, math.inf, math.inf
        expected = known.widened(claim.covariance)
        _, squares, possible, _ = self._asked(start, end, expected, claim)
        any_part, able = (float(some.min(initial=np.inf)) for some in (squares, squares[possible]))
        return expected.squared_mahalanobis(claim.pose), any_part, able

    def likelihood(self, start: int, end: int, expected: Motion, claim: Motion) -> float:
        """Log of the density of a claim where a step was wrong that nothing saw.

        As likely as such steps have turned out wrong; expected is the end seen from the start, as uncertain
        as what is known and the claim are.
        """
        ends, squares, possible, covariances = self._asked(start, end, expected, claim)
        able = possible & self.unseen[ends[:, 0]]
        if not able.any() or not np.isfinite(expected.covariance).all():
            return -math.inf
        densities = -0.5 * (squares + np.linalg.slogdet(2.0 * math.pi * covariances)[1])
        return math.log(self.share) + float(densities[able].max())

    def _asked(
        self, start: int, end: int, expected: Motion, claim: Motion
    ) -> tuple[NDArray[np.int64], FloatArray, BoolArray, FloatArray]:
        """Of each part on the way: its ends (P, 2), the squared sigmas that a claim asks of it.

        And whether the robot can have moved so, and the covariances (P, 3, 3) that it is asked by.
        """
        within = (self._ends[:, 0] >= start) & (self._ends[:, 1] <= end)
        ends, poses = self._ends[within], self._poses
        first, last = ends.T
        # From the end of each part to the end of the way, and what the part must have been.
        rest = composed(inverse(poses[last]), poses[[end]])
        to_part = composed(inverse(poses[[start]]), poses[first])
        needed = _off(to_part, composed(claim.pose[None], inverse(rest)))
        off = _off(_off(poses[first], poses[last]), needed)
        around = moved(np.repeat(expected.covariance[None], len(rest), axis=0), rest)
        covariances, longer = np.moveaxis(self._bounded[within] + around[:, None], 1, 0)
        # Who may be wrong by more is so by chance the oftener: by the volumes, as in a mixture of both.
        volumes = np.diff(np.linalg.slogdet(self._free[within])[1])[:, 0]
        # What is farther than it can have gone the ways to the part and on from it must explain.
        shares = np.minimum(1.0, self._farthest[within] / np.maximum(_moves(needed), TINY))
        beyond = _off(needed * shares[:, [0, 0, 1]], needed)
        ways = moved(self.known.relative_covariances(start, first, poses), inverse(composed(to_part, needed)))
        ways += moved(self.known.relative_covariances(end, last, poses) + claim.covariance, rest)
        squares = np.minimum(_squares(off, covariances), _squares(off, longer) + volumes)
        return ends, squares, _squares(beyond, ways) <= self._gate, covariances


def _moves(motions: FloatArray) -> FloatArray:
    """(K, 2) way and turn of motions (K, 3)."""
    return np.column_stack([np.hypot(motions[:, 0], motions[:, 1]), np.abs(motions[:, 2])])


def _squares(off: FloatArray, covariances: FloatArray) -> FloatArray:
    """(K,) squared sigmas."""
    squares: FloatArray = np.einsum("ki,ki->k", off, np.linalg.solve(covariances, off[..., None])[..., 0])
    return squares


def _off(told: FloatArray, found: FloatArray) -> FloatArray:
    """(K, 3) what was found, seen from what was told."""
    off = composed(inverse(told), found)
    off[:, 2] = np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return off
