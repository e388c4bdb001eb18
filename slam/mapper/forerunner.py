"""Scans matched ahead, in a copy of this process: the run finds the answers there when it comes to them.

No scan's pose by odometry depends on a loop, and nothing depends on how long an answer takes. So a copy
tracks the scans from the first on while the doctor still looks at the log, and sends each answer; the run
itself goes through all of it as it would alone, and draws edges and closes loops meanwhile.
"""

from __future__ import annotations

from types import TracebackType

from slam.config import Config
from slam.datasets.dataset import Dataset
from slam.datasets.sensor_choice import SensorChoice
from slam.forked import Forked, Tell, is_core_free
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.lidar2d import PlanarRobot
from slam.odometry import Odometries


class Forerunner:
    """Tracks a planar robot's scans ahead of its mapper, where a core is free; without cameras.

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

    def start(self, config: Config) -> None:
        """Run ahead by these settings, if that is of use, and it does not yet."""
        if self._copy is not None or not is_core_free() or not self._checkpoint.is_kept:
            return
        choice = SensorChoice.of(self._dataset, config.sensors)
        if choice.cameras or choice.cloud or choice.spatial:
            return

        def work(tell: Tell) -> None:
            """What the copy does."""
            checkpoint = self._checkpoint.telling(tell)
            robot = PlanarRobot(config, checkpoint, odometries=self._odometries, ahead=True)
            key = 0
            for measurement in choice.used(self._dataset):
                tracked = robot.observe(measurement)
                if tracked is not None and tracked.new_keyframe:
                    robot.step(key)
                    robot.extend_local_map()
                    key += 1

        self._copy = Forked(work)
        self._checkpoint.ahead = self._copy.receive

    def stop(self) -> None:
        """Find all other answers here."""
        self._checkpoint.ahead = None
        if self._copy is not None:
            self._copy.close()
        self._copy = None
