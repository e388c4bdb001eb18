"""What readers of phones share: the axes of ARKit, and how its poses are told of."""

from __future__ import annotations

import gtsam
import numpy as np

# ARKit's camera has x right, y up and looks along -z; an optical frame y down and z forward.
T_ARKIT_OPTICAL = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
COMPARED = "the phone's own tracking is only compared with"
