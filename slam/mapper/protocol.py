"""What the main loop knows of sensors: one leads and says where the robot is, others stand beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from slam.config import Config
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
    """A moment at which it is known where the robot is.

    Attributes
    ----------
    stamp_s
        As the log has it.
    motion
        The match that told it; None where nothing matched, and for the first.
    new_keyframe
        Whether the robot has moved on enough.
    match
        Of a camera's frame: the whole match.
    """

    stamp_s: float
    motion: MotionEstimate | None
    new_keyframe: bool
    match: VisualMatch | None = None


class FrontEnd(Protocol):
    """The sensor that leads, with those that it asks for help.

    Attributes
    ----------
    readings
        Of the log so far, with their poses in the odometry frame.
    tags
        Looks for tags in the images of its keyframes.
    """

    readings: Readings
    tags: TagFinder

    def observe(self, measurement: Any) -> Tracked | None:
        """Take the next measurement; where the robot is then, if it tells that."""
        ...

    def origin(self) -> Pose:
        """Pose of the first node in the map, Pose2 or Pose3, once a first moment was tracked."""
        ...

    def step(self, key: int) -> tuple[Pose, Sequence[Edge]]:
        """Motion from the last keyframe to the newest moment, to be keyframe ``key``, and its edges."""
        ...

    def recognise(self, key: int, graph: KeyframeGraph) -> Iterable[LoopCandidate]:
        """Remember keyframe ``key``, and try the places that it may have come back to."""
        ...

    def refuse(self) -> None:
        """Raise a `slam.errors.DatasetError` where all that was seen is no map."""
        ...

    def settle(self, graph: KeyframeGraph) -> None:
        """Say anew what the whole run has shown, before the final optimisation."""
        ...

    def search_again(self, graph: KeyframeGraph, kept: BoolArray) -> list[LoopCandidate]:
        """Places recognised from the estimate of the final optimisation, which has ``kept`` these edges.

        None as a rule: all places were tried while mapping.
        """
        return []

    def bases(self, poses: Sequence[Pose]) -> Sequence[Pose]:
        """``T_map_base`` of every node, by the nodes' poses, which are those of the bases as a rule."""
        return poses

    def complete(self, result: MapResult) -> None:
        """Make of the final poses what else the map has, and tell what people should know of it."""
        ...

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Where cameras sit that the log does not tell, as far as this run has shown; none as a rule."""
        return {}


class Sensor(Protocol):
    """A sensor beside the one that leads: it adds what it knows to the graph, and may be overruled."""

    def observe(self, measurement: Any) -> None:
        """Take the next measurement of its kind."""
        ...

    def factors(self, key: int, stamp_s: float) -> Iterable[Edge]:
        """What it knows of a new keyframe and those before it."""
        ...

    def notes(self) -> list[str]:
        """One line each, for people."""
        ...


SENSORS: dict[type, Callable[[Config], Sensor]] = {}


def register_sensor(kind: type, make: Callable[[Config], Sensor]) -> None:
    """Let measurements of another kind reach a sensor of one's own.

    Parameters
    ----------
    kind
        Type of its measurements, which have ``stamp_s`` (seconds) and ``sensor`` (a name).
    make
        Given the configuration, the sensor of a new run: ``observe(measurement)`` takes what comes,
        ``factors(key, stamp_s)`` gives `slam.Edge`s of a kind of its own when keyframe ``key`` is made, from
        earlier ones (none for the first), ``notes()`` what people
        should know.

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
    SENSORS[kind] = make
