"""A robot with a 3D lidar in a map of clouds: search, track, lose, find again."""

from __future__ import annotations

import math
from collections.abc import Iterable

import gtsam
import numpy as np

from slam.config import Config
from slam.localization.body import Measured
from slam.localization.cloud_hypotheses import CloudHypotheses
from slam.localization.cloud_match import CloudMatcher, CloudView
from slam.localization.cloud_motion import CloudMotion, CloudStep
from slam.localization.evidence import Hypothesis
from slam.localization.known_clouds import KnownClouds
from slam.localization.loss_test import LossTest
from slam.localization.output import LocalizerOutput, PoseHypothesis, RecoveredPose, State
from slam.localization.pose_smoother import PoseSmoother, squared_sigmas
from slam.localization.whole_map_field import WholeMapField
from slam.matching.cloud_points import at_middle_of_turn
from slam.measurements import MotionEstimate, PointCloud, WheelOdometry

# Sigmas of a pose that was found where nothing could be aligned, radians and metres.
_FOUND_SIGMAS = np.array([0.02, 0.02, 0.05, 0.1, 0.1, 0.05])
# Less than this, and the pose is rather wrong.
_DOUBT = 0.5
# Hypotheses that are told.
_TOLD = 8


class CloudLocalizer:
    """State of one drive in a known map; feed clouds and wheel readings in the order of the log.

    Parameters
    ----------
    known
        The clouds of the map.
    field
        Of its plan; None where it has none.
    """

    def __init__(self, known: KnownClouds, field: WholeMapField | None, config: Config) -> None:
        self._config, self._odometry = config.localization, config.cloud_odometry
        self._matcher = CloudMatcher(known, field, config)
        self._motion = CloudMotion(config)
        self._set = CloudHypotheses(self._matcher, config)
        self._loss = LossTest(config.localization)
        settings = config.cloud_localization
        self._map_covariance = np.diag([settings.map_sigma_rad**2] * 3 + [settings.map_sigma_m**2] * 3)
        self._state = State.SEARCHING
        self._smoother: PoseSmoother | None = None
        self._untold: list[tuple[float, gtsam.Pose3]] = []

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Take a wheel reading."""
        self._motion.add_wheels(reading)

    def add_cloud(self, cloud: PointCloud) -> LocalizerOutput:
        """Take a cloud; what is known is told at the middle of its turn, if that is deskewed."""
        cloud = at_middle_of_turn(cloud, self._odometry)
        step = self._motion.add(cloud)
        view = self._matcher.view(cloud, step.points)
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

    def _track(self, view: CloudView, step: CloudStep) -> float:
        """Predict, match to the map, judge: the share of the cloud that the map explains."""
        assert self._smoother is not None
        predicted = self._smoother.predict(step.moved)
        motion = self._matcher.align(view, _in_space(predicted))
        self._smoother.add(step.moved, self._believed(motion, predicted))
        self._loss.add(view.stamp_s, self._matcher.weigh(_in_space(self._smoother.newest), view))
        if self._loss.lost or self._smoother.sigma_m > self._config.dead_reckoning_m:
            self._lose()
        return math.nan if motion is None else motion.inlier_share

    def _believed(self, motion: MotionEstimate | None, predicted: Measured) -> list[Measured]:
        """A match, if it is where it may be."""
        if motion is None:
            return []
        found = Measured(motion.T_reference_base, motion.covariance)
        return [found] if squared_sigmas(predicted, found) <= self._config.gate_sigmas**2 else []

    def _search(self, view: CloudView, step: CloudStep) -> tuple[float, tuple[RecoveredPose, ...]]:
        """Weigh all hypotheses; where one wins, begin to track it."""
        self._untold.append((view.stamp_s, step.pose))
        if self._smoother is not None and not step.broken:
            self._smoother.add(step.moved, [])
        if not len(view.points) or not self._set.due(step.pose):
            return math.nan, ()
        carried = None if self._smoother is None else _in_space(self._smoother.newest)
        self._set.add_station(view, step.pose, carried)
        winner = self._set.winner()
        if winner is None:
            return math.nan, ()
        return self._found(winner, step)

    def _found(
        self, winner: Hypothesis[gtsam.Pose3], step: CloudStep
    ) -> tuple[float, tuple[RecoveredPose, ...]]:
        """Begin to track a hypothesis; the way up to here becomes known."""
        self._state = State.TRACKING
        covariance = np.diag(_FOUND_SIGMAS**2) if winner.motion is None else winner.motion.covariance
        self._smoother = PoseSmoother(Measured(winner.pose, covariance))
        self._loss.reset()
        self._set.clear()
        recovered = tuple(
            RecoveredPose(stamp_s, winner.pose.compose(step.pose.between(pose)))
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
        """What is known after a cloud; a pose that the newest one speaks against counts as lost."""
        probabilities = self._set.probabilities()
        tracking = self._state is State.TRACKING
        confidence = self._loss.confidence if tracking else float(probabilities.max(initial=0.0))
        if tracking and self._smoother is not None:
            confidence *= self._smoother.trust
        doubted = tracking and self._loss.confidence < _DOUBT
        told = [] if tracking else np.argsort(-probabilities, kind="stable")[:_TOLD].tolist()
        known = None if self._smoother is None else self._smoother.newest
        return LocalizerOutput(
            stamp_s=stamp_s,
            state=State.LOST if doubted else self._state,
            pose=None if known is None else known.pose,
            covariance=None if known is None else known.covariance + self._map_covariance,
            confidence=confidence,
            hypotheses=tuple(
                PoseHypothesis(self._set.members[n].pose, float(probabilities[n])) for n in told
            ),
            support=support,
            recovered=tuple(recovered),
        )


def _in_space(measured: Measured) -> gtsam.Pose3:
    """The pose, which is one in space."""
    assert isinstance(measured.pose, gtsam.Pose3)
    return measured.pose
