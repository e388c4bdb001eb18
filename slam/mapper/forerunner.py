"""Scans and frames matched ahead, in a copy of this process: the run finds the answers when it comes to them.

No pose by odometry depends on a loop, and nothing depends on how long an answer takes. So a copy tracks
scans and frames from the first on while the doctor still looks at the log, and sends each answer; the run
itself goes through all of it as it would alone, and draws edges and closes loops meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import TracebackType

from slam.config import Config
from slam.datasets.dataset import Dataset
from slam.datasets.sensor_choice import SensorChoice
from slam.doctor.diagnosis import Registrations
from slam.forked import Forked, Tell, is_core_free
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.rgbd import FreeCamera
from slam.measurements import Measurement
from slam.odometry import Odometries
from slam.vision.prefetch import prefetched
from slam.vision.prepared_frame import FramePreparer, PreparedFrame


class Forerunner:
    """Tracks a robot's scans and frames ahead of its mapper, where a core is free; not those of 3D lidars.

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
        mountings: Mapping[str, LearnedMounting],
    ) -> None:
        """Run ahead by these settings, if that is of use, and it does not yet."""
        if self._copy is not None or not is_core_free() or not self._checkpoint.is_kept:
            return
        if choice.cloud or self._checkpoint.replaying:
            return
        known = registrations(choice.cameras)

        def work(tell: Tell) -> None:
            """What the copy does."""
            checkpoint = self._checkpoint.telling(tell)
            leader: FreeCamera | PlanarRobot
            if choice.spatial:
                leader = FreeCamera(config, checkpoint, known, self._odometries)
            else:
                leader = PlanarRobot(config, checkpoint, known, mountings, self._odometries, ahead=True)
            used = choice.used(self._dataset)
            readings: Iterable[Measurement | PreparedFrame] = used
            if choice.cameras:
                readings = prefetched(used, FramePreparer(config.rgbd, known))
            key = 0
            for measurement in readings:
                tracked = leader.observe(measurement)
                if tracked is not None and tracked.new_keyframe:
                    leader.step(key)
                    leader.extend_local_map()
                    key += 1

        self._copy = Forked(work)
        self._checkpoint.ahead = self._copy.receive

    def stop(self) -> None:
        """Find all other answers here."""
        self._checkpoint.ahead = None
        if self._copy is not None:
            self._copy.close()
        self._copy = None
