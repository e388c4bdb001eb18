"""Localise with a 2D lidar in a known map: align scans to its walls, and weight their beams."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from slam.config import Config
from slam.estimates import MotionEstimate
from slam.localization.beam_check import BeamCounts, check_beams, in_clear_space
from slam.localization.global_search import Window, search_map
from slam.localization.known_map import Walls
from slam.localization.odometry import ScanOdometry
from slam.localization.poses import Measured
from slam.localization.scan_view import ScanView, cell_keys, first_in_cells
from slam.localization.sensor import Keyframe, Observation, moved_on
from slam.matching.local_map import OrientedPoints
from slam.matching.match_covariance import motion_from_alignment
from slam.matching.planar import compose, transform_points
from slam.measurements import (
    FloatArray,
    LaserScan,
    Pose,
    WheelOdometry,
    motion_between,
    pose2_from_row,
    row_from_pose2,
)
from slam.odometry.surfel_odometry import LEAST_POINTS

# Shares of explained, crossing and in-free beams at the true pose, and at the best of all wrong poses. A
# silent beam says nothing: where the map is incomplete, true poses have as many of them as wrong ones. With
# what tools/learn_match_likelihoods.py learns in fr079 (0.95 to 0.72, 0.03 to 0.09, 0.02 to 0.19) places are
# found later, some never.
_EXPLAINED_NATS = math.log(0.93 / 0.57)
_CROSSING_NATS = math.log(0.02 / 0.17)
_IN_FREE_NATS = math.log(0.02 / 0.12)
_AROUND = np.array([(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)], np.int64)


class NovelSurfaces(NamedTuple):
    """Surfaces that a scan sees for the first time: no surface is counted twice.

    Attributes
    ----------
    points
        Points on these surfaces, one per cell, base frame.
    laser
        (2,) where the beams begin, base frame.
    keys
        The cells of the surfaces, odometry frame.
    """

    points: OrientedPoints
    laser: FloatArray
    keys: frozenset[int]


class PlanarSensor:
    """A `Sensor`; its only state is its odometry and cached map tiles."""

    def __init__(self, walls: Walls, config: Config) -> None:
        self._walls, self._config, self._settings = walls, config, config.localization
        # Created here, so that no reading is delayed.
        self._field, self._space = walls.field, walls.space
        self._noise = config.match
        self._odometry = ScanOdometry(config)
        self._searches = 0
        self.search_every_m = self._settings.search_every_m
        self.weighs_back, self.least_keyframes = sys.maxsize, 1

    def observe(self, measurement: Any, known: Pose | None) -> Observation[ScanView] | None:
        """See `Sensor`; takes scans and wheel readings."""
        if isinstance(measurement, WheelOdometry):
            self._odometry.add_wheels(measurement)
        if not isinstance(measurement, LaserScan):
            return None
        view = ScanView.of(measurement, self._config)
        step = self._odometry.add(self._without_dynamic_points(view, known))
        return Observation(view.stamp_s, view, step.pose, step.moved, step.moved is None)

    def sees_new(self, view: ScanView, before: Pose | None, pose: Pose) -> bool:
        """See `Sensor`."""
        return moved_on(before, pose, self._settings)

    def novel(
        self, view: ScanView, pose: Pose, before: Sequence[Keyframe[NovelSurfaces]] | None
    ) -> NovelSurfaces:
        """See `Sensor`."""
        points = transform_points(view.oriented.points, row_from_pose2(pose))
        first, cells = first_in_cells(points, self._settings.novel_cell_m)
        old_keys: frozenset[int] = frozenset().union(*(earlier.novel.keys for earlier in before or ()))
        # A cell beside a known one may be the same surface with a small error.
        around = (cells[:, None, :] + _AROUND).reshape(-1, 2)
        known = np.array([key in old_keys for key in cell_keys(around).tolist()], np.bool_)
        new = ~known.reshape(-1, len(_AROUND)).any(axis=1)
        return NovelSurfaces(
            view.oriented.only(first[new]), view.laser, frozenset(cell_keys(cells).tolist()) - old_keys
        )

    def align(self, view: ScanView, guess: Pose) -> MotionEstimate | None:
        """See `Sensor`."""
        row = row_from_pose2(guess)
        tile = self._walls.tile(row)
        if len(view.oriented) < LEAST_POINTS or len(tile.fine.surfels) < LEAST_POINTS:
            return None
        motion = motion_from_alignment(tile.align(view.oriented, row), self._noise)
        return motion if motion.inlier_share > 0.0 else None

    def weigh(self, pose: Pose, novel: NovelSurfaces, motion: MotionEstimate | None = None) -> float:
        """See `Sensor`."""
        beams = self.counted(pose, novel)
        against = _CROSSING_NATS * beams.crossing + _IN_FREE_NATS * beams.in_free
        return (_EXPLAINED_NATS * beams.explained + against) / self._settings.correlated_cells

    def counted(self, pose: Pose, novel: NovelSurfaces) -> BeamCounts:
        """Count what the beams of a scan show about ``T_map_base``."""
        row = row_from_pose2(pose)
        return check_beams(self._space, self._walls.tile(row).fine, row, novel.laser, novel.points)

    def propose(
        self, view: ScanView, keyframes: Sequence[Keyframe[NovelSurfaces]], within: Measured | None
    ) -> Iterator[Pose | None]:
        """See `Sensor`.

        It alternates between the last path, which is less ambiguous, and the newest scan, without drift.
        """
        settings, newest = self._settings, keyframes[-1]
        self._searches += 1
        points = [view.points.points_base.astype(np.float64)]
        if self._searches % 2:
            points += [
                transform_points(
                    keyframe.novel.points.points, row_from_pose2(motion_between(newest.pose, keyframe.pose))
                )
                for keyframe in keyframes[:-1]
                if newest.travelled_m - keyframe.travelled_m < settings.window_m / 3.0
            ]
        merged = np.concatenate(points)
        merged = merged[first_in_cells(merged, settings.novel_cell_m)[0]]
        window = None if within is None else Window.of(within, settings.gate_sigmas)
        places = yield from search_map(self._field, merged, settings, settings.hypotheses, window)
        yield from (pose2_from_row(place.pose) for place in places)

    def _without_dynamic_points(self, view: ScanView, known: Pose | None) -> ScanView:
        """Return a scan without points in known free space (people), if the pose is tracked.

        A scan that would lose many points is not changed: the pose is probably wrong.
        """
        if known is None:
            return view
        pose = compose(row_from_pose2(known), row_from_pose2(self._odometry.expected_step(view.stamp_s).pose))
        keep = ~in_clear_space(self._space, pose, view.points.points_base)
        return (
            view.only(keep) if not keep.all() and keep.mean() >= self._settings.least_inlier_share else view
        )
