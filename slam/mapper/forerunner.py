"""Track a planar robot, or cameras, ahead of the run in a copy of this process.

The odometry does not depend on loops, and nothing depends on how long a result takes. So a copy tracks the
scans from the first one while the doctor still checks the log, and the run builds the map from them in
parallel. The copy sends each pose, what a keyframe adds to the map, and the results with which an interrupted
run resumes; at the end it sends what was learned about the sensors. If there are cameras, only their frames
are matched ahead; the run uses these results when it reaches the frames.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, TypeVar

from slam.config import Config
from slam.datasets.dataset import Dataset
from slam.datasets.sensor_choice import SensorChoice
from slam.doctor.diagnosis import Registrations
from slam.forked import Forked, Tell, is_core_free
from slam.graph.edge import Edge, EdgeKind
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.planar_way import Moment, PlanarWay, Step
from slam.mapper.protocol import SENSORS
from slam.matching.local_map import OrientedPoints
from slam.measurements import LaserScan
from slam.odometry import Odometries
from slam.odometry.rgbd_tracker import RgbdTracker
from slam.result_cache import ResultCache
from slam.storage.packing import pack, unpack
from slam.vision.color_registration import ColorRegistration
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prefetch import prefetched
from slam.vision.prepared_frame import FramePreparer, PreparedFrame

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
            If the copy does not tell.
        """
        if not isinstance(measurement, LaserScan):
            return None
        stamp_s, pose, motion, answers, step = unpack(self._next())
        if stamp_s != measurement.stamp_s:
            raise LostError
        for answer in answers:
            self._checkpoint.keep(pack(answer))
        if isinstance(motion, int):
            motion = answers[motion][2]
        if step is not None:
            moved, edges, points, normals, seen = step
            # Of `_plain` values.
            told = [
                Edge(a, b, T_a_b, spread, EdgeKind(kind), sure) for a, b, T_a_b, spread, kind, sure in edges
            ]
            self._step = Step(moved, told, OrientedPoints(points, normals), seen)
        return Moment(stamp_s, measurement, pose, motion, step is not None)

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
            If the copy does not tell.
        """
        self._way.take_over(pickle.loads(self._next()))  # it is our own copy that has sent it

    def _next(self) -> bytes:
        """The next that it has sent."""
        content = self._receive()
        if content is None:
            raise LostError
        return content


class Forerunner:
    """Tracks scans, or the frames of cameras, ahead of the mapper, where a core is free; no 3D lidars.

    Parameters
    ----------
    checkpoint
        Of the run, which takes the answers.

    Attributes
    ----------
    ahead
        What it finds of scans; None if it does not track any.
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

    def start(
        self,
        config: Config,
        choice: SensorChoice,
        registrations: Registrations,
        known: Mapping[str, ColorRegistration] | None = None,
    ) -> None:
        """Run ahead by these settings, if that is of use, and it does not yet.

        Where colour cameras sit is found there, too, unless it is known.
        """
        if self._copy is not None or not is_core_free() or not self._checkpoint.is_kept:
            return
        if choice.cloud or self._checkpoint.replaying:
            return
        if not choice.cameras:
            self._copy = Forked(lambda tell: self._track_scans(config, choice, tell))
            self.ahead = Ahead(self._copy.receive, self._checkpoint)
            return

        def work(tell: Tell) -> None:
            """What the copy does."""
            checkpoint = self._checkpoint.telling(tell)
            found = known
            if found is None:
                found = checkpoint.registrations(lambda: registrations(choice.cameras))
            self._track_frames(config, choice, found, checkpoint)

        self._copy = Forked(work)
        self._checkpoint.ahead = self._copy.receive

    def _track_scans(self, config: Config, choice: SensorChoice, tell: Tell) -> None:
        """Tell the way of a robot that has no cameras."""
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
            # A match is told once: as the number of the answer that it is.
            which = (n for n, (_, _, answer) in enumerate(answers.found) if answer is moment.motion)
            motion = None if moment.motion is None else next(which, moment.motion)
            tell(pack((moment.stamp_s, moment.pose, motion, answers.found, step)))
            answers.found = []
        tell(pickle.dumps(way.learned(), pickle.HIGHEST_PROTOCOL))

    def _track_frames(
        self, config: Config, choice: SensorChoice, known: Mapping[str, ColorRegistration], cache: ResultCache
    ) -> None:
        """Track each camera, which depends on nothing else."""
        matcher = self._odometries.rgbd(config) if choice.spatial else FrameMatcher(config)
        trackers = dict[str, RgbdTracker]()
        for frame in prefetched(choice.used(self._dataset), FramePreparer(config.rgbd, known)):
            if not isinstance(frame, PreparedFrame):
                continue
            name = frame.frame.sensor
            if name not in trackers:
                if choice.spatial and trackers:
                    continue  # in space only the first is used
                trackers[name] = RgbdTracker(matcher, config, cache)
            tracked = trackers[name].track(frame)
            if tracked.new_keyframe:
                trackers[name].add_keyframe(frame, tracked)

    def stop(self) -> None:
        """Find all else here."""
        self._checkpoint.ahead = None
        if self._copy is not None:
            self._copy.close()
        self._copy = self.ahead = None


class _Answers:
    """What took time, as a checkpoint keeps it; see `slam.result_cache.ResultCache`."""

    def __init__(self) -> None:
        self.found: list[tuple[str, float, Any]] = []

    def cached(self, question: str, key: float, compute: Callable[[], T]) -> T:
        """Compute it, and note it."""
        answer = compute()
        self.found.append((question, float(key), answer))
        return answer


def _plain(edge: Edge) -> tuple[Any, ...]:
    """An edge as plain values, in the order of its fields."""
    return edge.source, edge.target, edge.T_source_target, edge.covariance, edge.kind, edge.trusted
