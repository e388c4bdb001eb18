"""The optical frame of a camera against its body."""

from __future__ import annotations

import math

import gtsam
import numpy as np

# A body that looks along x, its z up; the optical frame has z forward, x right, y down.
T_BODY_CAMERA = gtsam.Pose3(gtsam.Rot3.Ypr(-0.5 * math.pi, 0.0, -0.5 * math.pi), np.zeros(3))
