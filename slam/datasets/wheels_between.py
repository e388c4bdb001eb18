"""The wheels at a moment between two of their readings."""

from __future__ import annotations

from collections import deque

import gtsam

from slam.measurements import WheelOdometry

WHEELS_KEPT = 400  # readings that are worth keeping to ask
_LONGEST_STEP_S = 0.5  # between two readings; what a robot did in a longer one is not known


def wheels_at(readings: deque[WheelOdometry], stamp_s: float) -> WheelOdometry | None:
    """The wheels between two readings, as tf tells them; None at a reading, or without one on either side."""
    after: WheelOdometry | None = None
    for before in reversed(readings):
        if before.stamp_s == stamp_s:
            return None
        if before.stamp_s < stamp_s:
            if after is None or after.stamp_s - before.stamp_s > _LONGEST_STEP_S:
                return None
            share = (stamp_s - before.stamp_s) / (after.stamp_s - before.stamp_s)
            step = gtsam.Pose2.Logmap(before.T_odom_base.between(after.T_odom_base))
            pose = before.T_odom_base.compose(gtsam.Pose2.Expmap(share * step))
            return WheelOdometry(stamp_s, pose, before.sensor)
        after = before
    return None
