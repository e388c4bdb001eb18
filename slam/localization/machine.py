"""State machine of localisation for any sensor: search, track, lose, recover.

A tracked pose is accepted until the readings contradict it (Page 1954).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Generic

import numpy as np

from fusion.estimation import TINY
from slam.config.localization import LocalizationConfig
from slam.estimates import MotionEstimate
from slam.localization.hypotheses import HypothesisSet
from slam.localization.output import LocalizerOutput, PoseHypothesis, RecoveredPose, State
from slam.localization.pose_smoother import PoseSmoother
from slam.localization.poses import SAME_M, Measured, after, diagonal, position_sigma_m, squared_mahalanobis
from slam.localization.sensor import N, Observation, Sensor, V, moved_on, new_share
from slam.matching.match_covariance import OPEN_M
from slam.measurements import Pose, composed, motion_between

# Evidence of one reading is at most so many nats: a person may be in front of the sensor.
_GREATEST_NATS = 2.0


class StateMachine(Generic[V, N]):
    """State of one drive in a known map; add the readings of its sensor in log order.

    Parameters
    ----------
    start
        ``T_map_base`` at the first reading, if it is given; it is trusted like dead reckoning.
    alike
        Gives the probability that a place found only by its appearance is a copy of another; called once.

    Attributes
    ----------
    copied
        This probability for the tracked pose; 0 if it was given, or reached from there by dead reckoning.
    """

    def __init__(
        self,
        sensor: Sensor[V, N],
        config: LocalizationConfig,
        start: Measured | None = None,
        alike: Callable[[], float] = float,
    ) -> None:
        self._look_alikes, self.copied = cache(alike), 0.0
        self._sensor, self._config, self._start = sensor, config, start
        self._hypotheses = HypothesisSet(sensor, config)
        self._loss = LossTest(config)
        self._state = State.SEARCHING
        self._contradicted = False
        self._smoother: PoseSmoother | None = None
        self._known: Measured | None = None
        self._unknown: list[tuple[float, Pose]] = []
        self._odometry_pose: Pose | None = None
        self._supported_at: Pose | None = None

    @property
    def tracked(self) -> Measured | None:
        """``T_map_base`` while it is tracked."""
        return self._known if self._state is State.TRACKING else None

    def add(self, measurement: Any) -> LocalizerOutput | None:
        """Process a reading; return the output, or None if the sensor only stores it or does not use it."""
        known = self.tracked
        observed = self._sensor.observe(measurement, None if known is None else known.pose)
        if observed is None:
            return None
        self._odometry_pose = observed.pose
        if observed.restarted:
            self._forget()
            self._supported_at = None
            self._contradicted = True
        predicted = None
        if self._known is not None:
            # If the motion is unknown, not even dead reckoning continues from the last pose.
            predicted = None if observed.moved is None else after(self._known, observed.moved)
            self._state = State.LOST if predicted is None else self._state
        if self._start is not None:
            predicted, self._start = self._start, None
            self._state, self._contradicted = State.LOST, False
            self._loss.reset(self._config.nowhere_nats)
        recovered: Sequence[RecoveredPose] = ()
        tracks = self._state is State.TRACKING
        if tracks and predicted is not None and position_sigma_m(predicted) <= self._config.dead_reckoning_m:
            support = self._track(observed, predicted)
        else:
            support, recovered = self._search(observed, predicted)
        return self._output(observed, support, recovered)

    def wants_help(self) -> bool:
        """Return whether the robot has moved since another sensor helped: only then is it new evidence."""
        if self._odometry_pose is None or not moved_on(self._supported_at, self._odometry_pose, self._config):
            return False
        self._supported_at = self._odometry_pose
        return True

    def confirm(self, measured: Measured) -> None:
        """Use the tracked pose as another sensor measures it, if plausible: its map may differ."""
        measured = self._in_map(measured)
        if self.tracked is not None and self._smoother is not None and self._may_be(self.tracked, measured):
            self._smoother.add_seen(measured)
            self._known = self._smoother.newest

    def propose(self, pose: Pose) -> None:
        """Add ``T_map_base`` that another sensor found during a search."""
        if self._odometry_pose is not None:
            self._hypotheses.propose(pose, self._odometry_pose)

    def _track(self, observed: Observation[V], predicted: Measured) -> float:
        """Align to the map at the predicted pose and verify; return the share that the map explains."""
        assert self._smoother is not None and observed.moved is not None
        motion = self._sensor.align(observed.view, predicted.pose)
        believed = self._believed(motion, predicted)
        self._smoother.add(observed.moved, [] if believed is None else [_measured(believed)])
        self._known = self._smoother.newest
        pose = self._known.pose
        novel = self._sensor.novel(observed.view, motion_between(pose, pose), None)
        evidence = self._sensor.weigh(pose, novel, believed)
        moved = 1.0 if observed.restarted else new_share(observed.moved.pose, self._config)
        self._loss.add(observed.stamp_s, evidence, moved)
        if self._loss.lost:
            self._state, self._contradicted = State.LOST, True
            self._forget()
        return math.nan if motion is None else motion.inlier_share

    def _believed(self, motion: MotionEstimate | None, predicted: Measured) -> MotionEstimate | None:
        """Return an alignment if it has enough inliers and passes the gate."""
        if motion is None or motion.inlier_share < self._config.least_inlier_share:
            return None
        return motion if self._may_be(predicted, _measured(motion)) else None

    def _may_be(self, expected: Measured, measured: Measured) -> bool:
        """Return whether a pose passes the gate."""
        return squared_mahalanobis(expected, measured) <= self._config.gate_sigmas**2

    def _search(
        self, observed: Observation[V], predicted: Measured | None
    ) -> tuple[float, Sequence[RecoveredPose]]:
        """Weight all hypotheses; if one wins, start to track it.

        If the predicted pose is too uncertain for an alignment, all poses within its covariance are possible,
        until the readings contradict all of them.
        """
        if self._state is State.TRACKING:
            self._state = State.LOST
            self._forget()
        self._smoother, self._known = None, predicted
        if observed.pose is None:
            return math.nan, ()
        self._unknown.append((observed.stamp_s, observed.pose))
        if not self._hypotheses.due(observed.view, observed.pose):
            self._hypotheses.seek()
            return math.nan, ()
        known = None if predicted is None else self._in_map(predicted)
        bound = known is not None and not self._contradicted
        self._hypotheses.add_keyframe(observed.view, observed.pose, known, bound=bound)
        if bound:
            self._loss.add(observed.stamp_s, self._hypotheses.newest_nats)
            if self._loss.lost:
                self._contradicted = True
                self._forget()
        winner = self._hypotheses.winner()
        if winner is not None and winner.motion is not None and winner.determined:
            self.copied = self.copied if bound else self._look_alikes()
            return winner.motion.inlier_share, self._found(_measured(winner.motion), observed.pose)
        together = self._hypotheses.together()
        if together is not None and position_sigma_m(together) <= SAME_M:
            return math.nan, self._found(together, observed.pose)
        return math.nan, ()

    def _found(self, start: Measured, odometry_pose: Pose) -> Sequence[RecoveredPose]:
        """Start to track a pose that was found; the path up to here becomes known."""
        self._state, self._contradicted = State.TRACKING, False
        self._smoother = PoseSmoother(start)
        self._known = self._smoother.newest
        self._loss.reset(self._config.lost_nats)
        recovered = [
            RecoveredPose(stamp_s, composed(start.pose, motion_between(odometry_pose, pose)))
            for stamp_s, pose in self._unknown[:-1]
        ]
        self._forget()
        return recovered

    def _in_map(self, known: Measured) -> Measured:
        """Return a pose with the local error of the map added."""
        bent = diagonal(known.pose, self._config.map_sigma_m, self._config.map_sigma_rad)
        return Measured(known.pose, known.covariance + bent)

    def _forget(self) -> None:
        """Discard hypotheses and unknown poses: the odometry no longer connects them, or need not."""
        self._hypotheses.clear()
        self._unknown.clear()

    def _output(
        self, observed: Observation[V], support: float, recovered: Sequence[RecoveredPose]
    ) -> LocalizerOutput:
        """Return the output for a reading; a pose that the newest reading contradicts counts as lost."""
        probabilities = self._hypotheses.probabilities()
        state, confidence = self._state, float(probabilities.max(initial=0.0))
        if self._smoother is not None and state is State.TRACKING:
            confidence = self._loss.confidence * self._smoother.trust * (1.0 - self.copied)
            state = State.LOST if self._loss.doubted else state
        known = None if self._known is None else self._in_map(self._known)
        if known is not None and state is State.LOST and (self._contradicted or self._loss.doubted):
            known = Measured(known.pose, known.covariance + diagonal(known.pose, OPEN_M, math.pi))
        members = self._hypotheses.members
        return LocalizerOutput(
            stamp_s=observed.stamp_s,
            state=state,
            pose=None if known is None else known.pose,
            covariance=None if known is None else known.covariance + np.outer(observed.late, observed.late),
            confidence=confidence,
            hypotheses=tuple(
                PoseHypothesis(members[n].pose, float(probabilities[n]))
                for n in np.argsort(-probabilities, kind="stable").tolist()
            ),
            support=support,
            recovered=tuple(recovered),
        )


def _measured(motion: MotionEstimate) -> Measured:
    """Return the aligned pose; in a degenerate direction it only repeats its guess."""
    open_ = np.outer(motion.weak_direction, motion.weak_direction) / TINY
    return Measured(motion.T_reference_base, motion.covariance + open_)


class LossTest:
    """Log-odds of the pose: a bounded sum of evidence, so that doubt is not delayed."""

    def __init__(self, config: LocalizationConfig) -> None:
        self._bound = config.lost_nats
        self._lost_after_s = config.lost_after_s
        self._moment_nats = config.nowhere_nats
        self.reset(self._bound)

    @property
    def lost(self) -> bool:
        """Return whether the pose has been contradicted for long enough."""
        return self._log_odds <= 0.0 and abs(self._stamp_s - self._sound_s) >= self._lost_after_s

    @property
    def confidence(self) -> float:
        """Return the probability of the pose; one contradicting reading causes doubt, but not loss.

        A recently correct pose has a prior in its favour against the newest reading.
        """
        return 0.5 + 0.5 * math.tanh(0.5 * self._balance)

    @property
    def doubted(self) -> bool:
        """Return whether the pose is more likely wrong than correct."""
        return self._balance < 0.0

    @property
    def _balance(self) -> float:
        """Return the evidence for the pose in nats."""
        return min(self._log_odds, self._newest + self._moment_nats)

    def reset(self, log_odds: float) -> None:
        """Restart with a pose that was just found or given, with this probability."""
        self._log_odds = min(self._bound, log_odds)
        self._newest = self._bound
        self._sound_s = math.nan
        self._stamp_s = math.nan

    def add(self, stamp_s: float, evidence: float, new_share: float = 1.0) -> None:
        """Add the evidence of a reading for the pose, nats.

        Parameters
        ----------
        new_share
            Share of it that is new compared with the last reading: two readings from one place count once.
        """
        self._stamp_s, self._newest = stamp_s, evidence
        added = min(max(new_share * evidence, -_GREATEST_NATS), _GREATEST_NATS)
        self._log_odds = min(self._bound, self._log_odds + added)
        if self._log_odds == self._bound or math.isnan(self._sound_s):
            self._sound_s = stamp_s
