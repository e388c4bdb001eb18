"""A scan against the known map: aligned to its walls, and its beams weighed."""

from __future__ import annotations

import math

from slam.config import Config
from slam.localization.beam_check import BeamCounts, check_beams, in_clear_space
from slam.localization.evidence import is_correction
from slam.localization.known_map import Walls
from slam.localization.scan_view import ScanView
from slam.matching.local_map import OrientedPoints, match_noise
from slam.matching.match_covariance import motion_from_alignment
from slam.matching.planar import between
from slam.measurements import FloatArray, MotionEstimate, row_from_pose2

_LEAST_POINTS = 10
_LEAST_KEPT = 0.4
# Shares of explained, crossing and in-free beams at the true pose, and at the best of all wrong poses. A
# silent beam says nothing: where the map is incomplete, true poses have as many of them as wrong ones.
_EXPLAINED_NATS = math.log(0.93 / 0.57)
_CROSSING_NATS = math.log(0.02 / 0.17)
_IN_FREE_NATS = math.log(0.02 / 0.12)


class MapMatcher:
    """Matches scans to the walls of a map; stateless but for the tiles that it keeps."""

    def __init__(self, walls: Walls, config: Config) -> None:
        self._walls = walls
        self._noise = match_noise(config.match)
        self._settings = config.localization

    def align(self, view: ScanView, guess: FloatArray) -> MotionEstimate | None:
        """Pose of a scan's base in the map, from a guess (3,) nearby; None where nothing can match."""
        tile = self._walls.tiles.around(guess)
        if len(view.oriented) < _LEAST_POINTS or len(tile.fine.surfels) < _LEAST_POINTS:
            return None
        motion = motion_from_alignment(tile.align(view.oriented, guess), self._noise)
        return motion if motion.inlier_share > 0.0 else None

    def correct(self, view: ScanView, expected: FloatArray) -> MotionEstimate | None:
        """An alignment that corrects an expected pose (3,); None where too little of the scan agrees."""
        motion = self.align(view, expected)
        if motion is None or motion.inlier_share < self._settings.least_inlier_share:
            return None
        moved = between(expected, row_from_pose2(motion.T_reference_base))
        return motion if is_correction(math.hypot(moved[0], moved[1]), abs(float(moved[2]))) else None

    def without_strangers(self, view: ScanView, pose: FloatArray) -> ScanView:
        """A scan without what stands in the midst of known free space, seen from near a pose (3,): people.

        A scan that would lose much of itself is left whole: rather the pose is wrong.
        """
        keep = ~in_clear_space(self._walls.space, pose, view.points.points_base)
        return view.only(keep) if not keep.all() and keep.mean() >= _LEAST_KEPT else view

    def weigh(self, pose: FloatArray, laser: FloatArray, points: OrientedPoints) -> float:
        """Evidence for a pose (3,) over the best of the wrong ones, nats.

        Parameters
        ----------
        laser
            (2,) where the beams begin, base frame.
        points
            Where they end, one a cell of a surface.
        """
        surfels = self._walls.tiles.around(pose).fine
        counts = check_beams(self._walls.space, surfels, pose, laser, points)
        return evidence_of(counts) / self._settings.correlated_cells


def evidence_of(counts: BeamCounts) -> float:
    """Log-likelihood ratio of independent beams, nats."""
    return (
        _EXPLAINED_NATS * counts.explained + _CROSSING_NATS * counts.crossing + _IN_FREE_NATS * counts.in_free
    )
