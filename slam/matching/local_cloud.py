"""Map of clouds to match to: planes from a near guess; otherwise the centres of large voxels come first.

Indoors, the rings on floor and ceiling move with the lidar. As points they make every motion too short; as
planes they determine only height and tilt. So a point-to-plane alignment is always the last step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from fusion.height_band import to_frame
from slam.config import Config
from slam.estimates import MotionEstimate
from slam.matching.cloud_alignment import (
    CloudAlignment,
    align_cloud,
    drawn_near,
    levers,
    motion_of,
    place_cloud,
    share_on_planes,
)
from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import FloatArray

# In voxels: largest error of a pose for the search with a wide reach.
REACH = 5.0
# Number of points of the coarse search; the next step uses all.
_ARRIVING_POINTS = 1500
# Points unrelated to the planes are uniform within the kernel; so many voxels RMS are nearly that.
_CHANCE = 0.45


@dataclass(frozen=True, slots=True)
class Aligned:
    """An alignment and its motion.

    Attributes
    ----------
    near
        Whether it converged as expected, and nearly all points agree: no other guess is needed.
    """

    found: CloudAlignment
    motion: MotionEstimate
    near: bool


class LocalCloud:
    """Map for matching."""

    def __init__(self, planes: PlaneVoxels, voxel_m: float, config: Config) -> None:
        self.planes = planes
        self._config, self._voxel_m = config, voxel_m

    @classmethod
    def of(cls, points: FloatArray, voxel_m: float, config: Config) -> LocalCloud:
        """Create the map of a cloud (N, 3), with rough planes."""
        return cls(PlaneVoxels.build(points, voxel_m, config.cloud_odometry.thickness_m, 1), voxel_m, config)

    def align(
        self, scan: FloatArray, guess: gtsam.Pose3, reach_m: float | None = None, least_agreement: float = 0.0
    ) -> Aligned | None:
        """Align a thinned scan (N, 3), base frame; None if too little is known.

        Parameters
        ----------
        guess
            ``T_map_base``.
        reach_m
            Largest error of the guess; None if it is expected to be correct within a voxel.
        least_agreement
            Share of points on planes at which planes alone are trusted.
        """
        if len(scan) < FEWEST or not len(self.planes):
            return None
        match = self._by_planes(scan, guess) if reach_m is None else None
        is_near = match is not None and self._is_near(match, guess) and match.agreement >= least_agreement
        if not is_near:
            part, tries = _part(scan, _ARRIVING_POINTS), 2 * self._config.match.iterations
            reach_m = REACH * self._voxel_m if reach_m is None else reach_m
            start = drawn_near(part, self.planes, guess, tries, reach_m)
            match = self._by_planes(scan, start if np.isfinite(start.matrix()).all() else guess)
        return self._aligned(match, guess, is_near=is_near)

    def refine(self, scan: FloatArray, guess: gtsam.Pose3) -> Aligned | None:
        """Align from a guess that is correct within a voxel, by the planes alone."""
        match = self._by_planes(scan, guess) if len(scan) >= FEWEST and len(self.planes) else None
        return self._aligned(match, guess, is_near=match is not None and self._is_near(match, guess))

    def _aligned(self, match: CloudAlignment | None, guess: gtsam.Pose3, *, is_near: bool) -> Aligned | None:
        """Return an alignment if enough points fit better than by chance."""
        if match is None or match.pair_count < self._config.cloud_odometry.least_pairs:
            return None
        if not match.residual_m < _CHANCE * self._voxel_m:
            return None
        return Aligned(match, motion_of(match, self._config, guess), is_near)

    def settled(self, scan: FloatArray, aligned: Aligned) -> Aligned:
        """Return a match of a scan (N, 3) with an undetermined direction where it converges along it, if so.

        On a street with few walls, it converges from a voxel to either side; in a tunnel it stays at its
        start. Its covariance stays the same.
        """
        if not aligned.motion.degenerate:
            return aligned
        pose, lever, dof = aligned.found.pose, levers(aligned.found.arms_m), aligned.motion.weak_direction
        aside = self._voxel_m * dof / np.linalg.norm(lever @ dof)
        for step in (aside, -aside):
            other = self._by_planes(scan, pose.compose(gtsam.Pose3.Expmap(step)))
            shift = np.inf if other is None else lever @ gtsam.Pose3.Logmap(pose.between(other.pose))
            if np.linalg.norm(shift) > 0.5 * self._voxel_m:
                return aligned
        return replace(aligned, motion=replace(aligned.motion, T_reference_base=pose))

    def best_of(self, scan: FloatArray, starts: Sequence[gtsam.Pose3]) -> gtsam.Pose3:
        """Return the aligned start ``T_map_base`` with most points of a part of the scan on planes."""
        part = _part(scan, _ARRIVING_POINTS)
        limits = self._config.match.iterations, self._voxel_m
        placed = [place_cloud(part, self.planes, start, *limits) for start in starts]
        best = max(placed, key=lambda one: 0.0 if one is None else one.agreement)
        return starts[0] if best is None else best.pose

    def agreement(self, scan: FloatArray, pose: gtsam.Pose3) -> float:
        """Return the share of a thinned scan (N, 3), base frame, on planes at ``T_map_base``."""
        residuals = self.planes.residuals(scan, pose.matrix()).distances_m
        return share_on_planes(residuals, self._voxel_m, len(scan))

    def _by_planes(self, scan: FloatArray, start: gtsam.Pose3) -> CloudAlignment | None:
        """Return the point-to-plane alignment."""
        return align_cloud(scan, self.planes, start, self._config.match.iterations, self._voxel_m)

    def _is_near(self, match: CloudAlignment, guess: gtsam.Pose3) -> bool:
        """Return whether an alignment converged near its expected pose."""
        moved_m = np.abs(levers(match.arms_m) @ gtsam.Pose3.Logmap(guess.between(match.pose)))
        confident = match.converged and match.inlier_share >= self._config.match.confident_inlier_share
        return bool(confident and moved_m.max() <= self._voxel_m)


def _part(scan: FloatArray, count: int) -> FloatArray:
    """Return about so many points, evenly sampled."""
    return scan[:: -(-len(scan) // count)]


def moved(points: FloatArray, pose: gtsam.Pose3) -> FloatArray:
    """Transform points (N, 3) from frame b to frame a by ``T_a_b``."""
    return to_frame(points, pose.matrix())
