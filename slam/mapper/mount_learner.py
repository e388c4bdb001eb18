"""Estimate the pose of a camera on its robot during mapping, from the motions of both.

A robot on a floor does not show the height of its camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from slam.doctor.planar_hand_eye import PlanarHandEye, planar_hand_eye
from slam.matching.motion import Motion
from slam.measurements import FloatArray
from slam.vision.camera_frame import T_BODY_CAMERA

_CONFIDENT_RAD = math.radians(1.0)
_CONFIDENT_M = 0.03


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
        ``T_base_camera`` in the log, right or wrong; None if the log has none. Its height is used.
    steps
        All motions of the camera between keyframes; they become edges when the mounting is known.
    fit
        The latest estimate; None if the motions do not determine it.
    """

    start: gtsam.Pose3 | None
    steps: list[KeyframeStep] = field(default_factory=list)
    fit: PlanarHandEye | None = None
    _pairs: list[tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=list)

    @property
    def T_base_camera(self) -> gtsam.Pose3 | None:
        """Return the mounting, once it is certain; None before."""
        return self._mounting(self.fit) if self.fit is not None and self._is_certain(self.fit) else None

    def add(self, step: KeyframeStep, base: Motion | None) -> None:
        """Add a motion between keyframes, with that of the base if lidar or wheel odometry measured it."""
        self.steps.append(step)
        if base is None:
            return
        turn = gtsam.Rot3.Logmap(step.motion.rotation())
        self._pairs.append((turn, np.asarray(step.motion.translation()), base.pose))
        if len(self._pairs) % FEWEST == 0:
            self.estimate()

    def estimate(self) -> None:
        """Estimate again from all pairs so far."""
        if len(self._pairs) >= FEWEST:
            self.fit = planar_hand_eye(*map(np.array, zip(*self._pairs, strict=True)))

    def note(self, camera: str) -> str:
        """Return the result in one line for the user."""
        count = len(self._pairs)
        if self.fit is None:
            lack = "are too few to estimate it" if count < FEWEST else "without turns do not determine it"
            return f"{camera}: mounting unknown, its motions were not used; {count} of them {lack}"
        body = self._mounting(self.fit).compose(T_BODY_CAMERA.inverse())
        turn = np.degrees(body.rotation().rpy())
        text = (
            f"{camera}: mounting estimated from {count} motions: "
            f"x {body.x():.3f} m, y {body.y():.3f} m, "
            f"yaw {turn[2]:.2f}, pitch {turn[1]:.2f}, roll {turn[0]:.2f} degrees; not observable: height"
        )
        return text if self._is_certain(self.fit) else f"{text}; too uncertain, its motions were not used"

    def _mounting(self, fit: PlanarHandEye) -> gtsam.Pose3:
        """Return ``T_base_camera`` of a fit, at the height of the start."""
        axes = np.stack([fit.ahead, np.cross(fit.up, fit.ahead), fit.up])
        height_m = 0.0 if self.start is None else self.start.z()
        return gtsam.Pose3(gtsam.Rot3(axes), np.array([*fit.lever_m, height_m]))

    def _is_certain(self, fit: PlanarHandEye) -> bool:
        """Return whether a fit is certain enough for planar motion, and most pairs agree with it."""
        yaw_rad, lever_m = fit.sigmas[2], fit.sigmas[3:].max()
        agree = 2 * fit.count >= len(self._pairs)
        return bool(agree and yaw_rad < _CONFIDENT_RAD and lever_m < _CONFIDENT_M)
