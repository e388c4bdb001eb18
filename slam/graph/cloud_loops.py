"""Loop closure by clouds: candidate places by distance or appearance, verified by registration."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from fusion.height_band import thin_evenly
from slam.config import Config
from slam.graph.loop_candidate import LoopCandidate, report
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.graph.unseen_gaps import UnseenGaps
from slam.heap import give_back
from slam.matching.local_cloud import REACH, Aligned, LocalCloud, moved
from slam.matching.scan_context import RINGS, dissimilarity, ring_key, scan_context
from slam.measurements import FloatArray, Pose, spatial
from slam.result_cache import COMPUTED, ResultCache
from slam.spool import Spool

# Number of places with similar ring keys whose full descriptors are compared.
_SIMILAR_RINGS = 10


@dataclass(frozen=True, slots=True)
class _Guess:
    """A candidate place: expected pose, its sigma, and whether it was proposed by appearance."""

    place: int
    T_place_base: gtsam.Pose3
    sigma_m: float
    score: float
    by_appearance: bool


class CloudLoopCloser:
    """Proposes and verifies loops for the newest keyframe.

    Parameters
    ----------
    voxel_m
        Side of a voxel; settings in voxels scale with the scene.
    clouds
        Returns the points (N, 3) of a keyframe, base frame.
    """

    def __init__(
        self,
        config: Config,
        voxel_m: float,
        clouds: Callable[[int], FloatArray],
        result_cache: ResultCache = COMPUTED,
    ) -> None:
        self._config, self._voxel_m = config, voxel_m
        self._loops, self._reach_m = config.loops, config.cloud_loops.reach_voxels * voxel_m
        self._clouds, self._result_cache = clouds, result_cache
        self._contexts = Spool()
        self._rings: list[FloatArray] = []
        self._poses: list[gtsam.Pose3] = []
        self._travelled_m: list[float] = []
        self._residuals_m: list[float] = []
        self._last_attempt_m, self._last_loop_m = -math.inf, 0.0
        # One street may look like another over some distance.
        self._gaps = UnseenGaps(config.cloud_loops.least_path_voxels * voxel_m)
        self._cache: OrderedDict[int, LocalCloud] = OrderedDict()

    def add_keyframe(
        self, points: FloatArray, pose: gtsam.Pose3, residual_m: float = math.nan, *, unseen: bool = False
    ) -> None:
        """Store the next keyframe.

        Parameters
        ----------
        points
            (N, 3), base frame.
        pose
            ``T_odom_base``.
        residual_m
            Of its match; NaN where there was none.
        unseen
            Whether nothing measured the motion to it.
        """
        if unseen:
            self._gaps.begin(len(self._poses))
        context = scan_context(points, self._voxel_m)
        self._contexts.append(context.tobytes())
        self._rings.append(ring_key(context))
        before, path_m = (self._poses[-1], self._travelled_m[-1]) if self._poses else (pose, 0.0)
        self._travelled_m.append(path_m + float(np.linalg.norm(before.between(pose).translation())))
        self._poses.append(pose)
        if np.isfinite(residual_m):
            self._residuals_m.append(residual_m)

    def close(
        self, key: int, poses: Sequence[Pose], rows: FloatArray, uncertainty: UncertaintyGraph
    ) -> list[LoopCandidate]:
        """Try to close loops with places to which a keyframe may have returned.

        Parameters
        ----------
        key
            The newest keyframe.
        poses
            Current estimates of all keyframes, ``T_map_base``.
        rows
            (n, 3) the same, projected onto the plane.
        uncertainty
            Gives the relative covariance between the keyframe and the places.

        Returns
        -------
        Every candidate that was tried, accepted or rejected; one across an unobserved gap is withheld until
        others agree.
        """
        path_m = self._travelled_m[key]
        if not self._loops.enabled or path_m - self._last_attempt_m < self._reach_m:
            return []
        self._last_attempt_m = path_m
        tried: list[LoopCandidate] = []
        for guess in [*self._entailed(key), *self._propose(key, poses, rows, uncertainty)]:
            if tried and tried[-1].accepted:
                break  # the pose of the robot is known
            tried.append(self._verify(key, guess))
        taken = self._gaps.believed(tried, rows, self._travelled_m, uncertainty)
        if any(candidate.accepted for candidate in taken):
            self._last_loop_m = path_m
        return taken

    def alone(self) -> list[LoopCandidate]:
        """Return the candidates withheld to the end, as rejected."""
        return self._gaps.alone()

    def verify(self, place: int, key: int, T_place_base: gtsam.Pose3 | None, sigma_m: float) -> LoopCandidate:
        """Register a keyframe to a place.

        Parameters
        ----------
        T_place_base
            Expected pose; None for a pose near the place with the yaw at which it looks the same.
        sigma_m
            Of that.
        """
        if T_place_base is not None:
            return self._verify(key, _Guess(place, T_place_base, sigma_m, 1.0, False))
        distance, yaw = self._unlike(place, key)
        turned = gtsam.Pose3(gtsam.Rot3.Yaw(yaw), np.zeros(3))
        return self._verify(key, _Guess(place, turned, sigma_m, 1.0 - distance, True))

    def _propose(
        self, key: int, poses: Sequence[Pose], rows: FloatArray, uncertainty: UncertaintyGraph
    ) -> list[_Guess]:
        """Return places within the uncertainty: the nearest of each pass, then those that look the same."""
        loops, config = self._loops, self._config.cloud_loops
        travelled = np.array(self._travelled_m[: key + 1])
        places = np.flatnonzero(travelled[key] - travelled[:key] > config.least_path_voxels * self._voxel_m)
        if not places.size:
            return []
        distances = np.hypot(*(rows[places, :2] - rows[key, :2]).T)
        covariances = uncertainty.relative_covariances(key, places, rows)
        sigmas = np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1], 0.0))
        sigmas += config.drift_share * (travelled[key] - self._last_loop_m)
        reach_m = self._reach_m
        possible = distances <= reach_m + loops.sigmas * sigmas
        if not possible.any():
            return []
        places, distances, sigmas = places[possible], distances[possible], sigmas[possible]
        chosen: list[_Guess] = []

        def apart(place: int) -> bool:
            """Two places on one pass give the same information."""
            return all(abs(travelled[place] - travelled[other.place]) > reach_m for other in chosen)

        for n in np.argsort(distances, kind="stable"):
            place = int(places[n])
            if len(chosen) < loops.near and apart(place):
                T_place_base = spatial(poses[place]).between(spatial(poses[key]))
                chosen.append(_Guess(place, T_place_base, float(sigmas[n]), 1.0, False))
        rings = np.array([self._rings[place] for place in places])
        likeness = np.linalg.norm(rings - self._rings[key], axis=1)
        for n in np.argsort(likeness, kind="stable")[:_SIMILAR_RINGS]:
            place = int(places[n])
            if len(chosen) >= loops.near + loops.by_appearance or not apart(place):
                continue
            distance, yaw = self._unlike(place, key)
            if distance <= config.greatest_dissimilarity:
                turned = gtsam.Pose3(gtsam.Rot3.Yaw(yaw), np.zeros(3))
                chosen.append(_Guess(place, turned, float(sigmas[n]) + reach_m, 1.0 - distance, True))
        return chosen

    def _unlike(self, place: int, key: int) -> tuple[float, float]:
        """Return the `dissimilarity` of the descriptors of two keyframes."""
        one, other = (np.frombuffer(self._contexts[k], np.float32).reshape(RINGS, -1) for k in (place, key))
        return dissimilarity(one, other)

    def _entailed(self, key: int) -> list[_Guess]:
        """Return the pose of the newest keyframe at the nearest place, if the waiting loops are true."""
        loop = self._gaps.likeliest(key)
        if loop is None or loop.motion is None:
            return []
        T_place_base = spatial(loop.motion.T_reference_base).compose(
            self._poses[loop.keyframe].between(self._poses[key])
        )
        places = self._gaps.stretch_of(loop.place)
        poses_seen = [
            self._poses[place].between(self._poses[loop.place]).compose(T_place_base) for place in places
        ]
        nearest = int(np.argmin([np.linalg.norm(pose.translation()) for pose in poses_seen]))
        sigma_m = self._config.cloud_loops.drift_share * (
            self._travelled_m[key] - self._travelled_m[loop.keyframe]
        )
        return [_Guess(places[nearest], poses_seen[nearest], sigma_m, 1.0, False)]

    def _verify(self, key: int, guess: _Guess) -> LoopCandidate:
        """Register the keyframe to the place, and accept or reject the result."""
        # Always requested: the content of the cache must not depend on the source of the result.
        local = self._place(guess.place)
        candidate = self._result_cache.cached(
            "cloud loop", float(guess.T_place_base.x()), lambda: self._match(key, guess, local)
        )
        report("cloud loop", candidate)
        return candidate

    def _match(self, key: int, guess: _Guess, local: LocalCloud) -> LoopCandidate:
        """Register, and accept or reject the result."""
        width_m = self._loops.sigmas * guess.sigma_m + 2.0 * self._voxel_m
        candidate = LoopCandidate(guess.place, key, width_m, 0.0, guess.score, None, False, "")
        scan = thin_evenly(self._clouds(key), self._voxel_m)
        is_near = not guess.by_appearance and width_m <= REACH * self._voxel_m
        reach_m = None if is_near else max(width_m, REACH * self._voxel_m)
        aligned = local.align(scan, guess.T_place_base, reach_m)
        if aligned is None:
            return candidate.refused("too little fits")
        # A second registration refines the result of the wide kernel.
        refined = None if is_near else local.align(scan, aligned.found.pose)
        return self._judge(candidate, guess, aligned if refined is None else refined)

    def _judge(self, candidate: LoopCandidate, guess: _Guess, aligned: Aligned) -> LoopCandidate:
        """Accept or reject a registration."""
        loops, motion = self._loops, aligned.motion
        motion = replace(motion, covariance=motion.covariance * loops.caution)
        candidate = replace(candidate, motion=motion)
        usual_m = float(np.median(self._residuals_m)) if self._residuals_m else math.inf
        usual_m = max(usual_m, self._config.match.minimal_residual_m)
        moved_m = float(np.linalg.norm(guess.T_place_base.between(aligned.found.pose).translation()))
        if aligned.found.overlap < loops.least_overlap:
            return candidate.refused("too little overlap")
        if motion.inlier_share < loops.least_inlier_share:
            return candidate.refused("too few points fit")
        if motion.residual_m > self._config.cloud_loops.greatest_residual_ratio * usual_m:
            return candidate.refused("residual too large")
        if moved_m > candidate.half_width_m:
            return candidate.refused("refinement left the window")
        if motion.degenerate:
            return candidate.refused("a direction is not determined")
        return replace(candidate, accepted=True)

    def _place(self, key: int) -> LocalCloud:
        """Return the surroundings of a keyframe in its base frame, aligned by the odometry."""
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        half = self._loops.half_keyframes
        members = range(max(0, key - half), min(len(self._poses), key + half + 1))
        thin_m = 0.5 * self._voxel_m
        parts = [
            moved(thin_evenly(self._clouds(k), thin_m), self._poses[key].between(self._poses[k]))
            for k in members
        ]
        local = LocalCloud.of(np.vstack(parts), self._voxel_m, self._config)
        local.planes.settle()
        self._cache[key] = local
        if len(self._cache) > half:
            self._cache.popitem(last=False)
            give_back()
        return local
