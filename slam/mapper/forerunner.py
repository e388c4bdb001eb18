"""Scans and frames matched ahead, in a copy of this process: the run finds the answers when it comes to them.

No pose by odometry depends on a loop, and nothing depends on how long an answer takes. So a copy tracks
the scans, or where there are cameras their frames, from the first on while the doctor still looks at the log,
and sends each answer; the run itself goes through all of it as it would alone, and draws edges and closes
loops meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType

from slam.config import Config
from slam.datasets.dataset import Dataset
from slam.datasets.sensor_choice import SensorChoice
from slam.doctor.diagnosis import Registrations
from slam.forked import Forked, Tell, is_core_free
from slam.mapper.checkpoint import OF_FRAMES, OF_SCANS, Checkpoint
from slam.mapper.lidar2d import PlanarRobot
from slam.odometry import Odometries
from slam.odometry.rgbd_tracker import RgbdTracker
from slam.result_cache import ResultCache
from slam.vision.color_registration import ColorRegistration
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prefetch import prefetched
from slam.vision.prepared_frame import FramePreparer, PreparedFrame


class Forerunner:
    """Tracks scans, or the frames of cameras, ahead of the mapper, where a core is free; no 3D lidars.

    Parameters
    ----------
    checkpoint
        Of the run, which takes the answers.
    """

    def __init__(self, dataset: Dataset, odometries: Odometries, checkpoint: Checkpoint) -> None:
        self._dataset, self._odometries, self._checkpoint = dataset, odometries, checkpoint
        self._copy: Forked | None = None

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
        self._checkpoint.foretold = OF_FRAMES if choice.cameras else OF_SCANS

        def work(tell: Tell) -> None:
            """What the copy does."""
            checkpoint = self._checkpoint.telling(tell)
            found = known
            if found is None:
                found = checkpoint.registrations(lambda: registrations(choice.cameras))
            if choice.cameras:
                self._track_frames(config, choice, found, checkpoint)
            else:
                self._track_scans(config, choice, checkpoint)

        self._copy = Forked(work)
        self._checkpoint.ahead = self._copy.receive

    def _track_scans(self, config: Config, choice: SensorChoice, checkpoint: Checkpoint) -> None:
        """Track a robot that has no cameras."""
        robot = PlanarRobot(config, checkpoint, odometries=self._odometries, ahead=True)
        key = 0
        for measurement in choice.used(self._dataset):
            tracked = robot.observe(measurement)
            if tracked is not None and tracked.new_keyframe:
                robot.step(key)
                robot.extend_local_map()
                key += 1

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
        """Find all other answers here."""
        self._checkpoint.ahead = None
        if self._copy is not None:
            self._copy.close()
        self._copy = None
