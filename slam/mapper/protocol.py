"""Interface of sensors to the main loop: one leads and tracks the robot, others add factors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from slam.config import Config
from slam.errors import ScanweaveError
from slam.estimates import MotionEstimate
from slam.graph.edge import Edge
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.map_result import MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.tags import TagFinder
from slam.measurements import BoolArray, Pose
from slam.trajectory.readings import Readings
from slam.vision.visual_match import VisualMatch


@dataclass(frozen=True, slots=True)
class Tracked:
    """A time at which the pose of the robot is known.

    Attributes
    ----------
    motion
        The match that gave the pose; None if nothing matched, and for the first.
    new_keyframe
        Whether the robot has moved far enough for a keyframe.
    match
        The whole match of a camera frame.
    """

    stamp_s: float
    motion: MotionEstimate | None
    new_keyframe: bool
    match: VisualMatch | None = None


class FrontEnd(Protocol):
    """The leading sensor, with the sensors that support it.

    Attributes
    ----------
    readings
        Readings of the log so far, with their poses in the odometry frame.
    tags
        Detector of tags in the images of its keyframes.
    """

    readings: Readings
    tags: TagFinder

    def observe(self, measurement: Any) -> Tracked | None:
        """Process the next measurement; return the tracked pose, if it gives one."""
        ...

    def origin(self) -> Pose:
        """Return the pose of the first node in the map, Pose2 or Pose3, once a first pose was tracked."""
        ...

    def step(self, key: int) -> tuple[Pose, Sequence[Edge]]:
        """Return the motion from the last keyframe to the new keyframe ``key``, and its edges."""
        ...

    def recognise(self, key: int, graph: KeyframeGraph) -> Iterable[LoopCandidate]:
        """Store keyframe ``key``, and try to close loops with places it may have returned to."""
        ...

    def refuse(self) -> None:
        """Raise a `slam.errors.DatasetError` if the data are not enough for a map."""
        ...

    def settle(self, graph: KeyframeGraph) -> None:
        """Revise edges by what the whole run has shown, before the final optimisation."""
        ...

    def search_again(self, graph: KeyframeGraph, kept: BoolArray) -> list[LoopCandidate]:
        """Search for loops from the estimate of the final optimisation, which has ``kept`` these edges.

        Usually there are none: all places were tried during mapping.
        """
        return []

    def bases(self, poses: Sequence[Pose]) -> Sequence[Pose]:
        """Return ``T_map_base`` of every node from the node poses, which usually are those of the bases."""
        return poses

    def complete(self, result: MapResult) -> None:
        """Create the rest of the map from the final poses, and return notes for the user."""
        ...

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Return camera mountings that the log lacks and this run estimated; usually none."""
        return {}


class Sensor(Protocol):
    """A sensor besides the leading one: it adds edges to the graph, which may be rejected."""

    def observe(self, measurement: Any) -> None:
        """Process the next measurement of its kind."""
        ...

    def factors(self, key: int, stamp_s: float) -> Iterable[Edge]:
        """Return the edges between a new keyframe and earlier ones."""
        ...

    def notes(self) -> list[str]:
        """Return notes for the user, one line each."""
        ...


SENSORS: dict[type, Callable[[Config], Sensor]] = {}


def register_sensor(kind: type, make: Callable[[Config], Sensor]) -> None:
    """Register a sensor of your own for a new type of measurement.

    Parameters
    ----------
    kind
        Type of its measurements, which have ``stamp_s`` (seconds) and ``sensor`` (a name).
    make
        Function that takes the configuration and returns the sensor for a new run. The sensor has three
        methods: ``observe(measurement)`` takes a measurement; ``factors(key, stamp_s)`` is called for each
        new keyframe ``key`` and returns `slam.Edge`s from earlier ones, of a kind of its own (none for the
        first); ``notes()`` returns lines for the user.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> import slam
    >>> @dataclass
    ... class Bump:
    ...     stamp_s: float
    ...     sensor: str = "bumper"
    >>> class Bumper:
    ...     def __init__(self, config):
    ...         self.bumps = 0
    ...     def observe(self, measurement):
    ...         self.bumps += 1
    ...     def factors(self, key, stamp_s):
    ...         return []
    ...     def notes(self):
    ...         return [f"{self.bumps} bumps"]
    >>> slam.register_sensor(Bump, Bumper)
    """
    if not isinstance(kind, type) or not callable(make):
        raise ScanweaveError(
            f"{kind!r} and {make!r}: give the class of the measurements, and one of the sensor"
        )
    SENSORS[kind] = make
