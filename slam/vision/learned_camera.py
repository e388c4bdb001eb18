"""What a run learned about a camera, so that a later run with the same camera need not learn it again."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam

from slam.vision.color_registration import ColorRegistration


@dataclass(frozen=True, slots=True)
class LearnedCamera:
    """A camera as a finished run knows it.

    Attributes
    ----------
    registration
        Where its colour camera sits beside the depth camera; None if that was not asked.
    T_base_camera
        Its mounting, as the log reported it or as it was learned; None if it is its own base, or unknown.
    mounting_learned
        Whether the mounting was learned from the motions of camera and robot.
    clock_offset_s, clock_sigma_s
        The camera's stamps less the robot's for the same instant, and the standard deviation that is left
        between two of their stamps once the offset is taken off.
    """

    registration: ColorRegistration | None = None
    T_base_camera: gtsam.Pose3 | None = None
    mounting_learned: bool = False
    clock_offset_s: float = 0.0
    clock_sigma_s: float = 0.0
