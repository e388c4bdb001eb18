"""Place recognition if scans are many metres apart: each claim is followed along both paths.

Then each pass sees a place only once, and a single scan proves nothing, since corridors look alike. But if a
claim is true, the scans before and after match too, and the known place contradicts hardly any of their
points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fusion.estimation import FEWEST, gate
from slam.config.stages import LoopConfig, MatchConfig
from slam.graph.consistent_sets import Known, after
from slam.graph.faulty_steps import FaultySteps
from slam.graph.loop_candidate import LoopCandidate, found_motion
from slam.graph.submaps import SubmapStore
from slam.matching.correlative import search_window
from slam.matching.match_covariance import motion_from_alignment
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.measurements import FloatArray


class Claim(NamedTuple):
    """Claim that a keyframe is at a place; evidence in nats of each scan on both paths, and matches."""

    place: int
    keyframe: int
    motion: Motion
    nats: dict[int, float]
    fits: list[LoopCandidate]


class FollowedClaims:
    """Claims, each followed once along the chain, and the selection of those plausible by an estimate."""

    def __init__(self, submaps: SubmapStore, config: LoopConfig, match: MatchConfig, window_m: float) -> None:
        self._submaps, self._config, self._match = submaps, config, match
        # Evidence that separates two hypotheses; limit of appearance, since a whole wing may be a copy.
        self._least, self._most = (share * gate(3, config.inlier_probability) for share in (0.5, 1.0))
        self._window = 2.0 * math.pi * (2.0 * window_m) ** 2
        # Lower limit of the evidence on where a path ends.
        self._claims, self._least_nats = list[Claim](), -math.inf

    def follow(self, place: int, keyframe: int, pose: FloatArray) -> None:
        """Add a claim: the pose (3,) of a keyframe in the frame of a place, found in a search window."""
        nats, fits = self._judged(place, keyframe, pose)
        evidence, begun = {keyframe: nats}, found_motion(fits[0]).pose if fits else pose
        for onward in (1, -1):
            at, expected, total = place, begun, 0.0
            for key in range(
                keyframe + onward, keyframe + onward * (1 + self._config.half_keyframes), onward
            ):
                if not 0 <= key < len(self._submaps) or total < -self._least:
                    break
                step = between(self._submaps.pose(key - onward), self._submaps.pose(key))
                nearest = self._nearest(at, compose(expected, step), key)
                if nearest is None:
                    break
                at, expected = nearest
                evidence[key], fit = self._judged(at, key, expected)
                total, expected = total + evidence[key], found_motion(fit[0]).pose if fit else expected
                fits += fit
        # The error rate of unobserved steps is known only when it is needed.
        if self._nats(evidence, keyframe, 0.5) > 0.5 * self._least:
            sigma_m = self._match.coarse_cell_m / self._config.sigmas
            covariance = np.diag([sigma_m**2, sigma_m**2, (sigma_m / self._config.reach_m) ** 2])
            self._claims.append(Claim(place, keyframe, Motion(pose, covariance), evidence, fits))

    def believed(
        self, untied: Sequence[int], poses: FloatArray, known: Known, loose: Known, faulty: FaultySteps
    ) -> list[LoopCandidate]:
        """Return loops of the likeliest claims by an estimate, poses (n, 3); else of those that agree.

        Parameters
        ----------
        untied
            Keyframes that no loop connects to an earlier place.
        known, loose
            Relative covariances by the estimate, and those if steps measured only by wheels may be wrong.
        """
        claims = [claim for claim in self._claims if claim.keyframe in untied]
        # However uncertain the path, it ends in the map.
        on_map = 2.0 * math.pi * float(np.ptp(poses[:, :2], axis=0).max()) ** 2
        self._least_nats = -math.log(max(on_map / self._window, 1.0))
        evidence = [self._nats(claim.nats, claim.keyframe, faulty.lone.share) for claim in claims]
        odds = [
            min(nats, self._most) + self._expected(known(claim.place, claim.keyframe), claim)
            for nats, claim in zip(evidence, claims, strict=True)
        ]
        at = [compose(poses[claim.place], claim.motion.pose)[:2] for claim in claims]
        chosen: list[Claim] = []
        for n in np.argsort(odds)[::-1].tolist():
            rivals = [
                odd
                for odd, claim, where in zip(odds, claims, at, strict=True)
                if claim.keyframe == claims[n].keyframe and math.dist(where, at[n]) > self._config.reach_m
            ]
            clear = odds[n] - max(rivals, default=-math.inf) > 0.5 * self._least
            if odds[n] > self._least and clear and all(self._apart(claims[n], claim) for claim in chosen):
                chosen.append(claims[n])
        chosen = chosen[: self._config.near] or self._agreeing(claims, odds, known, loose, faulty)
        self._claims = [claim for claim in self._claims if all(claim is not other for other in chosen)]
        return [fit for claim in chosen for fit in claim.fits]

    def _agreeing(
        self, claims: list[Claim], odds: list[float], known: Known, loose: Known, faulty: FaultySteps
    ) -> list[Claim]:
        """Return the likeliest claims that agree on the errors of steps measured only by wheels.

        The cost of these errors and the evidence of each scan count once.
        """
        costs = [self._likeliest(one, known, loose, faulty) for one in claims]
        possible = [n for n, nats in enumerate(costs) if self._most + nats > 0.0]
        sets: dict[int, tuple[float, list[int]]] = {}
        for n in possible:
            one = claims[n]
            same = [m for m in possible if m == n or self._borne(one, claims[m], known) > 0.0]
            best: dict[int, float] = {}
            for key, nats in (item for m in same for item in claims[m].nats.items()):
                best[key] = max(nats, best.get(key, nats))
            # A whole wing may be a copy; less likely if two claims have no scan in common.
            most = self._most + self._least * any(self._apart(one, claims[m]) for m in same)
            sets[n] = min(self._nats(best, one.keyframe, faulty.lone.share), most) + costs[n], same
        for n, (odd, same) in sorted(sets.items(), key=lambda item: -item[1][0]):
            rivals = [
                max(odds[m], sets.get(m, (-math.inf,))[0])
                for m, other in enumerate(claims)
                if m not in same
                and not self._apart(claims[n], other)
                and self._borne(claims[n], other, known) <= 0.0
            ]
            if odd > self._least and odd - max(rivals, default=-math.inf) > 0.5 * self._least:
                return [claims[m] for m in same]
        return []

    def _likeliest(self, one: Claim, known: Known, loose: Known, faulty: FaultySteps) -> float:
        """Return the evidence of the path for a claim, in nats: as estimated, or with wrong steps."""
        ends = one.place, one.keyframe
        rel = known(*ends)
        return max(
            self._expected(rel, one),
            math.log(faulty.lone.share) + self._expected(loose(*ends), one),
            math.log(self._window) + faulty.likelihood(*ends, rel.widened(one.motion.covariance), one.motion),
        )

    def _borne(self, one: Claim, other: Claim, known: Known) -> float:
        """Return by how many nats a claim makes another one likelier."""
        onward = after(one.motion, known(one.keyframe, other.keyframe))
        expected = after(known(other.place, one.place), onward)
        away_m = math.dist(expected.pose[:2], other.motion.pose[:2])
        if one.keyframe == other.keyframe and away_m > self._config.reach_m:
            return -math.inf
        return self._expected(expected, other)

    def _nats(self, evidence: dict[int, float], keyframe: int, share: float) -> float:
        """Return the evidence of all scans; after an unobserved step, its error probability limits it."""
        totals = {1: 0.0, -1: 0.0}
        for onward in totals:
            for key in sorted(evidence, key=lambda key: -onward * key):
                if (key - keyframe) * onward > 0:
                    totals[onward] += evidence[key]
                    if self._submaps.parted(key, key - onward):
                        right, wrong = math.log1p(-share), math.log(share)
                        totals[onward] = float(np.logaddexp(right + totals[onward], wrong))
        return evidence[keyframe] + sum(totals.values())

    def _apart(self, one: Claim, other: Claim) -> bool:
        """Return whether no scan supports both of two claims."""
        return abs(one.keyframe - other.keyframe) > 2 * self._config.half_keyframes

    def _expected(self, relative: Motion, claim: Claim) -> float:
        """Return the log likelihood ratio of a claim by the path, against any pose in the window, in nats.

        The tails are heavy: steps may be grossly wrong.
        """
        if not np.isfinite(relative.covariance).all():
            return 0.0
        relative = relative.widened(claim.motion.covariance)
        tail = 3 * math.log1p(relative.squared_mahalanobis(claim.motion.pose) / 3)
        nats = math.log(self._window / math.sqrt((2.0 * math.pi) ** 3 * relative.volume()))
        return max(nats, self._least_nats) - tail

    def _nearest(self, place: int, pose: FloatArray, key: int) -> tuple[int, FloatArray] | None:
        """Return the place nearest to a pose (3,), near a place on its path, and the pose in its frame."""
        submaps, nearest = self._submaps, None
        away_m = submaps.wide_m(self._config.reach_m, 2.0)
        for one in range(max(0, place - 3), min(len(submaps), place + 4)):
            seen = compose(between(submaps.pose(one), submaps.pose(place)), pose)
            far = abs(submaps.travelled_m(key) - submaps.travelled_m(one)) > submaps.least_path_m
            if far and math.hypot(seen[0], seen[1]) < away_m:
                away_m, nearest = math.hypot(seen[0], seen[1]), (one, seen)
        return nearest

    def _judged(self, place: int, key: int, pose: FloatArray) -> tuple[float, list[LoopCandidate]]:
        """Return the evidence of a scan matched near a pose (3,), in nats; and the loop, if it fits.

        At a true place, few points contradict the map, and few false places fit so well: a fit counts as
        about four times likelier, as measured, and less with more contradictions.
        """
        local_map, scan = self._submaps.surroundings(place), self._submaps.scan(key)
        config, match = self._config, self._match
        if min(len(scan), len(local_map.points)) < FEWEST:
            return 0.0, []
        few = config.sigmas * (1.0 - config.inlier_probability)
        found = local_map.align(scan, pose)
        contradicted = local_map.contradicted(scan, found.pose)
        if contradicted > few or found.inlier_share < config.least_overlap:
            # The step before may be wrong by more than an alignment corrects.
            window = pose, config.every_m, match.search_half_yaw_rad / 4, match.search_least_score
            better = search_window(self._submaps.field(place), scan.thinned(match.search_points), *window)
            again = local_map.align(scan, better.pose)
            if better.found and again.inlier_share > found.inlier_share:
                found, contradicted = again, local_map.contradicted(scan, again.pose)
        if (found.inlier_share + contradicted) * len(scan) < FEWEST / 2:
            return 0.0, []
        nats = max(math.log(4) * (1.0 - contradicted / few), -2)
        if nats <= 0.0 or found.inlier_share < config.least_overlap or key < place:
            return nats, []
        # Surroundings with an uncertain pose show that it fits, but not the pose of the place itself.
        found = self._submaps.surroundings(place, own=True).align(scan, found.pose)
        if found.inlier_share < config.least_overlap:
            return nats, []
        motion = motion_from_alignment(found, match)
        motion = replace(motion, covariance=motion.covariance * config.caution)
        width_m, yaw_rad = config.every_m, match.search_half_yaw_rad
        return nats, [LoopCandidate(place, key, width_m, yaw_rad, found.inlier_share, motion, True, "")]
