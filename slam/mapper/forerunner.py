"""A planar robot's way found ahead, in a copy of this process: the run makes the map of it meanwhile.

No scan's pose by odometry depends on a loop, and nothing depends on how long an answer takes. So a copy
tracks the scans from the first on while the doctor still looks at the log. It sends each pose, and what a
keyframe adds to the map, with the answers that an interrupted run goes on from; at the end what it has
learned of the sensors.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from types import TracebackType
from typing import Any, TypeVar

from slam.config import Config
from slam.datasets.dataset import Dataset
from slam.datasets.sensor_choice import SensorChoice
from slam.forked import Forked, Tell, is_core_free
from slam.graph.edge import Edge, EdgeKind
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.planar_way import Moment, PlanarWay, Step
from slam.mapper.protocol import SENSORS
from slam.matching.local_map import OrientedPoints
from slam.measurements import FloatArray, LaserScan, Pose
from slam.odometry import Odometries
from slam.storage.packing import pack, unpack

T = TypeVar("T")


class LostError(Exception):
    """The copy tells nothing more, or of another scan than asked: the run begins anew, alone."""


class Ahead:
    """What a copy finds, asked for in the order of the log; see `slam.mapper.planar_way.Steps`."""

    def __init__(self, receive: Callable[[], bytes | None], checkpoint: Checkpoint) -> None:
        self._receive, self._checkpoint = receive, checkpoint
        self._step: Step | None = None

    def observe(self, measurement: Any) -> Moment | None:
        """Take the next measurement; where the robot is then, if it is a scan.

        Raises
        ------
        LostError
            Where the copy does not tell.
        """
        if not isinstance(measurement, LaserScan):
            return None
        stamp_s, pose, motion, answers, step = unpack(self._next())
        if stamp_s != measurement.stamp_s:
            raise LostError
        for answer in answers:
            self._checkpoint.keep(answer)
        if step is not None:
            moved, edges, points, normals, seen = step
            self._step = Step(moved, [_edge(*edge) for edge in edges], OrientedPoints(points, normals), seen)
        return Moment(stamp_s, measurement, pose, motion, step is not None, {})

    def step(self, key: int) -> Step:
        """What the newest moment adds to the map."""
        assert self._step is not None
        return self._step

    def followed_by(self, way: PlanarWay) -> Ahead:
        """Let a way, whose moments these are, take over in the end what the copy has learned; itself."""
        self._way = way
        return self

    def end(self) -> None:
        """The log has ended.

        Raises
        ------
        LostError
            Where the copy does not tell.
        """
        self._way.take_over(pickle.loads(self._next()))  # it is our own copy that has sent it

    def _next(self) -> bytes:
        """The next that it has sent."""
        content = self._receive()
        if content is None:
            raise LostError
        return content


class Forerunner:
    """Tracks a planar robot's scans ahead of its mapper, where a core is free; without cameras.

    Parameters
    ----------
    checkpoint
        Of the run, which takes the answers.

    Attributes
    ----------
    ahead
        What it finds; None where it does not run.
    """

    def __init__(self, dataset: Dataset, odometries: Odometries, checkpoint: Checkpoint) -> None:
        self._dataset, self._odometries, self._checkpoint = dataset, odometries, checkpoint
        self._copy: Forked | None = None
        self.ahead: Ahead | None = None

    def __enter__(self) -> Forerunner:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def start(self, config: Config) -> None:
        """Run ahead by these settings, if that is of use, and it does not yet."""
        if self._copy is not None or not is_core_free() or not self._checkpoint.is_kept:
            return
        choice = SensorChoice.of(self._dataset, config.sensors)
        if choice.cameras or choice.cloud or choice.spatial:
            return

        def work(tell: Tell) -> None:
            """What the copy does."""
            answers = _Answers()
            way, key = PlanarWay(config, answers, self._odometries), 0
            for measurement in choice.used(self._dataset):
                # What a registered sensor takes, the front end never sees.
                moment = None if type(measurement) in SENSORS else way.observe(measurement)
                if moment is None:
                    continue
                step = None
                if moment.new_keyframe:
                    found = way.step(key)
                    way.readings.mark_keyframe()
                    edges = [_plain(edge) for edge in found.edges]
                    step = found.step, edges, found.surface.points, found.surface.normals, found.seen
                    key += 1
                tell(pack((moment.stamp_s, moment.pose, moment.motion, answers.found, step)))
                answers.found = []
            tell(pickle.dumps(way.learned(), pickle.HIGHEST_PROTOCOL))

        self._copy = Forked(work)
        self.ahead = Ahead(self._copy.receive, self._checkpoint)

    def stop(self) -> None:
        """Find all else here."""
        if self._copy is not None:
            self._copy.close()
        self._copy = self.ahead = None


class _Answers:
    """What took time, as a checkpoint keeps it; see `slam.result_cache.ResultCache`."""

    def __init__(self) -> None:
        self.found: list[bytes] = []

    def cached(self, question: str, key: float, compute: Callable[[], T]) -> T:
        """Compute it, and note it."""
        answer = compute()
        self.found.append(pack((question, float(key), answer)))
        return answer


def _edge(
    source: int, target: int, T_source_target: Pose, covariance: FloatArray, kind: str, trusted: bool
) -> Edge:
    """An edge of `_plain` values."""
    return Edge(source, target, T_source_target, covariance, EdgeKind(kind), trusted)


def _plain(edge: Edge) -> tuple[Any, ...]:
    """An edge as plain values, in the order of its fields."""
    return edge.source, edge.target, edge.T_source_target, edge.covariance, edge.kind, edge.trusted
