"""A robot on a floor, localised by its lidar: search, track, lose, find again."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from slam.config import Config
from slam.localization.body import Body, Measured
from slam.localization.evidence import Hypothesis
from slam.localization.hypotheses import HypothesisSet
from slam.localization.known_map import KnownMap, Walls
from slam.localization.loss_test import LossTest
from slam.localization.map_match import MapMatcher
from slam.localization.output import LocalizerOutput, PoseHypothesis, RecoveredPose, State
from slam.localization.pose_smoother import PoseSmoother, squared_sigmas
from slam.localization.scan_odometry import OdometryStep, ScanOdometry
from slam.localization.scan_view import ScanView
from slam.localization.visual_locator import VisualLocator
from slam.matching.planar import between, compose
from slam.measurements import (
    FloatArray,
    LaserScan,
    MotionEstimate,
    WheelOdometry,
    pose2_from_row,
    row_from_pose2,
)
from slam.vision.prepared_frame import PreparedFrame

# Sigmas of a pose that was found where nothing could be aligned: the cell of the search.
_FOUND_SIGMAS = np.array([0.1, 0.1, 0.05])
# What a scan and a frame differ by though both are right: clocks, and the motion between them.
_BETWEEN_SENSORS = np.array([0.03, 0.03, 0.02])
# Hypotheses that are told.
_TOLD = 8


class PlanarLocalizer:
    """State of one drive in a known map; feed scans and wheel readings in the order of the log."""

    def __init__(self, known_map: KnownMap, config: Config) -> None:
        walls = Walls(known_map, config)
        self._config = config.localization
        self._matcher = MapMatcher(walls, config)
        self._odometry = ScanOdometry(config)
        self._set = HypothesisSet(walls, self._matcher, config.localization)
        self._loss = LossTest(config.localization)
        self._settings = config
        self._state = State.SEARCHING
        self._smoother: PoseSmoother | None = None
        self._untold: list[tuple[float, FloatArray]] = []
        self._odometry_pose: FloatArray | None = None
        self._looked_at: FloatArray | None = None

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Take a wheel reading."""
        self._odometry.add_wheels(reading)

    def add_scan(self, scan: LaserScan) -> LocalizerOutput:
        """Take a scan."""
        view = ScanView.of(scan, self._settings)
        step = self._odometry.add(self._without_strangers(view))
        self._odometry_pose = step.pose
        if step.broken:
            self._looked_at = None
            self._set.clear()
            self._untold.clear()
            # Not even dead reckoning leads on from the last pose.
            self._smoother = None
            self._state = State.SEARCHING if self._state is State.SEARCHING else State.LOST
        recovered: tuple[RecoveredPose, ...] = ()
        if self._state is State.TRACKING:
            support = self._track(view, step)
        else:
            support, recovered = self._search(view, step)
        return self._output(view.stamp_s, support, recovered)

    def add_frame(self, frame: PreparedFrame, locator: VisualLocator, body: Body) -> None:
        """Let a camera help: it proposes places while one is sought, and holds the pose while it is tracked.

        It is asked where the robot has moved on since it was asked last: that is as much as it can tell anew.
        """
        if self._odometry_pose is None or not self._frames_due():
            return
        self._looked_at = self._odometry_pose
        if self._state is State.TRACKING and self._smoother is not None:
            newest = self._smoother.newest
            match = locator.near(frame, body.camera_of(newest.pose))
            seen = None if match is None else body.of_camera(match.pose, match.motion.covariance)
            if seen is not None:
                seen = Measured(seen.pose, seen.covariance + np.diag(_BETWEEN_SENSORS**2))
                if squared_sigmas(newest, seen) <= self._config.gate_sigmas**2:
                    self._smoother.add_seen(seen)
            return
        for match in locator.anywhere(frame):
            seen = body.of_camera(match.pose, match.motion.covariance)
            if seen is not None:
                self._set.propose(row_from_pose2(seen.pose), self._odometry_pose)

    def _frames_due(self) -> bool:
        """Whether the robot has moved on since the camera was asked."""
        if self._looked_at is None or self._odometry_pose is None:
            return True
        step = between(self._looked_at, self._odometry_pose)
        moved_m, turned_rad = math.hypot(step[0], step[1]), abs(float(step[2]))
        return moved_m >= self._config.station_m or turned_rad >= self._config.station_rad

    def _without_strangers(self, view: ScanView) -> ScanView:
        """A scan without people, as far as a tracked pose can tell."""
        if self._state is not State.TRACKING or self._smoother is None:
            return view
        expected, _ = self._odometry.expected_step(view.stamp_s)
        pose = compose(row_from_pose2(self._smoother.newest.pose), expected)
        return self._matcher.without_strangers(view, pose)

    def _track(self, view: ScanView, step: OdometryStep) -> float:
        """Predict, match to the map, judge: the share of the scan that the map explains."""
        assert self._smoother is not None
        moved = Measured(pose2_from_row(step.step), step.covariance)
        predicted = self._smoother.predict(moved)
        motion = self._matcher.align(view, row_from_pose2(predicted.pose))
        self._smoother.add(moved, self._believed(motion, predicted))
        pose = row_from_pose2(self._smoother.newest.pose)
        points = view.thinned(self._config.news_cell_m)
        self._loss.add(view.stamp_s, self._matcher.weigh(pose, view.laser, points))
        if self._loss.lost or self._smoother.sigma_m > self._config.dead_reckoning_m:
            self._lose()
        return math.nan if motion is None else motion.inlier_share

    def _believed(self, motion: MotionEstimate | None, predicted: Measured) -> list[Measured]:
        """A match, if enough of the scan agrees with it and it is where it may be."""
        if motion is None or motion.inlier_share < self._config.least_inlier_share:
            return []
        found = Measured(motion.T_reference_base, motion.covariance)
        return [found] if squared_sigmas(predicted, found) <= self._config.gate_sigmas**2 else []

    def _search(self, view: ScanView, step: OdometryStep) -> tuple[float, tuple[RecoveredPose, ...]]:
        """Weigh all hypotheses; where one wins, begin to track it."""
        self._untold.append((view.stamp_s, step.pose))
        if self._smoother is not None and not step.broken:
            self._smoother.add(Measured(pose2_from_row(step.step), step.covariance), [])
        if not self._set.due(step.pose):
            return math.nan, ()
        carried = None if self._smoother is None else row_from_pose2(self._smoother.newest.pose)
        self._set.add_station(view, step.pose, carried)
        winner = self._set.winner()
        if winner is None:
            return math.nan, ()
        return self._found(winner, step)

    def _found(
        self, winner: Hypothesis[FloatArray], step: OdometryStep
    ) -> tuple[float, tuple[RecoveredPose, ...]]:
        """Begin to track a hypothesis; the way up to here becomes known."""
        self._state = State.TRACKING
        covariance = np.diag(_FOUND_SIGMAS**2) if winner.motion is None else winner.motion.covariance
        found = Measured(pose2_from_row(winner.pose), covariance)
        self._smoother = PoseSmoother(found)
        self._loss.reset()
        self._set.clear()
        recovered = tuple(
            RecoveredPose(stamp_s, pose2_from_row(compose(winner.pose, between(step.pose, pose))))
            for stamp_s, pose in self._untold[:-1]
        )
        self._untold.clear()
        return math.nan if winner.motion is None else winner.motion.inlier_share, recovered

    def _lose(self) -> None:
        """The pose is no longer believed: dead reckoning goes on, and the search begins."""
        self._state = State.LOST
        self._set.clear()
        self._untold.clear()

    def _output(self, stamp_s: float, support: float, recovered: Iterable[RecoveredPose]) -> LocalizerOutput:
        """What is known after a scan."""
        probabilities = self._set.probabilities()
        tracking = self._state is State.TRACKING
        confidence = self._loss.confidence if tracking else float(probabilities.max(initial=0.0))
        if tracking and self._smoother is not None:
            confidence *= self._smoother.trust
        told = [] if tracking else np.argsort(-probabilities, kind="stable")[:_TOLD].tolist()
        known = None if self._smoother is None else self._smoother.newest
        return LocalizerOutput(
            stamp_s=stamp_s,
            state=self._state,
            pose=None if known is None else known.pose,
            covariance=None if known is None else known.covariance,
            confidence=confidence,
            hypotheses=tuple(
                PoseHypothesis(pose2_from_row(self._set.members[n].pose), float(probabilities[n]))
                for n in told
            ),
            support=support,
            recovered=tuple(recovered),
        )
