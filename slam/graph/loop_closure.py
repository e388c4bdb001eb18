"""Loop closure: search known places within the uncertainty of the pose, and say why a loop is rejected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from slam.config import Config
from slam.config.stages import LoopConfig, MatchConfig
from slam.estimates import MotionEstimate
from slam.graph.loop_candidate import LoopCandidate, found_motion, report
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.graph.submaps import Submap, SubmapStore
from slam.matching.correlative import search_window
from slam.matching.local_map import OrientedPoints
from slam.matching.match_covariance import motion_from_alignment
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.matching.scan_points import ScanPoints, extract_points
from slam.measurements import FloatArray, LaserScan, row_from_pose2
from slam.result_cache import COMPUTED, ResultCache


class LoopCloser:
    """Proposes and verifies loops for the newest keyframe."""

    def __init__(self, config: LoopConfig, match: MatchConfig, result_cache: ResultCache = COMPUTED) -> None:
        self._config, self._match = config, match
        self._result_cache = result_cache
        self.submaps = SubmapStore(config, match)
        self._closed_again: set[tuple[int, int]] = set()
        self._last_attempt_m = -math.inf

    def close(self, key: int, poses: FloatArray, uncertainty: UncertaintyGraph) -> list[LoopCandidate]:
        """Try to close loops with places to which the newest keyframe may have returned.

        Parameters
        ----------
        key
            The newest keyframe.
        poses
            (key + 1, 3) current estimates of all keyframes, map frame.
        uncertainty
            Gives the relative covariance between the keyframe and the places.

        Returns
        -------
        Every candidate that was tried, accepted or rejected.
        """
        travelled = self.submaps.travelled_m(key)
        if not self._config.enabled or travelled - self._last_attempt_m < self._config.every_m:
            return []
        self._last_attempt_m = travelled
        if len(self.submaps.scan(key)) < FEWEST:
            return []
        tried = []
        for place, covariance in self.propose(key, poses, uncertainty):
            guess = between(poses[place], poses[key])
            tried.append(self.verify(place, key, guess, covariance))
        return tried

    def close_again(
        self, poses: FloatArray, uncertainty: UncertaintyGraph, loops: Sequence[LoopCandidate]
    ) -> list[LoopCandidate]:
        """Try again where no loop was found during mapping, from a better estimate; return accepted ones.

        Parameters
        ----------
        poses, uncertainty
            Poses and uncertainty of all keyframes, as for `close`.
        """
        travelled_m = self.submaps.travelled_m
        closed = np.sort([travelled_m(loop.keyframe) for loop in loops if loop.accepted])
        closed = np.concatenate([[-np.inf], closed, [np.inf]])
        found, last_m = list[LoopCandidate](), -math.inf
        for key in range(len(poses)):
            at_m = travelled_m(key)
            after = int(np.searchsorted(closed, at_m))
            apart_m = min(at_m - closed[after - 1], closed[after] - at_m, at_m - last_m)
            if apart_m < self._config.every_m or len(self.submaps.scan(key)) < FEWEST:
                continue
            last_m = at_m
            for place, covariance in self.propose(key, poses, uncertainty):
                # Loops found by this search before, and rejected by GNC since, are not tried again.
                if (place, key) not in self._closed_again:
                    guess = between(poses[place], poses[key])
                    candidate = self.verify(place, key, guess, covariance)
                    # A window is as wide as the least certain direction: it may contain look-alikes.
                    if candidate.accepted and Motion(guess, covariance).agrees(found_motion(candidate)):
                        self._closed_again.add((place, key))
                        found.append(candidate)
        return found

    def verify(
        self,
        place: int,
        key: int,
        guess: FloatArray,
        covariance: FloatArray,
        *,
        confirming: bool = False,
    ) -> LoopCandidate:
        """Match a keyframe to a place in a window given by the uncertainty of the guess.

        Parameters
        ----------
        guess
            (3,) expected pose of the keyframe in the frame of the place.
        covariance
            (3, 3) covariance of the guess.
        confirming
            Whether a match that leaves a direction undetermined is accepted in a wide window, too.
        """
        config = self._config
        sigma_m = float(position_sigmas(covariance[None])[0])
        width = min(config.sigmas * sigma_m, config.reach_m)
        yaw = min(config.sigmas * math.sqrt(float(covariance[2, 2])), math.pi)
        begun = LoopCandidate(place, key, width, yaw, 1.0, None, False, "")
        # Always requested: the content of the cache must not depend on the source of the result.
        submap = self.submaps.submap(place)
        scan = self.submaps.scan(key)
        candidate = self._result_cache.cached(
            "loop",
            float(guess[0]),
            lambda: search_place(begun, submap, scan, guess, self._config, self._match, confirming),
        )
        report("loop", candidate)
        return candidate

    def propose(
        self, key: int, poses: FloatArray, uncertainty: UncertaintyGraph, *, wide: bool = False
    ) -> list[tuple[int, FloatArray]]:
        """Return places that may see the same as the keyframe, nearest first, with the covariance.

        With ``wide``, also places whose distance is only known to within that at which a place is visible.
        """
        config, submaps = self._config, self.submaps
        most_m = config.sigmas * config.reach_m if wide else config.reach_m
        travelled, least_path_m = submaps.travelled_m(key), submaps.least_path_m
        places = submaps.places(key)
        distance = np.hypot(*(poses[places, :2] - poses[key, :2]).T)
        reach_m = submaps.wide_m(config.reach_m, 1.0)
        able = distance <= reach_m + config.reach_m
        able &= travelled - submaps.ways_m()[places] > least_path_m
        places, distance = places[able], distance[able]
        order = np.argsort(distance)
        chosen: list[tuple[int, FloatArray]] = []
        # At a place seen many times, the nearest of all passes suffice: the others are tried rarely.
        for part in (order[: FEWEST * config.near], order[FEWEST * config.near :]):
            if not len(part) or len(chosen) == config.near:
                break
            covariances = uncertainty.relative_covariances(key, places[part], poses)
            # In a wider window, several places may look the same: the search over the map handles these.
            slacks = config.sigmas * position_sigmas(covariances)
            for n, covariance, slack_m in zip(part, covariances, slacks, strict=True):
                if len(chosen) == config.near:
                    break
                if slack_m > most_m or distance[n] > reach_m + slack_m:
                    continue
                at_m = submaps.travelled_m(places[n])
                # Two places on one pass give the same information: take the nearest of each pass.
                if all(abs(at_m - submaps.travelled_m(p)) > config.least_path_m for p, _ in chosen):
                    chosen.append((int(places[n]), covariance))
        return chosen


def closer_of(
    scans: Sequence[LaserScan | None],
    poses: FloatArray,
    path_m: FloatArray,
    sessions: NDArray[np.int64],
    config: Config,
) -> LoopCloser:
    """Create a loop closer with all keyframes of a finished map.

    Parameters
    ----------
    poses
        (K, 3) poses in the map: within a few metres as accurate as odometry.
    path_m, sessions
        (K,) path length to each keyframe in its session, and the number of the session.
    """
    closer, settings = LoopCloser(config.loops, config.match), config.scan
    begun = (np.diff(sessions, prepend=sessions[:1]) != 0).tolist()
    for scan, pose, travelled_m, begins in zip(scans, poses, path_m, begun, strict=True):
        points = ScanPoints.none()
        if scan is not None:
            limits = settings.range_min_m, settings.range_max_m
            points = extract_points(scan, *limits, settings.neighbours)
        seen, surface = (make(points) for make in (OrientedPoints.from_scan, OrientedPoints.surface))
        closer.submaps.add(seen, pose, travelled_m, surface, begun=begins)
    return closer


def search_place(
    candidate: LoopCandidate,
    submap: Submap,
    scan: OrientedPoints,
    guess: FloatArray,
    config: LoopConfig,
    match: MatchConfig,
    confirming: bool = False,
) -> LoopCandidate:
    """Search the window of a candidate around a guess, refine the result, and verify it.

    Parameters
    ----------
    candidate
        Candidate with the window.
    scan
        Scan that may have been taken there, base frame.
    guess
        (3,) expected pose of the base in the frame of the place.
    """
    width, yaw = candidate.half_width_m, candidate.half_yaw_rad
    if len(submap.local_map.points) < FEWEST:
        return candidate.refused("the place has too few points")
    if len(scan) < FEWEST:
        return candidate.refused("the scan has too few points")
    basin_m = match.coarse_cell_m
    if width > basin_m or yaw * config.reach_m > basin_m:
        found = search_window(
            submap.field, scan.thinned(match.search_points), guess, width, yaw, match.search_least_score
        )
        candidate = replace(candidate, score=found.score)
        if not found.found:
            return candidate.refused("no pose in the window scores high enough")
        guess = found.pose
    motion = motion_from_alignment(submap.local_map.align(scan, guess), match)
    motion = replace(motion, covariance=motion.covariance * config.caution)
    return _judge(replace(candidate, motion=motion), motion, guess, config, basin_m, confirming)


def _judge(
    candidate: LoopCandidate,
    motion: MotionEstimate,
    guess: FloatArray,
    config: LoopConfig,
    basin_m: float,
    confirming: bool,
) -> LoopCandidate:
    """Accept or reject a refined match."""
    moved = between(guess, row_from_pose2(motion.T_reference_base))
    moved_m = math.hypot(moved[0], moved[1])
    if motion.inlier_share < config.least_inlier_share:
        return candidate.refused("too few points fit")
    if moved_m > basin_m:
        return candidate.refused("refinement left the window")
    if motion.degenerate and not confirming and candidate.half_width_m >= 0.5 * config.reach_m:
        # Corridors look alike: a corridor may confirm a nearly known place, but not find one.
        return candidate.refused("one direction undetermined, and the place too uncertain")
    return replace(candidate, accepted=True)


def position_sigmas(covariances: FloatArray) -> FloatArray:
    """Return the largest position sigma, (m,) for (m, 3, 3); infinite without a path."""
    xx, yy, xy = covariances[:, 0, 0], covariances[:, 1, 1], covariances[:, 0, 1]
    known = np.isfinite(covariances).all(axis=(1, 2))
    with np.errstate(invalid="ignore"):
        return np.where(known, np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)), np.inf)
