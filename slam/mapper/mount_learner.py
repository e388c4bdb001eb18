"""Estimate the pose of a camera on its robot during mapping, from the motions of both."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from slam.graph.extrinsics import ExtrinsicsResult, MotionPair, estimate_extrinsics
from slam.matching.motion import Motion
from slam.measurements import FloatArray, pose2_from_row
from slam.vision.camera_frame import T_BODY_CAMERA

_CONFIDENT_RAD = math.radians(1.0)
_CONFIDENT_M = 0.03
_PLANAR = ("roll", "pitch", "yaw", "x", "y")


@dataclass(frozen=True, slots=True)
class KeyframeStep:
    """A camera's motion between two keyframes."""

    source: int
    target: int
    motion: gtsam.Pose3
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class LearnedMounting:
    """``T_base_camera`` estimated from a whole run, and a note for the user."""

    T_base_camera: gtsam.Pose3
    note: str


@dataclass(slots=True)
class MountLearner:
    """Motion pairs of one camera, and its mounting as soon as it is certain.

    Attributes
    ----------
    start
        ``T_base_camera`` in the log, right or wrong; None if the log has none.
    steps
        All motions of the camera between keyframes; they become edges when the mounting is known.
    result
        The latest estimate.
    """

    start: gtsam.Pose3 | None
    steps: list[KeyframeStep] = field(default_factory=list)
    result: ExtrinsicsResult | None = None
    _pairs: list[MotionPair] = field(default_factory=list)

    @property
    def T_base_camera(self) -> gtsam.Pose3 | None:
        """Return the mounting, once it is certain; None before."""
        return self.result.T_base_camera if self.result is not None and _confident(self.result) else None

    def add(self, step: KeyframeStep, base: Motion | None) -> None:
        """Add a motion between keyframes, with that of the base if lidar or wheel odometry measured it."""
        self.steps.append(step)
        if base is None:
            return
        self._pairs.append(
            MotionPair(pose2_from_row(base.pose), base.covariance, step.motion, step.covariance)
        )
        if len(self._pairs) % FEWEST == 0:
            self.estimate()

    def estimate(self) -> None:
        """Estimate again from all pairs so far."""
        if len(self._pairs) >= FEWEST:
            self.result = estimate_extrinsics(self._pairs, self.start)

    def note(self, camera: str) -> str:
        """Return the result in one line for the user."""
        if self.result is None:
            return f"{camera}: mounting unknown; {len(self._pairs)} motions are too few to estimate it"
        body = self.result.T_base_camera.compose(T_BODY_CAMERA.inverse())
        turn = np.degrees(body.rotation().rpy())
        text = (
            f"{camera}: mounting estimated from {len(self._pairs)} motions: "
            f"x {body.x():.3f} m, y {body.y():.3f} m, "
            f"yaw {turn[2]:.2f}, pitch {turn[1]:.2f}, roll {turn[0]:.2f} degrees"
        )
        if self.result.unobservable:
            text += f"; not observable: {', '.join(self.result.unobservable)}"
        return text if _confident(self.result) else f"{text}; too uncertain, its motions were not used"


def _confident(result: ExtrinsicsResult) -> bool:
    """Return whether an estimate is certain enough for planar motion."""
    if not result.converged or result.inlier_share < 0.5:
        return False
    if any(direction in _PLANAR for direction in result.unobservable):
        return False
    rotation = result.T_base_camera.rotation().matrix()
    # The covariance is in the camera frame; the limits are in the base frame.
    turn = rotation @ result.covariance[:3, :3] @ rotation.T
    shift = rotation @ result.covariance[3:, 3:] @ rotation.T
    return bool(turn[2, 2] < _CONFIDENT_RAD**2 and max(shift[0, 0], shift[1, 1]) < _CONFIDENT_M**2)
