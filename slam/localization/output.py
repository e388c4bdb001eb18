"""What a localiser says after each measurement."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from slam.measurements import FloatArray, Pose, one_line


class State(StrEnum):
    """What a localiser knows.

    SEARCHING: not where the robot is; the hypotheses are listed. TRACKING: the pose. LOST: it knew, but what
    is seen no longer fits, or nothing has confirmed the pose for long; the pose is dead reckoning. So it
    begins where it was told the start, until what is seen confirms that.

    Examples
    --------
    >>> import slam
    >>> slam.State("tracking") is slam.State.TRACKING, list(map(str, slam.State))
    (True, ['searching', 'tracking', 'lost'])
    """

    SEARCHING = "searching"
    TRACKING = "tracking"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """A pose that may be the robot's, and how likely it is that it is."""

    pose: Pose
    probability: float


@dataclass(frozen=True, slots=True)
class RecoveredPose:
    """Where the robot had been at an earlier measurement, as it is known now."""

    stamp_s: float
    pose: Pose


@dataclass(frozen=True, slots=True)
class LocalizerOutput:
    """The localiser after one measurement.

    Attributes
    ----------
    stamp_s
        Of the measurement.
    state
        What is known.
    pose
        ``T_map_base``; None while searching.
    covariance
        (d, d) in GTSAM's tangent order, base frame; None while searching.
    confidence
        0..1: probability that ``pose`` is right; while searching, that of the likeliest hypothesis.
    hypotheses
        While searching or lost, the likeliest first.
    support
        Share of the measurement that the map explains; NaN where that was not asked.
    recovered
        Poses of earlier measurements that this one has made known, oldest first.

    Examples
    --------
    >>> import gtsam, numpy as np, slam
    >>> pose, covariance = gtsam.Pose2(1.0, 2.0, 0.0), 1e-4 * np.eye(3)
    >>> output = slam.LocalizerOutput(0.1, slam.State.TRACKING, pose, covariance, 0.98, (), 0.9)
    >>> if output.state is slam.State.TRACKING:
    ...     print(output.pose.x(), np.sqrt(np.diag(output.covariance))[:2])  # metres
    1.0 [0.01 0.01]
    """

    stamp_s: float
    state: State
    pose: Pose | None
    covariance: FloatArray | None
    confidence: float
    hypotheses: tuple[PoseHypothesis, ...]
    support: float
    recovered: tuple[RecoveredPose, ...] = ()

    __repr__ = one_line
