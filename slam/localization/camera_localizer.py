"""A body localised by a camera alone: places by looks, keyframes in sight, its own odometry in between."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.config import Config
from slam.localization.body import Body, Measured, composed
from slam.localization.loss_test import LossTest
from slam.localization.output import LocalizerOutput, PoseHypothesis, RecoveredPose, State
from slam.localization.pose_smoother import PoseSmoother, squared_sigmas
from slam.localization.visual_locator import VisualLocator
from slam.measurements import FloatArray, Pose
from slam.odometry.rgbd_tracker import RgbdTracker
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualMatch

# Sigmas within which two places found by looks are one, beside their covariances: metres and radians.
_SAME_M, _SAME_RAD = 0.15, 0.08
# A place is believed when it was found so often, from where the camera saw anew.
_FINDS = 3
# Evidence of one frame for the pose and against it, nats.
_MATCHED_NATS, _UNMATCHED_NATS = 2.0, -0.5
# Sigmas of a step that nothing measured: the camera's own metres and radians a frame.
_UNKNOWN_STEP = 0.1


@dataclass(frozen=True, slots=True)
class _Seen:
    """``T_odom_camera`` of a frame with its covariance (6, 6) against the frames before.

    No motion is known between different segments.
    """

    pose: gtsam.Pose3
    covariance: FloatArray
    segment: int


@dataclass(slots=True)
class _Found:
    """A place found by looks: the body in the map when it was at a pose of the odometry, and how often."""

    pose: Measured
    at: _Seen
    finds: int


class CameraLocalizer:
    """State of one drive or walk in a known map; feed the frames of one camera in the order of the log."""

    def __init__(self, locator: VisualLocator, body: Body, config: Config) -> None:
        self._locator = locator
        self._body = body
        self._config = config.localization
        self._gate = config.localization.gate_sigmas**2
        self._depth_share = config.rgbd_odometry.keyframe_parallax
        self._odometry = RgbdTracker(FrameMatcher(config.rgbd_odometry), config.rgbd_odometry)
        self._segment = 0
        self._loss = LossTest(config.localization)
        self._state = State.SEARCHING
        self._smoother: PoseSmoother | None = None
        self._last: _Seen | None = None
        self._looked: _Seen | None = None
        self._found: list[_Found] = []
        self._untold: list[tuple[float, _Seen]] = []

    def add_frame(self, frame: PreparedFrame) -> LocalizerOutput:
        """Take a frame."""
        now = self._seen(frame)
        step = self._moved(self._last, now)
        if step is None:
            self._found.clear()
            self._untold.clear()
        if self._smoother is not None:
            self._smoother.add(self._unknown_step() if step is None else step, [])
        self._last = now
        support = math.nan
        recovered: tuple[RecoveredPose, ...] = ()
        if self._state is State.TRACKING:
            support = self._track(frame)
        elif now is not None:
            support, recovered = self._search(frame, now)
        return self._output(frame.stamp_s, support, recovered)

    def _seen(self, frame: PreparedFrame) -> _Seen | None:
        """Where the odometry saw the camera; None where it is lost."""
        tracked = self._odometry.track(frame)
        self._segment += tracked.restarted
        if tracked.new_keyframe:
            self._odometry.add_keyframe(frame, tracked)
        if tracked.match is not None:
            return _Seen(tracked.pose, tracked.match.motion.covariance, self._segment)
        # The beginning of a segment is its origin, and exact.
        return _Seen(tracked.pose, np.zeros((6, 6)), self._segment) if tracked.new_keyframe else None

    def _moved(self, before: _Seen | None, after: _Seen | None) -> Measured | None:
        """Motion of the body between two frames; None where the odometry does not know."""
        if before is None or after is None or before.segment != after.segment:
            return None
        motion = before.pose.between(after.pose)
        adjoint = motion.inverse().AdjointMap()
        return self._body.of_step(motion, adjoint @ before.covariance @ adjoint.T + after.covariance)

    def _unknown_step(self) -> Measured:
        """No motion, and no idea."""
        assert self._smoother is not None
        pose: Pose = gtsam.Pose2() if isinstance(self._smoother.newest.pose, gtsam.Pose2) else gtsam.Pose3()
        return Measured(pose, np.eye(len(self._smoother.newest.covariance)) * _UNKNOWN_STEP**2)

    def _track(self, frame: PreparedFrame) -> float:
        """Match the frame to the keyframes that should be in sight, and judge."""
        assert self._smoother is not None
        newest = self._smoother.newest
        match = self._locator.near(frame, self._body.camera_of(newest.pose))
        seen = None if match is None else self._measured(match)
        if seen is not None and squared_sigmas(newest, seen) <= self._gate:
            self._smoother.add_seen(seen)
            self._loss.add(frame.stamp_s, _MATCHED_NATS)
        elif self._locator.should_see(frame, self._body.camera_of(newest.pose)):
            self._loss.add(frame.stamp_s, _UNMATCHED_NATS)
        if self._loss.lost or self._smoother.sigma_m > self._config.dead_reckoning_m:
            self._state = State.LOST
            self._found.clear()
            self._untold.clear()
        return math.nan if match is None else match.motion.inlier_share

    def _measured(self, match: VisualMatch) -> Measured | None:
        """The body where a match puts its camera."""
        return self._body.of_camera(match.pose, match.motion.covariance)

    def _search(self, frame: PreparedFrame, now: _Seen) -> tuple[float, tuple[RecoveredPose, ...]]:
        """Look for the place; where finds from several views agree, begin to track."""
        self._untold.append((frame.stamp_s, now))
        if not self._sees_anew(frame, now):
            return math.nan, ()
        self._looked = now
        best = math.nan
        for match in self._locator.anywhere(frame):
            place = self._measured(match)
            if place is not None:
                best = match.motion.inlier_share
                self._note(place, now)
        self._found.sort(key=lambda found: -found.finds)
        if self._found and self._found[0].finds >= _FINDS and self._outdoes_all():
            return best, self._begin(self._settled(self._found[0].pose, frame), now)
        return best, ()

    def _sees_anew(self, frame: PreparedFrame, now: _Seen) -> bool:
        """Whether the camera has moved on since the last look."""
        if self._looked is None or self._looked.segment != now.segment:
            return True
        step = self._looked.pose.between(now.pose)
        turn = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
        travel = float(np.linalg.norm(step.translation())) / frame.median_depth_m
        return math.hypot(travel, turn) > 0.5 * self._depth_share

    def _note(self, place: Measured, now: _Seen) -> None:
        """Take a find: it confirms a place that the odometry leads here from, or is a new one."""
        for found in self._found:
            step = self._moved(found.at, now)
            if step is None:
                continue
            carried = Measured(
                composed(found.pose.pose, step.pose), found.pose.covariance + _slack(place.pose)
            )
            if squared_sigmas(carried, place) <= self._gate:
                found.pose, found.at, found.finds = place, now, found.finds + 1
                return
        self._found.append(_Found(place, now, 1))

    def _outdoes_all(self) -> bool:
        """Whether the first place was found more than twice as often as any other."""
        return len(self._found) == 1 or self._found[0].finds > 2 * self._found[1].finds

    def _settled(self, place: Measured, frame: PreparedFrame) -> Measured:
        """A place by looks matched to all keyframes in sight; where they tell nothing, unsure.

        A match to one keyframe from anywhere may settle beside the place, and claim to be sure.
        """
        match = self._locator.near(frame, self._body.camera_of(place.pose))
        seen = None if match is None else self._measured(match)
        unsure = Measured(place.pose, place.covariance + _slack(place.pose))
        return seen if seen is not None and squared_sigmas(unsure, seen) <= self._gate else unsure

    def _begin(self, place: Measured, now: _Seen) -> tuple[RecoveredPose, ...]:
        """Track a place; the way up to it becomes known."""
        self._state = State.TRACKING
        self._smoother = PoseSmoother(place)
        self._loss.reset()
        recovered = []
        for stamp_s, at in self._untold[:-1]:
            step = self._moved(now, at)
            if step is not None:
                recovered.append(RecoveredPose(stamp_s, composed(place.pose, step.pose)))
        self._untold.clear()
        self._found.clear()
        return tuple(recovered)

    def _output(self, stamp_s: float, support: float, recovered: Sequence[RecoveredPose]) -> LocalizerOutput:
        """What is known after a frame."""
        known = None if self._smoother is None else self._smoother.newest
        finds = [found.finds for found in self._found]
        confidence = max(finds, default=0) / (sum(finds) + _FINDS)
        if self._state is State.TRACKING and self._smoother is not None:
            confidence = self._loss.confidence * self._smoother.trust
        return LocalizerOutput(
            stamp_s=stamp_s,
            state=self._state,
            pose=None if known is None else known.pose,
            covariance=None if known is None else known.covariance,
            confidence=confidence,
            hypotheses=tuple(
                PoseHypothesis(found.pose.pose, found.finds / (sum(finds) + _FINDS)) for found in self._found
            ),
            support=support,
            recovered=tuple(recovered),
        )


def _slack(pose: Pose) -> FloatArray:
    """(d, d) covariance by which two places found by looks may differ and still be one."""
    if isinstance(pose, gtsam.Pose3):
        return np.diag([_SAME_RAD**2] * 3 + [_SAME_M**2] * 3)
    return np.diag([_SAME_M**2, _SAME_M**2, _SAME_RAD**2])
