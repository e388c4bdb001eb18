"""A robot on a floor, localised by its lidar: search, track, lose, find again."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from slam.config import Config
from slam.localization.hypotheses import Hypothesis, HypothesisSet
from slam.localization.known_map import KnownMap, Walls
from slam.localization.loss_test import LossTest
from slam.localization.map_match import MapMatcher
from slam.localization.output import LocalizerOutput, PoseHypothesis, RecoveredPose, State
from slam.localization.pose_smoother import PoseSmoother
from slam.localization.scan_odometry import OdometryStep, ScanOdometry
from slam.localization.scan_view import ScanView
from slam.matching.planar import between, compose
from slam.measurements import (
    FloatArray,
    LaserScan,
    MotionEstimate,
    WheelOdometry,
    pose2_from_row,
    row_from_pose2,
)

# Sigmas of a pose that was found where nothing could be aligned: the cell of the search.
_FOUND_SIGMAS = np.array([0.1, 0.1, 0.05])
# Dead reckoning is right while it is off by less than this.
_RIGHT_M = 0.25
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

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Take a wheel reading."""
        self._odometry.add_wheels(reading)

    def add_scan(self, scan: LaserScan) -> LocalizerOutput:
        """Take a scan."""
        view = ScanView.of(scan, self._settings)
        step = self._odometry.add(view)
        if step.broken:
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

    def _track(self, view: ScanView, step: OdometryStep) -> float:
        """Predict, match to the map, judge: the share of the scan that the map explains."""
        assert self._smoother is not None
        predicted, covariance = self._smoother.predict(step.step, step.covariance)
        motion = self._matcher.align(view, predicted)
        seen: list[tuple[FloatArray, FloatArray]] = []
        if motion is not None and self._is_believed(motion, predicted, covariance):
            seen.append((row_from_pose2(motion.T_reference_base), motion.covariance))
        self._smoother.add(step.step, step.covariance, seen)
        pose = self._smoother.pose
        evidence = self._matcher.weigh(pose, view.laser, view.thinned(self._config.news_cell_m))
        self._loss.add(view.stamp_s, evidence)
        if self._loss.lost or self._sigma_m() > self._config.dead_reckoning_m:
            self._lose()
        return math.nan if motion is None else motion.inlier_share

    def _is_believed(self, motion: MotionEstimate, predicted: FloatArray, covariance: FloatArray) -> bool:
        """Whether enough of the scan agrees with a match, and it is where it may be."""
        if motion.inlier_share < self._config.least_inlier_share:
            return False
        moved = between(predicted, row_from_pose2(motion.T_reference_base))
        squares = float(moved @ np.linalg.solve(covariance + motion.covariance, moved))
        return squares <= self._config.gate_sigmas**2

    def _search(self, view: ScanView, step: OdometryStep) -> tuple[float, tuple[RecoveredPose, ...]]:
        """Weigh all hypotheses; where one wins, begin to track it."""
        self._untold.append((view.stamp_s, step.pose))
        if self._smoother is not None and not step.broken:
            self._smoother.add(step.step, step.covariance, [])
        if not self._set.due(step.pose):
            return math.nan, ()
        carried = None if self._smoother is None else self._smoother.pose
        self._set.add_station(view, step.pose, carried)
        winner = self._set.winner()
        if winner is None:
            return math.nan, ()
        return self._found(winner, step)

    def _found(self, winner: Hypothesis, step: OdometryStep) -> tuple[float, tuple[RecoveredPose, ...]]:
        """Begin to track a hypothesis; the way up to here becomes known."""
        self._state = State.TRACKING
        covariance = np.diag(_FOUND_SIGMAS**2) if winner.motion is None else winner.motion.covariance
        self._smoother = PoseSmoother(winner.pose, covariance, self._config.lag_nodes)
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

    def _sigma_m(self) -> float:
        """Greatest standard deviation of the position."""
        assert self._smoother is not None
        return math.sqrt(float(np.linalg.eigvalsh(self._smoother.covariance[:2, :2])[-1]))

    def _output(self, stamp_s: float, support: float, recovered: Iterable[RecoveredPose]) -> LocalizerOutput:
        """What is known after a scan."""
        probabilities = self._set.probabilities()
        tracking = self._state is State.TRACKING
        confidence = self._loss.confidence if tracking else float(probabilities.max(initial=0.0))
        if tracking:
            confidence *= 1.0 - math.exp(-0.5 * (_RIGHT_M / self._sigma_m()) ** 2)
        told = [] if tracking else np.argsort(-probabilities, kind="stable")[:_TOLD].tolist()
        known = self._smoother
        return LocalizerOutput(
            stamp_s=stamp_s,
            state=self._state,
            pose=None if known is None else pose2_from_row(known.pose),
            covariance=None if known is None else known.covariance,
            confidence=confidence,
            hypotheses=tuple(
                PoseHypothesis(pose2_from_row(self._set.members[n].pose), float(probabilities[n]))
                for n in told
            ),
            support=support,
            recovered=tuple(recovered),
        )
