"""Protocol between a localisation sensor and the state machine."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from slam.config.localization import LocalizationConfig
from slam.estimates import MotionEstimate
from slam.localization.poses import Measured, separation
from slam.measurements import FloatArray, Pose, composed, motion_between

V = TypeVar("V")
N = TypeVar("N")


@dataclass(frozen=True, slots=True)
class Observation(Generic[V]):
    """A reading, and the motion of the robot to its pose.

    Attributes
    ----------
    view
        The reading, prepared once.
    pose
        ``T_odom_base``; None if the odometry does not know it.
    moved
        Motion since the last reading; None if not even dead reckoning is possible.
    restarted
        Whether a new odometry frame has started.
    late
        (d,) motion within the sigma of its stamp, GTSAM's tangent of the base; 0 if the stamp is exact.
    """

    stamp_s: float
    view: V
    pose: Pose | None
    moved: Measured | None
    restarted: bool
    late: FloatArray | float = 0.0


@dataclass(frozen=True, slots=True)
class Keyframe(Generic[N]):
    """A localisation keyframe: a reading of the path that weights the hypotheses.

    Attributes
    ----------
    pose
        ``T_odom_base``.
    travelled_m
        Path length up to here.
    novel
        The part that no earlier keyframe has seen.
    """

    pose: Pose
    travelled_m: float
    novel: N


def moved_on(before: Pose | None, pose: Pose, config: LocalizationConfig) -> bool:
    """Return whether ``T_odom_base`` is far enough from an earlier one to see something new."""
    return before is None or new_share(motion_between(before, pose), config) >= 1.0


def new_share(step: Pose, config: LocalizationConfig) -> float:
    """Return the share of a reading that is new after a motion: all after that between two keyframes."""
    apart_m, turned_rad = separation(composed(step, step.inverse()), step)
    return min(max(apart_m / config.keyframe_m, turned_rad / config.keyframe_rad), 1.0)


class Sensor(Protocol[V, N]):
    """A sensor in a known map; V is a prepared reading, N the new part of it.

    Attributes
    ----------
    search_every_m
        Path length between two searches of the whole map.
    weighs_back
        Number of earlier keyframes that weight a newly proposed pose.
    least_keyframes
        Number of keyframes that must agree to accept or drop a pose: a person may block the sensor.
    """

    search_every_m: float
    weighs_back: int
    least_keyframes: int

    def observe(self, measurement: Any, known: Pose | None) -> Observation[V] | None:
        """Process a reading; return None if it is only stored, or not used.

        Parameters
        ----------
        known
            ``T_map_base`` at the last reading, while it is tracked.
        """
        ...

    def sees_new(self, view: V, before: Pose | None, pose: Pose) -> bool:
        """Return whether a reading at ``T_odom_base`` should be a keyframe after one at an earlier pose."""
        ...

    def novel(self, view: V, pose: Pose, before: Sequence[Keyframe[N]] | None) -> N:
        """Return the part of a reading at ``T_odom_base`` that is new; ``before`` None returns all of it."""
        ...

    def align(self, view: V, guess: Pose) -> MotionEstimate | None:
        """Align to ``T_map_base`` from a near guess; return None if nothing can be aligned."""
        ...

    def weigh(self, pose: Pose, novel: N, motion: MotionEstimate | None) -> float:
        """Return the evidence for ``T_map_base`` over the best of the wrong poses, nats.

        Parameters
        ----------
        motion
            The accepted alignment there; None without one.
        """
        ...

    def propose(
        self, view: V, keyframes: Sequence[Keyframe[N]], within: Measured | None
    ) -> Iterable[Pose | None]:
        """Return ``T_map_base`` of all candidate places of the newest keyframe; None while searching.

        Parameters
        ----------
        within
            Pose by dead reckoning; places outside its covariance are not needed; None: anywhere.
        """
        ...
