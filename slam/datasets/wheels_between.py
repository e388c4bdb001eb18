"""Interpolates wheel odometry between two readings."""

from __future__ import annotations

from collections import deque

import gtsam

from slam.measurements import WheelOdometry

WHEELS_KEPT = 400  # readings that are kept for interpolation
_LONGEST_STEP_S = 0.5  # between two readings; motion in a longer interval is unknown


def wheels_at(readings: deque[WheelOdometry], stamp_s: float) -> WheelOdometry | None:
    """Interpolated wheel odometry, as tf does it; None at a reading, or without one on either side."""
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
