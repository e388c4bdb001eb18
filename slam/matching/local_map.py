"""A local map to match against: the oriented points of a few keyframes, as coarse and fine surfels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY
from slam.config.stages import MatchConfig
from slam.matching.coarse_to_fine import align_coarse_to_fine
from slam.matching.match_covariance import points_a_witness, weak_direction
from slam.matching.motion import Motion
from slam.matching.object_evidence import object_evidence
from slam.matching.planar import transform_points
from slam.matching.point_to_line import Alignment, align, terms_at
from slam.matching.scan_points import ScanPoints
from slam.matching.score_spread import score_spread
from slam.matching.surfel_map import SurfelMap, build_surfel_maps
from slam.matching.visibility import RangeImage, RangeImages, standing_before
from slam.measurements import BoolArray, Float32Array, FloatArray

Seen: TypeAlias = Sequence[Callable[[], RangeImage]]
# Enough to fix a poorly determined direction against the noise of the points.
_HELD_POINTS = 300.0


@dataclass(frozen=True, slots=True)
class OrientedPoints:
    """Points with normals: (M, 2) each, float32, in one frame."""

    points: Float32Array
    normals: Float32Array

    def __len__(self) -> int:
        return int(self.points.shape[0])

    @classmethod
    def from_scan(cls, scan: ScanPoints) -> OrientedPoints:
        """Return the oriented part of a scan, base frame."""
        return cls(*scan.oriented())

    @classmethod
    def surface(cls, scan: ScanPoints) -> OrientedPoints:
        """Return the surface of a scan, base frame: its oriented part, and walls between far readings."""
        points, normals = scan.oriented()
        if not len(scan.walls_base):
            return cls(points, normals)
        return cls(
            np.concatenate([points, scan.walls_base]), np.concatenate([normals, scan.wall_normals_base])
        )

    @classmethod
    def none(cls) -> OrientedPoints:
        """Return no points."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))

    def moved(self, pose: FloatArray) -> OrientedPoints:
        """Transform the points to the frame in which ``pose`` (3,) is the pose of their frame."""
        points, turn = transform_points(self.points, pose), np.array([0.0, 0.0, pose[2]])
        normals = transform_points(self.normals, turn)
        return OrientedPoints(points.astype(self.points.dtype), normals.astype(self.normals.dtype))

    def only(self, chosen: BoolArray | NDArray[np.intp] | slice) -> OrientedPoints:
        """Return some of the points."""
        return OrientedPoints(self.points[chosen], self.normals[chosen])

    def thinned(self, count: int) -> Float32Array:
        """Return about ``count`` of the points, evenly sampled in beam order, (K, 2)."""
        return np.ascontiguousarray(self.points[:: max(1, -(-len(self) // count))])


@dataclass(frozen=True)
class LocalMap:
    """Points of some keyframes in one frame, their surfels, and the free space seen by those keyframes."""

    points: OrientedPoints
    coarse: SurfelMap
    fine: SurfelMap
    config: MatchConfig
    images: Seen = ()

    @cached_property
    def _images(self) -> RangeImages:
        """Return the free space seen by the keyframes, joined at first use."""
        return RangeImages.of(image() for image in self.images)

    @classmethod
    def build(cls, parts: list[OrientedPoints], config: MatchConfig, images: Seen = ()) -> LocalMap:
        """Join scans that are already in the map's frame; `evidence` uses their range images."""
        points = OrientedPoints(
            np.concatenate([part.points for part in parts]), np.concatenate([part.normals for part in parts])
        )
        cells_m = config.cell_m, config.coarse_cell_m
        fine, coarse = build_surfel_maps(points.points, points.normals, cells_m)
        return cls(points, coarse, fine, config, images)

    def align(self, scan: OrientedPoints, guess: FloatArray) -> Alignment:
        """Align a scan (base frame) from a guess (3,), coarse first, then fine.

        If a direction is undetermined (a corridor), the guess is kept there: otherwise the noise of the
        normals would decide (solution remapping, Zhang 2016).
        """
        result = self.align_along(scan, guess, np.zeros(3))
        weak = weak_direction(result, self.config.degenerate_share)
        return result if weak is None else self.align_along(scan, guess, weak)

    def align_along(self, scan: OrientedPoints, guess: FloatArray, held: FloatArray) -> Alignment:
        """Align a scan that must stay near its guess in one direction, a unit tangent (3,), or in none."""
        # In points: far below any wall, enough to fix an undetermined direction.
        loose = np.eye(3)
        return self._align(scan, guess, loose + _HELD_POINTS * np.outer(held, held))

    def align_held(self, scan: OrientedPoints, guess: FloatArray) -> Alignment:
        """Align a scan that must stay near its guess in every direction."""
        return self._align(scan, guess, _HELD_POINTS * np.diag([1.0, 1.0, 0.0]))

    def judge(self, scan: OrientedPoints, pose: FloatArray) -> Alignment:
        """Return Hessian, residual and inlier share of a scan (base frame) at a fixed pose (3,)."""
        config = self.config
        kernel_m = 0.5 * config.cell_m
        judged = align(scan.points, scan.normals, pose, pose, self.fine, kernel_m, 1, np.eye(3) / TINY)
        spread = score_spread(scan.points, scan.normals, pose, self.fine, kernel_m, config.correlated_beams)
        return judged._replace(pose=pose, converged=True, spread=spread)

    def evidence(self, scan: OrientedPoints, pose: FloatArray, other: Motion) -> FloatArray:
        """Return the evidence of each object of a scan (base frame) for a pose (3,) over another, in points.

        Returns
        -------
        (2, K) independent points that fit, or contradict the scans of the map; and that fit while the area at
        the other pose is unknown.
        """
        judged = self.judge(scan, pose)
        usual = judged.fit / max(judged.inlier_share, TINY)
        weights = []
        for at in (Motion(pose, np.zeros((3, 3))), other):
            fits, passed = self._fits(scan, at)
            weights.append([np.where((fits == 0.0) & ~passed, unknown, fits) for unknown in (usual, 0.0)])
        gains = np.array(weights[0]) - np.array(weights[1])
        known, total = (object_evidence(scan.points, gain) for gain in gains)
        return np.stack([known, total - known]) / points_a_witness(judged)

    def contradicted(self, scan: OrientedPoints, pose: FloatArray, covariance: FloatArray | int = 0) -> float:
        """Return the share of a scan's points (base frame) that contradict the map at a pose (3,)."""
        weights, contradicts = self._fits(scan, Motion(pose, np.zeros((3, 3)) + covariance))
        return float((1.0 - weights) @ contradicts) / max(len(scan), 1)

    def _fits(self, scan: OrientedPoints, at: Motion) -> tuple[FloatArray, BoolArray]:
        """Return (M,) robust weights of a scan's points, and whether they contradict the map.

        A point contradicts it if a scan saw free space there, or if it was seen through an object of the map;
        farther away than a surfel reaches, and than the covariance of the pose explains.
        """
        weights = terms_at(scan.points, scan.normals, at.pose, self.fine, 0.5 * self.config.cell_m)[:, 3]
        x, y = scan.points.astype(np.float64).T
        (xx, _, xt), (_, yy, yt), (_, _, tt) = at.covariance.tolist()
        variance = xx + yy + 2.0 * (yt * x - xt * y) + tt * (x * x + y * y)
        margins_m = 0.5 * self.config.coarse_cell_m + np.sqrt(variance)
        passed = self._images.less_far(transform_points(scan.points, at.pose), margins_m, 1)
        # Without points that later scans saw as free: a walking person leaves a trail in the map.
        reach_m = 0.5 * self.config.coarse_cell_m
        map_points = self.points.points
        standing = standing_before(map_points, self._images, reach_m, at.pose, scan.points, margins_m)
        crossed = standing.less_far(scan.points, margins_m, -1)
        return weights, passed | crossed

    def _align(self, scan: OrientedPoints, guess: FloatArray, prior: FloatArray) -> Alignment:
        """Align coarse, then fine, both with a prior at the same guess."""
        config = self.config
        levels = (self.coarse, config.cell_m), (self.fine, 0.5 * config.cell_m)
        lags, settled = config.correlated_beams, (config.floor_m, config.floor_rad)
        rows = scan.points, scan.normals
        return align_coarse_to_fine(*rows, guess, *levels, config.iterations, prior, lags, settled)
