"""Odometry of a 3D lidar: each cloud is matched to the clouds of the newest keyframes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from fusion.height_band import thin_evenly
from slam.config import Config
from slam.estimates import MotionEstimate
from slam.matching.cloud_alignment import levers
from slam.matching.local_cloud import REACH, Aligned, LocalCloud, moved
from slam.matching.plane_voxels import SIZES, PlaneVoxels
from slam.measurements import FloatArray

# Share of points on planes that counts as nearly equal; below this share of the expected one, no match.
_NEARLY, _HARDLY = 0.85, 0.4
# How many points of a keyframe lie on the planes of those before it, as a share of those on its own too: by
# so many keyframes, and at least this share.
_KNOWN_KEYFRAMES, _LEAST_KNOWN = 10, 0.7


class CloudOdometry:
    """Matches scans against the newest keyframes.

    Attributes
    ----------
    settles
        Whether the newest match had an undetermined direction and converged along it.
    """

    def __init__(self, config: Config, voxel_m: float) -> None:
        self._config, self._voxel_m = config, voxel_m
        self._expected, self.settles = 0.0, False
        # On a street with few walls, nearly all open matches converge so; in a tunnel, some by chance.
        self._settled = deque([True] * (FEWEST // 2), maxlen=FEWEST // 2)
        self.restart()

    def restart(self) -> None:
        """Discard the local map."""
        self._newest: deque[FloatArray] = deque()  # clouds in the planes of the map
        self._known: deque[float] = deque(maxlen=_KNOWN_KEYFRAMES)
        self._ahead = 0  # clouds of the map that the robot has yet to reach
        turns = self._config.cloud_odometry
        # A ray within a plane's thickness across the largest voxel is parallel to it.
        least_sine = turns.thickness_m / (SIZES[0] * turns.greatest_voxel_m)
        planes = PlaneVoxels(self._voxel_m, turns.thickness_m, least_sine, rough=1)
        self._map = LocalCloud(planes, self._voxel_m, self._config)

    def begin(self, keyframes: Sequence[tuple[FloatArray, FloatArray]]) -> None:
        """Start with clouds (N, 3) of the first seconds and their lidar (3,), odometry frame."""
        for points, lidar in keyframes:
            self.add_keyframe(points, gtsam.Pose3(), lidar)
        self._ahead = len(self._newest)

    def add_keyframe(self, points: FloatArray, pose: gtsam.Pose3, lidar_base: FloatArray) -> None:
        """Add points (N, 3), seen from (3,), both base frame, at ``T_odom_base`` to the local map."""
        if not len(points):
            return
        half = thin_evenly(points, 0.5 * self._voxel_m)
        scan = thin_evenly(half, self._voxel_m)
        before = self._map.agreement(scan, pose)
        self._newest.append(moved(half, pose))
        old = self._newest.popleft() if len(self._newest) > self._config.match.local_map_keyframes else None
        self._ahead -= old is not None and self._ahead > 0
        self._map.planes.add(self._newest[-1], old, pose.transformFrom(lidar_base))
        own = self._map.agreement(scan, pose)
        # A map of the same place from ahead knows more than keyframes usually do.
        if before > 0.0 and own > 0.0 and not self._ahead:
            self._known.append(before / own)
        self._expected = own * max(float(np.median(self._known or [0.0])), _LEAST_KNOWN)

    def thinned(self, points: FloatArray) -> FloatArray:
        """Return one point (M, 3) of a cloud (N, 3) in each voxel: a scan to be matched."""
        return thin_evenly(points, self._voxel_m)

    def match(
        self,
        scan: FloatArray,
        guesses: Sequence[gtsam.Pose3],
        before: gtsam.Pose3 | None = None,
        turned_rad: float = 0.0,
    ) -> MotionEstimate | None:
        """Return the pose of a thinned scan (N, 3), base frame, in the odometry frame; None if nothing fits.

        Parameters
        ----------
        guesses
            By measured motion. Tried in this order until a match settles near one, with nearly as many points
            on planes as the newest keyframes had. Where none does, the match with most of them is taken: from
            wheels that slip, or a robot that was pushed, a match arrives at what fits in part.
        before
            Where the robot was, as the last guess. Nobody has measured the motion since, and along a street
            where it was fits well: places all around are tried too.
        turned_rad
            How far it may have turned since, about any axis; turns are tried as far as that.

        Returns
        -------
        Not converged, and uncertain by a voxel, where fewer points than usual lie on planes.
        """
        fits: list[Aligned | None] = []
        for guess in guesses:
            aligned = self._map.align(scan, guess, None, self._usual)
            if aligned is not None and aligned.near:
                fits = [aligned]
                break
            fits.append(aligned)
        best = self._best(fits)
        if before is not None and (best is None or best.found.agreement < self._usual):
            fits.append(self._map.align(scan, before, REACH * self._voxel_m))
            fits.append(self._map.align(scan, self._map.best_of(scan, self._around(before, turned_rad))))
            best = self._best(fits)
        if best is None:
            return None
        rivals = [one.found for one in fits if one and one.found.agreement >= _NEARLY * best.found.agreement]
        poses = [*(one.pose for one in rivals), self._by_last(scan, best)]
        settled = self._map.settled(scan, best)
        self.settles = settled is not best
        by_most = 2 * (sum(self._settled) + self.settles) > 1 + len(self._settled)
        return self._motion(settled if by_most else best, poses, guesses, turned_rad)

    def note_open(self, *, settles: bool) -> None:
        """Record whether an open match converged; such matches are used if most do."""
        self._settled.append(settles)

    def nearby(self, scan: FloatArray, start: gtsam.Pose3) -> gtsam.Pose3:
        """Return roughly where a thinned scan (N, 3) fits near ``T_odom_base``."""
        return self._map.best_of(scan, [start])

    def agreement(self, scan: FloatArray, pose: gtsam.Pose3) -> float:
        """Return the share of a thinned scan (N, 3), base frame, on planes at ``T_odom_base``."""
        return self._map.agreement(scan, pose)

    @property
    def _usual(self) -> float:
        """Return the lower limit of the usual share of points on planes."""
        return _NEARLY * self._expected

    def _around(self, pose: gtsam.Pose3, turned_rad: float) -> list[gtsam.Pose3]:
        """Return poses ahead, behind and beside a pose, with rotations about the axes of a cube."""
        paths_m = self._voxel_m * np.arange(1.0, REACH + 1.0)
        shifts = [
            [0, 0, 0, x, y, 0] for path in paths_m for x, y in ((path, 0), (-path, 0), (0, path), (0, -path))
        ]
        turn_rad = 2.0 * self._config.keyframes.angle_rad  # the range of a match, in both directions
        turns_rad = np.arange(turn_rad, min(turned_rad, 0.5 * np.pi), turn_rad)
        axes = [np.array(axis) / np.linalg.norm(axis) for axis in product((-1, 0, 1), repeat=3) if any(axis)]
        turns = [[*(turn * axis), 0, 0, 0] for turn in turns_rad for axis in axes]
        return [pose, *(pose.compose(gtsam.Pose3.Expmap(np.array(step))) for step in shifts + turns)]

    def _best(self, fits: Sequence[Aligned | None]) -> Aligned | None:
        """Return the match with most points on planes; None if none fits."""
        least = self._config.match.least_inlier_share
        fitting = [item for item in fits if item is not None and item.motion.inlier_share >= least]
        best = max(fitting, key=lambda item: item.found.agreement, default=None)
        return None if best is None or best.found.agreement < _HARDLY * self._expected else best

    def _by_last(self, scan: FloatArray, best: Aligned) -> gtsam.Pose3:
        """Match to the last cloud alone, from a match that converged far from its guess.

        At a wrong place where all clouds together fit as usual, it converges elsewhere.
        """
        if best.near:
            return best.found.pose
        last = LocalCloud.of(self._newest[-1], self._voxel_m, self._config)
        aligned = last.refine(scan, best.found.pose)
        return best.found.pose if aligned is None else aligned.found.pose

    def _motion(
        self, best: Aligned, rivals: list[gtsam.Pose3], guesses: Sequence[gtsam.Pose3], turned_rad: float
    ) -> MotionEstimate:
        """Return the motion of the best match, with a covariance that covers its rivals.

        With fewer points on planes than usual, it also covers the guess; without a guess, the search range.
        """
        doubt, unusual = np.zeros((6, 6)), best.found.agreement < self._usual
        for rival in rivals + list(guesses[:1] if unusual else []):
            offset = gtsam.Pose3.Logmap(best.found.pose.between(rival))
            doubt += np.outer(offset, offset)
        if unusual:
            turns = np.linalg.inv(levers(best.found.arms_m))
            doubt += self._voxel_m**2 * turns @ turns
            doubt[:3, :3] += 0.0 if guesses else turned_rad**2 * np.eye(3)
        motion = replace(best.motion, covariance=best.motion.covariance + doubt)
        return replace(motion, converged=False) if unusual else motion
