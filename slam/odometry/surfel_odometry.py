"""Lidar odometry by point-to-line alignment to the surfels of the newest keyframes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from functools import cache, partial

import numpy as np

from slam.config import Config
from slam.estimates import MotionEstimate
from slam.matching.correlative import build_field, search_window
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.lone_object import confirmed
from slam.matching.match_covariance import motion_from_alignment, weak_direction
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.matching.point_to_line import Alignment
from slam.matching.scan_points import ScanPoints
from slam.matching.visibility import RangeImage
from slam.measurements import FloatArray

# Fewer oriented points than this determine no pose.
LEAST_POINTS = 10


class SurfelOdometry:
    """Coarse and fine point-to-line alignment; a correlative search if the guesses fail."""

    def __init__(self, config: Config) -> None:
        self._match, self._range_m = config.match, config.scan.range_max_m
        self._loops = config.loops
        self._path_m: deque[float] = deque(maxlen=config.match.local_map_keyframes)
        self._last = np.zeros(3)
        self._keyframes: deque[OrientedPoints] = deque(maxlen=config.match.local_map_keyframes)
        self._images: deque[Callable[[], RangeImage]] = deque(maxlen=config.match.local_map_keyframes)
        self._local_map: LocalMap | None = None

    def add_keyframe(self, points: ScanPoints, pose: FloatArray) -> None:
        """Add a scan at a pose (3,) of the odometry frame to the local map."""
        step, self._last = between(self._last, pose), pose
        way_m = math.hypot(step[0], step[1]) + (self._path_m[-1] if self._path_m else 0.0)
        # Keyframes farther back on the path are another visit: they are for loop closure.
        while self._path_m and way_m - self._path_m[0] > self._range_m:
            for remembered in (self._path_m, self._keyframes, self._images):
                remembered.popleft()
        self._path_m.append(way_m)
        self._keyframes.append(OrientedPoints.surface(points).moved(pose))
        self._images.append(cache(partial(RangeImage.of, points.points_base, pose, points.points_base)))
        self._local_map = None

    def match(
        self, points: ScanPoints, guesses: list[Motion], *, alone: bool = False
    ) -> MotionEstimate | None:
        """Align from the first guess; if that is uncertain, from the others and by search."""
        local_map = self._known()
        scan = OrientedPoints.from_scan(points)
        if local_map is None or len(scan) < LEAST_POINTS:
            return None
        best = local_map.align(scan, guesses[0].pose)
        for guess in guesses[1:]:
            if best.inlier_share >= self._match.confident_inlier_share:
                break
            best = _more_confident(best, local_map.align(scan, guess.pose))
        if best.inlier_share < self._match.confident_inlier_share:
            for guess in guesses:
                best = _more_confident(best, self._search(local_map, scan, guess.pose))
        weak = weak_direction(best, self._match.degenerate_share)
        if weak is not None and not guesses[0].holds(best.pose):
            # A guess other than the most certain one has converged along a corridor, where all looks alike.
            start = compose(best.pose, weak * (weak @ between(best.pose, guesses[0].pose)))
            best = local_map.align(scan, start)
        if alone:
            best = confirmed(local_map, scan, best, guesses[0].pose)
        share = best.inlier_share
        if share < self._match.least_inlier_share and not self._fits_what_is_known(local_map, scan, best):
            return None
        return motion_from_alignment(best, self._match)

    def match_near(self, points: ScanPoints, pose: FloatArray) -> MotionEstimate | None:
        """Align with a tight prior at ``pose`` (3,): the yaw is free, the position nearly fixed."""
        local_map = self._known()
        scan = OrientedPoints.from_scan(points)
        if local_map is None or len(scan) < LEAST_POINTS:
            return None
        return motion_from_alignment(local_map.align_held(scan, pose), self._match)

    def evidence(self, points: ScanPoints, pose: FloatArray, other: Motion) -> FloatArray:
        """Return (2, K) evidence of each object in a scan for a pose (3,) against another, in points."""
        local_map = self._known()
        if local_map is None:
            return np.zeros((2, 0))
        return local_map.evidence(OrientedPoints.from_scan(points), pose, other)

    def _fits_what_is_known(self, local_map: LocalMap, scan: OrientedPoints, best: Alignment) -> bool:
        """Return whether few points agree only because the robot sees an area that no scan has seen."""
        known = best.inlier_share + local_map.contradicted(scan, best.pose)
        least_share = max(self._match.confident_inlier_share, self._match.least_inlier_share)
        fits = best.inlier_share >= least_share * known
        # The farther apart keyframes are, the less of a scan can be known.
        spacing_m = (self._path_m[-1] - self._path_m[0]) / max(len(self._path_m) - 1, 1)
        share = self._loops.reach_m / max(spacing_m, self._loops.reach_m)
        return fits and known >= share * self._loops.least_overlap

    def _known(self) -> LocalMap | None:
        """Return the local map, built at first use; None before the first keyframe."""
        if self._local_map is None and self._keyframes:
            self._local_map = LocalMap.build(list(self._keyframes), self._match, list(self._images))
        return self._local_map

    def _search(self, local_map: LocalMap, scan: OrientedPoints, guess: FloatArray) -> Alignment | None:
        """Search around a guess by branch and bound, then align as usual."""
        if len(local_map.points) == 0:
            return None
        match = self._match
        result = search_window(
            build_field(local_map.points.points, 0.5 * match.cell_m, match.cell_m),
            scan.thinned(match.search_points),
            guess,
            match.search_half_width_m,
            match.search_half_yaw_rad,
            match.search_least_score,
        )
        return local_map.align(scan, result.pose) if result.found else None


def _more_confident(a: Alignment, b: Alignment | None) -> Alignment:
    """Return the alignment with more inliers."""
    return a if b is None or b.inlier_share <= a.inlier_share else b
