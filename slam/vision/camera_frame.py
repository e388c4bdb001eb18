"""Optical frame of a camera relative to its body frame."""

from __future__ import annotations

import gtsam
import numpy as np

from fusion.curves import FORWARD

# Body frame: x forward, z up; optical frame: z forward, x right, y down.
T_BODY_CAMERA = gtsam.Pose3(gtsam.Rot3(FORWARD), np.zeros(len(FORWARD)))
