"""Places recognised where scans lie many metres apart: each claim is followed along both ways.

There a pass sees a place once, and one scan tells nothing, for corridors look alike. But where a claim is
true the scans before and after fit as well, and what the place knows contradicts hardly any of their points.
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
from slam.graph.loop_closure import LoopCandidate, found_motion
from slam.graph.submaps import SubmapStore
from slam.matching.correlative import build_field, search_window
from slam.matching.match_covariance import motion_from_alignment
from slam.matching.motion import Motion
from slam.matching.planar import between, compose, diagonal
from slam.measurements import FloatArray


class Claim(NamedTuple):
    """That a keyframe is at a place; what the scans along both ways say for it, and those that fit."""

    place: int
    keyframe: int
    said: Motion
    nats: float
    fits: list[LoopCandidate]


class FollowedClaims:
    """Claims, each followed once along the chain, and which of them an estimate lets one believe."""

    def __init__(self, submaps: SubmapStore, config: LoopConfig, match: MatchConfig, window_m: float) -> None:
        self._submaps, self._config, self._match = submaps, config, match
        # As much as tells two hypotheses apart; the most that looks count, for a whole wing may be a copy.
        self._least, self._most = (share * gate(3, config.inlier_probability) for share in (0.5, 1.0))
        self._window = 2.0 * math.pi * (2.0 * window_m) ** 2
        self._claims: list[Claim] = []

    def follow(self, place: int, keyframe: int, pose: FloatArray) -> None:
        """Take a claim: the pose (3,) of a keyframe in the frame of a place, searched in a window."""
        nats, fits = self._judged(place, keyframe, pose)
        begun = found_motion(fits[0]).pose if fits else pose
        for onward in (1, -1):
            at, expected, said = place, begun, 0.0
            for key in range(
                keyframe + onward, keyframe + onward * (1 + self._config.half_keyframes), onward
            ):
                if not 0 <= key < len(self._submaps) or said < -self._least:
                    break
                step = between(self._submaps.pose(key - onward), self._submaps.pose(key))
                near = self._nearest(at, compose(expected, step), key)
                if near is None:
                    break
                at, expected = near
                told, fit = self._judged(at, key, expected)
                said, expected = said + told, found_motion(fit[0]).pose if fit else expected
                fits += fit
            nats += said
        if nats > 0.5 * self._least:
            sigma_m = self._match.coarse_cell_m / self._config.sigmas
            covariance = diagonal(sigma_m**2, sigma_m**2, (sigma_m / self._config.reach_m) ** 2)
            self._claims.append(Claim(place, keyframe, Motion(pose, covariance), nats, fits))

    def believed(self, untied: Sequence[int], poses: FloatArray, known: Known) -> list[LoopCandidate]:
        """Loops of the likeliest claims by an estimate, poses (n, 3); else of two that bear out each other.

        ``untied`` are the keyframes that no loop ties to an earlier place.
        """
        claims = [one for one in self._claims if one.keyframe in untied]
        odds = [self._looks(one) + self._expected(known(one.place, one.keyframe), one) for one in claims]
        at = [compose(poses[one.place], one.said.pose)[:2] for one in claims]
        chosen: list[Claim] = []
        for n in np.argsort(odds)[::-1].tolist():
            rivals = [
                odd
                for odd, one, where in zip(odds, claims, at, strict=True)
                if one.keyframe == claims[n].keyframe and math.dist(where, at[n]) > self._config.reach_m
            ]
            clear = odds[n] - max(rivals, default=-math.inf) > 0.5 * self._least
            if odds[n] > self._least and clear and all(self._apart(claims[n], one) for one in chosen):
                chosen.append(claims[n])
        if not chosen:
            strong = [(odd, one) for odd, one in zip(odds, claims, strict=True) if one.nats > self._least]
            best = self._most  # of so many pairs chance makes one likely
            for odd, one in strong:
                for other in (claim for _, claim in strong if self._apart(one, claim)):
                    onward = after(one.said, known(one.keyframe, other.keyframe))
                    borne = self._expected(after(known(other.place, one.place), onward), other)
                    if borne > 0.0 and odd + self._looks(other) + borne > best:
                        best, chosen = odd + self._looks(other) + borne, [one, other]
        chosen = chosen[: self._config.near]
        self._claims = [one for one in self._claims if all(one is not other for other in chosen)]
        return [fit for one in chosen for fit in one.fits]

    def _apart(self, one: Claim, other: Claim) -> bool:
        """Whether no scan speaks for both of two claims."""
        return abs(one.keyframe - other.keyframe) > 2 * self._config.half_keyframes

    def _looks(self, claim: Claim) -> float:
        return min(claim.nats, self._most)

    def _expected(self, way: Motion, claim: Claim) -> float:
        """By how many nats the way to a claim's keyframe makes it likelier than a pose anywhere in a window.

        The tails are heavy: steps may be grossly wrong.
        """
        if not np.isfinite(way.covariance).all():
            return 0.0
        way = way.widened(claim.said.covariance)
        tail = 3 * math.log1p(way.squared_mahalanobis(claim.said.pose) / 3)
        return math.log(self._window / math.sqrt((2.0 * math.pi) ** 3 * way.volume())) - tail

    def _nearest(self, place: int, pose: FloatArray, key: int) -> tuple[int, FloatArray] | None:
        """The place next to a pose (3,), of those near one on its way, and the pose from there."""
        submaps, nearest = self._submaps, None
        away_m = submaps.wide_m(self._config.reach_m, 2.0)
        for one in range(max(0, place - 3), min(len(submaps), place + 4)):
            seen = compose(between(submaps.pose(one), submaps.pose(place)), pose)
            far = abs(submaps.travelled_m(key) - submaps.travelled_m(one)) > submaps.least_path_m
            if far and math.hypot(seen[0], seen[1]) < away_m:
                away_m, nearest = math.hypot(seen[0], seen[1]), (one, seen)
        return nearest

    def _judged(self, place: int, key: int, pose: FloatArray) -> tuple[float, list[LoopCandidate]]:
        """What a scan matched about a pose (3,) says, in nats; and the loop that it is, if it fits.

        Of the points at a true place no more than a few contradict it, and few false ones fit so well: for
        that it is some four times likelier, as measured, and unlikelier the more of them do.
        """
        local_map, scan = self._submaps.surroundings(place), self._submaps.scan(key)
        config, match = self._config, self._match
        if min(len(scan), len(local_map.points)) < FEWEST:
            return 0.0, []
        few = config.sigmas * (1.0 - config.inlier_probability)
        found = local_map.align(scan, pose)
        contradicted = local_map.contradicted(scan, found.pose)
        if contradicted > few or found.inlier_share < config.least_overlap:
            # The step before may be off by more than an alignment mends.
            field = build_field(local_map.points.points, 2.0 * match.cell_m, match.coarse_cell_m)
            window = pose, config.every_m, match.search_half_yaw_rad / 4, match.search_least_score
            better = search_window(field, scan.thinned(match.search_points), *window)
            again = local_map.align(scan, better.pose)
            if better.found and again.inlier_share > found.inlier_share:
                found, contradicted = again, local_map.contradicted(scan, again.pose)
        if (found.inlier_share + contradicted) * len(scan) < FEWEST / 2:
            return 0.0, []
        nats = max(math.log(4) * (1.0 - contradicted / few), -2)
        if nats <= 0.0 or found.inlier_share < config.least_overlap or key < place:
            return nats, []
        motion = motion_from_alignment(found, match)
        motion = replace(motion, covariance=motion.covariance * config.caution)
        width_m, yaw_rad = config.every_m, match.search_half_yaw_rad
        return nats, [LoopCandidate(place, key, width_m, yaw_rad, found.inlier_share, motion, True, "")]
