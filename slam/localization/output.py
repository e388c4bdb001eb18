"""Output of a localiser after each measurement."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from slam.measurements import FloatArray, Pose, one_line


class State(StrEnum):
    """State of a localiser.

    SEARCHING: the pose is unknown; the hypotheses are listed. TRACKING: the pose is known. LOST: the pose was
    known, but the measurements no longer fit or have not confirmed it for long; it is now dead reckoning. A
    localiser with a given initial pose starts as LOST, until the measurements confirm that pose.

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
    """A possible pose of the robot, and its probability."""

    pose: Pose
    probability: float


@dataclass(frozen=True, slots=True)
class RecoveredPose:
    """Pose of the robot at an earlier measurement, known only now."""

    stamp_s: float
    pose: Pose


@dataclass(frozen=True, slots=True)
class LocalizerOutput:
    """Output of the localiser for one measurement.

    Attributes
    ----------
    stamp_s
        Time of the measurement.
    state
        Whether the pose is known.
    pose
        ``T_map_base``; None while searching.
    covariance
        (d, d) in GTSAM's tangent order, base frame; None while searching.
    confidence
        0..1: probability that ``pose`` is right; while searching, that of the most likely hypothesis.
    hypotheses
        While searching or lost: possible poses, the most likely first.
    support
        Share of the measurement that the map explains; NaN if not computed.
    recovered
        Poses of earlier measurements that became known with this one, oldest first.

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
