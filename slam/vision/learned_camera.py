"""What a run learned about a camera, so that a later run with the same camera need not learn it again."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from slam.vision.color_registration import ColorRegistration


@dataclass(frozen=True, slots=True)
class LearnedCamera:
    """A camera as estimated by a finished run.

    Attributes
    ----------
    registration
        Pose of its colour camera relative to the depth camera; None if it was not estimated.
    T_base_camera
        Its mounting, from the log or as estimated; None if it is its own base, or unknown.
    mounting_learned
        Whether the mounting was estimated from the motions of camera and robot.
    clock_offset_s, clock_sigma_s
        The camera's stamps minus the robot's for the same instant, and the standard deviation between two of
        their stamps after correction.
    """

    registration: ColorRegistration | None = None
    T_base_camera: gtsam.Pose3 | None = None
    mounting_learned: bool = False
    clock_offset_s: float = 0.0
    clock_sigma_s: float = 0.0
