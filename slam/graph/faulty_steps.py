"""Steps of a chain that may have gross errors: a few do, wherever only wheel odometry measured them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY, gate
from slam.config.stages import GraphConfig, LoopConfig, MatchConfig
from slam.graph.edge import GUESSES, Edge, EdgeKind
from slam.graph.fault_sharing import share_faults
from slam.graph.keyframe_graph import LoneSteps, graph_of, lone_steps, tied, unmeasured
from slam.graph.relative_uncertainty import UncertaintyGraph, composed, inverse, moved, seen_from
from slam.matching.motion import Motion
from slam.matching.planar import adjoint, between, rotate_covariance
from slam.measurements import BoolArray, FloatArray, row_from_pose2


def believed_edges(edges: Sequence[Edge], kept: BoolArray, poses: FloatArray) -> list[Edge]:
    """Edges that an optimisation has kept; where it has refused one of a step, all that may be are in doubt.

    They are as uncertain then as they are apart: only loops can tell which of them was right.
    """
    doubts: dict[tuple[int, int], FloatArray] = {}
    for edge, keep in zip(edges, kept, strict=True):
        if not keep and edge.loop is None:
            estimate = between(poses[edge.source], poses[edge.target])
            error = between(row_from_pose2(edge.T_source_target), estimate)
            ends = edge.source, edge.target
            doubts[ends] = doubts.get(ends, np.zeros((3, 3))) + np.outer(error, error)
    held = []
    for edge, keep in zip(edges, kept, strict=True):
        doubt = None if edge.trusted or edge.loop is not None else doubts.get((edge.source, edge.target))
        if doubt is not None:
            held.append(replace(edge, covariance=edge.covariance + doubt))
        elif keep:
            held.append(edge)
    return held


class FaultySteps:
    """What a claim asks of a chain parts of which are wrong: single steps, or all steps of a gap.

    Parameters
    ----------
    edges, poses
        Of the graph: edges that cannot be rejected limit the error of a step. If it was matched, the error
        is at most that of an unmeasured second, or, less likely, of an unmeasured step of its duration.
    kept
        (E,) which of them the optimisation has kept.
    stamps_s
        (n,) of the keyframes: in the time of a part the robot moved and turned no farther than its usual
        speed allows, plus the estimated motion, however many claims say so.
    config, loops, match
        What nothing measured; the share of the steps that are no faster than that rule, and how far
        surroundings reach; how far a step moves these at least that is wrong.

    Attributes
    ----------
    poses
        As above.
    held
        The edges that are believed, loops among them.
    known
        How uncertain keyframes are of each other by these.
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
        self.poses, self._gate = poses, gate(3, loops.inlier_probability)
        limit = unmeasured(config, planar=True)
        single = [edge for edge in edges if edge.target == edge.source + 1]
        sources = np.array([edge.source for edge in single], np.int64)
        claimed = np.array([edge.covariance for edge in single]).reshape(-1, 3, 3)
        # What wheels claim of a lone step may be refused as well: then it costs one edge more.
        claims = np.array([not edge.trusted and edge.kind is EdgeKind.ASSUMED for edge in single], np.bool_)
        trusted = np.array([edge.trusted for edge in single], np.bool_)
        trusted = np.stack([trusted | claims, trusted | claims, trusted], axis=1)[..., None, None]
        measured = np.array([edge.kind not in GUESSES for edge in single], np.bool_)
        guessed = np.ones(len(poses), np.bool_)
        guessed[sources[measured]] = False
        # In a direction that matches leave open, wheels measure.
        spread = np.linalg.eigvalsh(claimed[:, :2, :2])[:, -1]
        matched = np.full(len(poses), -np.inf)
        np.maximum.at(matched, sources[measured], spread[measured])
        wheels = np.array([edge.kind is EdgeKind.WHEEL for edge in single], np.bool_)
        wheels &= spread < matched[sources]
        counted = np.stack([measured | wheels, measured, measured], axis=1)[..., None, None]
        # Of a second, with wheels and without, and of its own time: what is disputed is no less open.
        longer = np.maximum(np.abs(took_s := np.diff(stamps_s)), 1.0)[sources]
        limits = limit * np.stack([once := np.ones_like(longer), once, longer])[..., None, None] ** 2
        most = np.where(trusted, limit, limits.swapaxes(0, 1) + claimed[:, None])
        information = np.where(counted, np.linalg.inv(most), 0.0)
        information += np.where(trusted, np.linalg.inv(claimed)[:, None], 0.0)
        held = np.zeros((len(poses), 3, 3, 3))
        np.add.at(held, sources, information)
        open_: FloatArray = np.linalg.inv(held[steps := np.unique(sources)]).astype(np.float64)
        moves_m = np.sqrt(np.diagonal(open_[:, -1], axis1=1, axis2=2)) * [1.0, 1.0, loops.reach_m]
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
        self._free = np.array([part[2] for part in parts]).reshape(-1, 3, 3, 3)
        self._alone = np.array([guessed[first:last].all() for first, last in self._ends], np.bool_)
        first, last = np.bincount(sources[claims] + 1, minlength=len(poses) + 1).cumsum()[self._ends.T]
        self._prices = np.where(first < last, self._gate, 0.0)
        self._numbers = np.full(len(poses), -1)
        for n, (first, last) in enumerate(self._ends):
            self._numbers[first:last] = n
        self.held = believed_edges(edges, kept, poses)
        self._judged = edges, kept, len(poses), config.lost_sigma_m
        # Too few loops across a step that only wheels measured may be at a place that looks the same.
        ties = tied(edges, kept, self.lone.unseen, poses, 2.0 * loops.reach_m)
        few = {edge.loop for edge, enough in zip(edges, ties, strict=True) if not enough} - {None}
        self.known = graph_of(len(poses), (e for e in self.held if e.loop not in few), self._numbers)
        speeds = _moves(seen_from(poses[:-1], poses[1:])) / np.where(took_s > 0.0, took_s, np.inf)[:, None]
        begun, ended = self._ends.T
        time_s = np.abs(stamps_s[ended] - stamps_s[begun])[:, None]
        self._time_s = np.maximum(time_s[:, 0], 1.0)
        moved = _moves(seen_from(poses[begun], poses[ended]))
        self._farthest = moved + time_s * np.quantile(speeds, loops.inlier_probability, axis=0)

    @cached_property
    def lone(self) -> LoneSteps:
        """Of steps that wheels alone tell."""
        return lone_steps(*self._judged)

    @cached_property
    def loose(self) -> UncertaintyGraph:
        """How uncertain keyframes are of each other where all steps that wheels alone tell may be wrong."""
        if not self.lone.unseen.any():
            return self.known
        alone = (e.kind is EdgeKind.WHEEL and self.lone.unseen[e.source : e.target].any() for e in self.held)
        held = (edge for edge, one in zip(self.held, alone, strict=True) if not one)
        return graph_of(len(self.poses), held, self._numbers)

    @cached_property
    def _bounded(self) -> FloatArray:
        """(P, 3, 3, 3) how wrong each part may be; no more than the way round it allows."""
        return self._bounded_by(self.known)

    @cached_property
    def _bounded_loosely(self) -> FloatArray:
        """The same, where what wheels alone tell on the way round may be wrong, too."""
        return self._bounded_by(self.loose)

    def _bounded_by(self, graph: UncertaintyGraph) -> FloatArray:
        bounded = self._free.copy()
        for n, (first, last) in enumerate(self._ends.tolist()):
            # Seen from its other end: the step's covariance is in the frame where it ends.
            around = graph.relative_covariances(last, np.array([first]), self.poses, without=n)[0]
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
        asked = self._asked(start, end, expected, claim, self.poses, self._bounded)
        squares = asked.squares
        any_part, possible = (float(some.min(initial=np.inf)) for some in (squares, squares[asked.possible]))
        return expected.squared_mahalanobis(claim.pose), any_part, possible

    def shared(
        self, start: int, end: int, known: Motion, claim: Motion, most: float = math.inf
    ) -> tuple[float, FloatArray]:
        """Squared sigmas that a claim asks of parts that are wrong together, and a gate for each of them.

        One of them may be on the way round another. What is known and the claim are the end seen from the
        start; infinite where no part can be wrong so for less than ``most``. And the poses (n, 3) then.
        """
        best = math.inf, self.poses
        if not np.isfinite(known.covariance).all():
            return best
        for loosely, alone in product((False, True), (True, False)):
            paid = self._gate * loosely
            budget = min(most, best[0]) - paid
            if self._gate < budget and not (loosely and self.loose is self.known):
                bounded = self._bounded_loosely if loosely else self._bounded
                cost, poses = self._chosen(start, end, known, claim, bounded, alone, budget)
                best = min(best, (paid + cost, poses), key=lambda one: one[0])
        return best

    def _chosen(
        self,
        start: int,
        end: int,
        known: Motion,
        claim: Motion,
        bounded: FloatArray,
        alone: bool,
        most: float,
    ) -> tuple[float, FloatArray]:
        """The part that explains most of what the others leave comes next, as long as that pays.

        Each may be wrong alone, or all together: infinite where one is farther wrong than the robot goes.
        """
        expected, poses = known.widened(claim.covariance), self.poses
        least, best = math.inf, (math.inf, poses)
        chosen: dict[int, FloatArray] = {}
        paid = 0.0
        while paid + self._gate < min(most, least):
            asked = self._asked(start, end, expected, claim, poses, bounded)
            left_out = ~np.isin(asked.numbers, [*chosen]) & (asked.possible | (not alone))
            if not left_out.any():
                break
            n = int(np.where(left_out, asked.squares, np.inf).argmin())
            chosen[int(asked.numbers[n])] = asked.wrong[n]
            parts = sorted(chosen)
            wrong = np.array([chosen[one] for one in parts])
            behind = self.poses[start:], self._ends[parts] - start, wrong, end - start
            remaining, path = share_faults(*behind, claim.pose, expected.covariance)
            paid += self._gate + asked.volumes[n]
            if (cost := remaining + paid) >= least:
                break
            least, poses = cost, np.concatenate([self.poses[:start], path])
            first, last = self._ends[parts].T
            if alone or (_moves(seen_from(poses[first], poses[last])) <= self._farthest[parts]).all():
                best = cost, poses
        return best

    def likelihood(self, start: int, end: int, expected: Motion, claim: Motion) -> float:
        """Log of the density of a claim where a step was wrong that nothing saw.

        As likely as such steps have turned out wrong; expected is the end seen from the start, as uncertain
        as what is known and the claim are.
        """
        asked = self._asked(start, end, expected, claim, self.poses, self._bounded)
        possible = asked.possible & self.lone.unseen[self._ends[asked.numbers, 0]]
        if not possible.any() or not np.isfinite(expected.covariance).all():
            return -math.inf
        densities = -0.5 * (asked.squares + np.linalg.slogdet(2.0 * math.pi * asked.covariances)[1])
        return math.log(self.lone.share) + float(densities[possible].max())

    def _asked(
        self, start: int, end: int, expected: Motion, claim: Motion, poses: FloatArray, bounded: FloatArray
    ) -> _Asked:
        """What a claim asks of each part on the way, were it wrong alone."""
        (numbers,) = np.nonzero((self._ends[:, 0] >= start) & (self._ends[:, 1] <= end))
        first, last = self._ends[numbers].T
        # From the end of each part to the end of the way, and what the part must have been.
        rest = composed(inverse(poses[last]), poses[[end]])
        to_part = composed(inverse(poses[[start]]), poses[first])
        needed = seen_from(to_part, composed(claim.pose[None], inverse(rest)))
        error = seen_from(seen_from(poses[first], poses[last]), needed)
        around = moved(np.repeat(expected.covariance[None], len(rest), axis=0), rest)
        own, _, wider = np.moveaxis(bounded[numbers], 1, 0)
        # Who may be wrong by more is so by chance the oftener: by the volumes, as in a mixture of both.
        free, longer = np.linalg.slogdet(np.moveaxis(self._free[numbers, 1:], 1, 0))[1]
        # A heading that slips on the way bends it, more than a straight line that is claimed.
        farthest, alone = self._farthest[numbers], self._alone[numbers]
        bent_m = 2.0 * np.abs(np.sin(0.5 * error[:, 2])) * farthest[:, 0]
        bends = own + np.square([bent_m, bent_m, np.zeros_like(bent_m)]).T[..., None] * np.eye(3)
        nats = np.where(alone, np.linalg.slogdet(bends)[1] - np.linalg.slogdet(own)[1], np.inf)
        # Over a matched step, a position that is off without a heading adds up like a random walk.
        time_s = self._time_s[numbers]
        share = np.where(alone, 1.0, np.minimum(1.0, (bent_m + np.sqrt(time_s)) / time_s))
        shrunk = np.stack([share, share, np.ones_like(share)], axis=1)
        wider = wider * shrunk[:, :, None] * shrunk[:, None]
        longer = longer + np.log(np.square(shrunk)).sum(axis=1)
        # What is farther than it can have gone the ways to the part and on from it must explain.
        shares = np.minimum(1.0, farthest / np.maximum(_moves(needed), TINY))
        beyond = seen_from(needed * shares[:, [0, 0, 1]], needed)
        cov = moved(self.known.relative_covariances(start, first, poses), inverse(composed(to_part, needed)))
        cov += moved(self.known.relative_covariances(end, last, poses) + claim.covariance, rest)
        possible = _squares(beyond, cov) <= self._gate
        price = np.where(alone & ~possible, np.inf, np.maximum(longer - free, 0.0) + self._prices[numbers])
        options, larger = np.stack([own, bends, wider]), np.stack([np.zeros_like(free), nats, price])
        squares = np.stack([_squares(error, one + around) for one in options]) + larger
        best = squares.argmin(axis=0), np.arange(len(error))
        return _Asked(numbers, squares[best], possible, own + around, options[best], larger[best])


class _Asked(NamedTuple):
    """Of P parts: numbers, squared sigmas, whether the robot can have moved so, by which covariances.

    Last how wrong each may be by which that is asked least, and by a log of how much more volume.
    """

    numbers: NDArray[np.int64]
    squares: FloatArray
    possible: BoolArray
    covariances: FloatArray
    wrong: FloatArray
    volumes: FloatArray


def _moves(motions: FloatArray) -> FloatArray:
    """(K, 2) way and turn of motions (K, 3)."""
    return np.column_stack([np.hypot(motions[:, 0], motions[:, 1]), np.abs(motions[:, 2])])


def _squares(rows: FloatArray, covariances: FloatArray) -> FloatArray:
    """(K,) squared sigmas."""
    squares: FloatArray = np.einsum("ki,ki->k", rows, np.linalg.solve(covariances, rows[..., None])[..., 0])
    return squares
