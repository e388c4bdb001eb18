"""Protocol between a localisation sensor and the state machine."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from slam.config.localization import LocalizationConfig
from slam.estimates import MotionEstimate
from slam.localization.poses import Measured, apart
from slam.measurements import Pose, composed, motion_between

V = TypeVar("V")
N = TypeVar("N")


@dataclass(frozen=True, slots=True)
class Observation(Generic[V]):
    """A reading, and how the robot came to where it was taken.

    Attributes
    ----------
    stamp_s
        Time of the reading.
    view
        The reading, prepared once.
    pose
        ``T_odom_base``; None if the odometry does not tell.
    moved
        Motion since the last reading; None if not even dead reckoning leads on from there.
    restarted
        Whether the odometry frame has begun anew.
    """

    stamp_s: float
    view: V
    pose: Pose | None
    moved: Measured | None
    restarted: bool


@dataclass(frozen=True, slots=True)
class Keyframe(Generic[N]):
    """A localisation keyframe: a reading of the path that is weighed.

    Attributes
    ----------
    pose
        ``T_odom_base``.
    travelled_m
        Path up to here.
    novel
        What no earlier keyframe had seen.
    """

    pose: Pose
    travelled_m: float
    novel: N


def moved_on(before: Pose | None, pose: Pose, config: LocalizationConfig) -> bool:
    """Whether ``T_odom_base`` is far enough from an earlier one to see anew."""
    return before is None or anew(motion_between(before, pose), config) >= 1.0


def anew(step: Pose, config: LocalizationConfig) -> float:
    """Share of what is seen after a motion that was not before it: all, after that between two keyframes."""
    apart_m, turned_rad = apart(composed(step, step.inverse()), step)
    return min(max(apart_m / config.keyframe_m, turned_rad / config.keyframe_rad), 1.0)


class Sensor(Protocol[V, N]):
    """A sensor in a known map; V is a prepared reading, N what of it is novel.

    Attributes
    ----------
    search_every_m
        Path between two searches of the whole map.
    weighs_back
        A pose that is newly proposed is weighed by so many earlier keyframes.
    least_keyframes
        So many must agree before a pose is believed, or is hopeless: somebody may stand before the sensor.
    """

    search_every_m: float
    weighs_back: int
    least_keyframes: int

    def observe(self, measurement: Any, known: Pose | None) -> Observation[V] | None:
        """Take a reading; None of one that is only kept, or not used.

        Parameters
        ----------
        known
            ``T_map_base`` at the last reading, while it is tracked.
        """
        ...

    def sees_anew(self, view: V, before: Pose | None, pose: Pose) -> bool:
        """Whether a reading at ``T_odom_base`` should be a keyframe after one at an earlier pose."""
        ...

    def novel(self, view: V, pose: Pose, before: Sequence[Keyframe[N]] | None) -> N:
        """What a reading at ``T_odom_base`` sees that earlier keyframes did not; None asks for all of it."""
        ...

    def align(self, view: V, guess: Pose) -> MotionEstimate | None:
        """``T_map_base`` from a guess nearby; None if nothing can be aligned."""
        ...

    def weigh(self, pose: Pose, novel: N, motion: MotionEstimate | None) -> float:
        """Evidence for ``T_map_base`` over the best of the wrong poses, nats.

        Parameters
        ----------
        motion
            The alignment that was believed there; None without one.
        """
        ...

    def propose(
        self, view: V, keyframes: Sequence[Keyframe[N]], within: Measured | None
    ) -> Iterable[Pose | None]:
        """``T_map_base`` of every place of the newest keyframe; None if a reading has waited enough.

        Parameters
        ----------
        within
            Where dead reckoning leaves it, places elsewhere being of no use; None if it may be anywhere.
        """
        ...
