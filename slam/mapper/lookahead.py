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
from slam.forked import Forked, Send, is_core_free
from slam.graph.edge import Edge, EdgeKind
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.planar_odometry import Moment, PlanarOdometry, Step
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
    """The copy ended, or sent another scan than expected: the run starts again without it."""


class Ahead:
    """Results of the copy, read in log order; see `slam.mapper.planar_odometry.Steps`."""

    def __init__(self, receive: Callable[[], bytes | None], checkpoint: Checkpoint) -> None:
        self._receive, self._checkpoint = receive, checkpoint
        self._step: Step | None = None

    def observe(self, measurement: Any) -> Moment | None:
        """Process the next measurement; return the pose of the robot, if it is a scan.

        Raises
        ------
        LostError
            If the copy does not send it.
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
            moved, edges, points, normals, visible = step
            # From `_plain` values.
            restored = [
                Edge(a, b, T_a_b, spread, EdgeKind(kind), sure) for a, b, T_a_b, spread, kind, sure in edges
            ]
            self._step = Step(moved, restored, OrientedPoints(points, normals), visible)
        return Moment(stamp_s, measurement, pose, motion, step is not None)

    def step(self, key: int) -> Step:
        """Return what the newest moment adds to the map."""
        assert self._step is not None
        return self._step

    def followed_by(self, odometry: PlanarOdometry) -> Ahead:
        """Let the path of these moments adopt at the end what the copy has learned; return self."""
        self._odometry = odometry
        return self

    def end(self) -> None:
        """Finish at the end of the log.

        Raises
        ------
        LostError
            If the copy does not send it.
        """
        self._odometry.take_over(pickle.loads(self._next()))  # sent by our own copy

    def _next(self) -> bytes:
        """Return the next message of the copy."""
        content = self._receive()
        if content is None:
            raise LostError
        return content


class Lookahead:
    """Tracks scans or camera frames ahead of the mapper on a free core; not for 3D lidars.

    Parameters
    ----------
    checkpoint
        Checkpoint of the run, which stores the results.

    Attributes
    ----------
    ahead
        Results for scans; None if it tracks no scans.
    """

    def __init__(self, dataset: Dataset, odometries: Odometries, checkpoint: Checkpoint) -> None:
        self._dataset, self._odometries, self._checkpoint = dataset, odometries, checkpoint
        self._copy: Forked | None = None
        self.ahead: Ahead | None = None

    def __enter__(self) -> Lookahead:
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
        """Start the copy with these settings, if that is useful and it does not run yet.

        The copy also registers colour cameras, unless their pose is known.
        """
        if self._copy is not None or not is_core_free() or not self._checkpoint.is_kept:
            return
        if choice.cloud or self._checkpoint.replaying:
            return
        if not choice.cameras:
            self._copy = Forked(lambda send: self._track_scans(config, choice, send))
            self.ahead = Ahead(self._copy.receive, self._checkpoint)
            return

        def work(send: Send) -> None:
            """Run in the copy."""
            checkpoint = self._checkpoint.sending(send)
            registered = known
            if registered is None:
                registered = checkpoint.registrations(lambda: registrations(choice.cameras))
            self._track_frames(config, choice, registered, checkpoint)

        self._copy = Forked(work)
        self._checkpoint.ahead = self._copy.receive

    def _track_scans(self, config: Config, choice: SensorChoice, send: Send) -> None:
        """Track and send the path of a robot without cameras."""
        answers = _Answers()
        odometry, key = PlanarOdometry(config, answers, self._odometries), 0
        for measurement in choice.used(self._dataset):
            # The front end never gets the measurements of registered sensors.
            moment = None if type(measurement) in SENSORS else odometry.observe(measurement)
            if moment is None:
                continue
            step = None
            if moment.new_keyframe:
                stepped = odometry.step(key)
                odometry.readings.mark_keyframe()
                edges = [_plain(edge) for edge in stepped.edges]
                step = stepped.step, edges, stepped.surface.points, stepped.surface.normals, stepped.seen
                key += 1
            # A match is sent once, as the number of its result.
            which = (n for n, (_, _, answer) in enumerate(answers.found) if answer is moment.motion)
            motion = None if moment.motion is None else next(which, moment.motion)
            send(pack((moment.stamp_s, moment.pose, motion, answers.found, step)))
            answers.found = []
        send(pickle.dumps(odometry.learned(), pickle.HIGHEST_PROTOCOL))

    def _track_frames(
        self, config: Config, choice: SensorChoice, known: Mapping[str, ColorRegistration], cache: ResultCache
    ) -> None:
        """Track each camera, independently of all else."""
        matcher = self._odometries.rgbd(config) if choice.spatial else FrameMatcher(config)
        trackers = dict[str, RgbdTracker]()
        for frame in prefetched(choice.used(self._dataset), FramePreparer(config.rgbd, known)):
            if not isinstance(frame, PreparedFrame):
                continue
            name = frame.frame.sensor
            if name not in trackers:
                if choice.spatial and trackers:
                    continue  # in 3D only the first is used
                trackers[name] = RgbdTracker(matcher, config, cache)
            tracked = trackers[name].track(frame)
            if tracked.new_keyframe:
                trackers[name].add_keyframe(frame, tracked)

    def stop(self) -> None:
        """Stop the copy; this process computes the rest."""
        self._checkpoint.ahead = None
        if self._copy is not None:
            self._copy.close()
        self._copy = self.ahead = None


class _Answers:
    """Computed results, as a checkpoint stores them; see `slam.result_cache.ResultCache`."""

    def __init__(self) -> None:
        self.found: list[tuple[str, float, Any]] = []

    def cached(self, question: str, key: float, compute: Callable[[], T]) -> T:
        """Compute the result, and store it."""
        answer = compute()
        self.found.append((question, float(key), answer))
        return answer


def _plain(edge: Edge) -> tuple[Any, ...]:
    """Return an edge as plain values, in the order of its fields."""
    return edge.source, edge.target, edge.T_source_target, edge.covariance, edge.kind, edge.trusted
