"""The main loop: measurements -> keyframes -> graph -> loops -> optimised map."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias

from slam.config import Config, calibrated
from slam.datasets.dataset import Dataset
from slam.datasets.recording import fewer_frames, read_once
from slam.datasets.sensor_choice import SensorChoice, SensorTally, UsedMeasurements, use_lines
from slam.doctor.diagnosis import Registrations, diagnose
from slam.doctor.finding import Finding, remedied
from slam.doctor.registration_pairs import paired_frames, registrations_of
from slam.errors import DatasetError
from slam.heap import end_stage
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.first_map import first_map
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.lidar3d import CloudLidar
from slam.mapper.lookahead import Ahead, Lookahead, LostError
from slam.mapper.map_result import MapResult
from slam.mapper.mapper import Mapper
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.protocol import FrontEnd
from slam.mapper.rgbd import FreeCamera
from slam.measurements import ImuReading, Measurement, PointCloud
from slam.odometry import STANDARD, Odometries
from slam.odometry.cloud_velocity import LONGEST_STEP_S
from slam.odometry.imu_tracker import UnfitImuError
from slam.vision.color_registration import ColorRegistration
from slam.vision.features import forget_keypoints
from slam.vision.prefetch import prefetched
from slam.vision.prepared_frame import FramePreparer, PreparedFrame

OnStep: TypeAlias = Callable[[str, int], None]


def build_map(
    dataset: Dataset,
    config: Config,
    on_step: OnStep | None = None,
    checkpoint: Checkpoint | None = None,
    odometries: Odometries = STANDARD,
) -> MapResult:
    """Run the whole log through the mapper.

    Parameters
    ----------
    dataset
        The log.
    config
        The configuration.
    on_step
        Called with the stage, ``begun``, ``mapping`` or ``optimising``, and how many scans and frames so far.
    checkpoint
        Stores the results of a run, so that an interrupted run can resume; None stores nothing.
    odometries
        Factory of the odometries; `slam.comparison.methods` has others.

    Raises
    ------
    DatasetError
        If the log has no data that can be mapped.
    """
    checkpoint = checkpoint or Checkpoint()
    with Lookahead(dataset, odometries, checkpoint) as lookahead:
        run = _Run(dataset, config, on_step, checkpoint, odometries, lookahead)
        run.look_at_sensors()
        mapper, tally = run.follow()
        return run.finish(mapper, tally)


class _Run:
    """The run of one log through the mapper, see `build_map`."""

    def __init__(
        self,
        dataset: Dataset,
        config: Config,
        on_step: OnStep | None,
        checkpoint: Checkpoint,
        odometries: Odometries,
        lookahead: Lookahead,
    ) -> None:
        self._dataset, self._config, self._on_step = dataset, config, on_step
        self._checkpoint, self._odometries, self._lookahead = checkpoint, odometries, lookahead
        self._clock = [time.perf_counter()]
        end_stage()  # of imports
        self._registered = _Registered(dataset, config)
        self._choice = self._chosen()
        self._findings: list[Finding] = []
        self._registrations: Mapping[str, ColorRegistration] = {}
        self._mountings: Mapping[str, LearnedMounting] = {}

    def look_at_sensors(self) -> None:
        """Find errors of the sensors, and correct those that are beyond doubt."""
        if self._choice.cameras:
            self._run_ahead()
        with read_once(self._dataset, self._run_ahead):
            self._findings = self._checkpoint.findings(
                lambda: findings_of(self._dataset, self._config, self._registered)
            )
            if (mended := settled(self._config, self._findings)) != self._config:
                self._lookahead.stop()
                self._config = mended
                self._registered = _Registered(self._dataset, mended)
                self._choice = self._chosen()
        self._registrations = self._checkpoint.registrations(lambda: self._registered(self._choice.cameras))
        self._mountings = self._checkpoint.mountings()
        end_stage()

    def follow(self) -> tuple[Mapper, SensorTally]:
        """Feed the whole log to a mapper, and return how much was read."""
        self._clock += [time.perf_counter()] * 2
        self._run_ahead(self._registrations)
        if self._on_step:
            self._on_step("begun", 0)
        mapper, tally = self._map_whole_log()
        if not self._mountings and (mountings := mapper.learned_mountings()):
            # The path so far was mapped without these cameras; now they are known from its beginning.
            self._clock[2] = time.perf_counter()
            self._mountings = mountings
            self._begin_again()
            self._run_ahead(self._registrations)
            mapper, tally = self._map_whole_log()
        forget_keypoints()
        self._clock.append(time.perf_counter())
        return mapper, tally

    def finish(self, mapper: Mapper, tally: SensorTally) -> MapResult:
        """Optimise everything and make the map; report the quality of the log with it."""
        dataset, clock = self._dataset, self._clock
        reading_s = clock[3] - clock[2] - sum(mapper.stage_seconds.values())
        dataset.report.note_share(1.0)
        if self._on_step:
            self._on_step("mapping", mapper.scan_count)
            self._checkpoint.on_answer = partial(self._on_step, "optimising", mapper.scan_count)
            self._checkpoint.on_answer()
        end_stage()
        result = mapper.finish()
        result.stage_seconds = {
            "check of the sensors": clock[1] - clock[0],
            **({"a first pass, to estimate mountings": clock[2] - clock[1]} if clock[2] > clock[1] else {}),
            "reading the log": reading_s,
            **result.stage_seconds,
        }
        result.uses = tally.uses(dataset.report, result.unused)
        for finding in self._findings:
            if finding.sure and finding.remedies:
                result.notes.append(f"{finding.line} (used)")
            else:
                result.warnings.append(finding.line)
        result.notes += use_lines(result.uses)
        result.warnings += dataset.report.warnings
        if dataset.report.dropped_count >= mapper.scan_count:
            result.warnings.append(
                f"Only {mapper.scan_count} scans or frames are mapped: {dataset.report.refusals}"
            )
        return result

    def _chosen(self) -> SensorChoice:
        """Choose how the log is mapped, from its beginning; a few images show that a camera is present."""
        with fewer_frames(self._dataset, paired_frames):
            return SensorChoice.of(self._dataset, self._config.sensors)

    def _run_ahead(self, known: Mapping[str, ColorRegistration] | None = None) -> None:
        """Start tracking ahead on another core, if that is useful."""
        self._lookahead.start(self._config, self._choice, self._registered, known)

    def _begin_again(self) -> None:
        """Discard the path, and the results tracked ahead."""
        self._lookahead.stop()
        self._checkpoint.begin_again(self._findings, self._registrations, self._mountings)

    def _map_whole_log(self) -> tuple[Mapper, SensorTally]:
        """Run through the log; run again if an assumption was wrong."""
        while True:
            try:
                return self._map_log(self._lookahead.ahead)
            except LostError:
                self._begin_again()
            except UnfitImuError as unfit:
                name, why, fix = unfit.args
                remedy, effect = {"imus": {name: fix}}, "mapping starts again"
                finding = Finding(name, "no agreement", why, effect, (remedy,), sure=True)
                self._findings = [*self._findings, finding]
                self._config = settled(self._config, [finding])
                self._choice = self._chosen()
                self._begin_again()

    def _map_log(self, ahead: Ahead | None = None) -> tuple[Mapper, SensorTally]:
        """Run through the log once, with frames prefetched."""
        mapper, tally = Mapper(self._config, self._front_end(ahead)), SensorTally(self._choice)
        used = self._used(tally.counted(self._dataset))
        measurements: Iterable[Measurement | PreparedFrame] = used
        if self._choice.cameras:
            prepare = FramePreparer(
                self._config.rgbd, self._registrations, lambda: self._checkpoint.knows_more
            )
            measurements = prefetched(used, prepare)
        for measurement in measurements:
            mapper.add(measurement)
            if self._on_step:
                self._on_step("mapping", mapper.scan_count)
        if mapper.scan_count == 0:
            refusals = self._dataset.report.refusals
            raise DatasetError(
                f"{self._dataset.name} contains no scan or frame that can be mapped"
                f"{f' ({refusals})' if refusals else ''}; 'scanweave inspect' shows what it contains"
            )
        if ahead is not None:
            ahead.end()
        return mapper, tally

    def _used(self, log: Iterable[Measurement]) -> Iterable[Measurement]:
        """Return the measurements to map; in 3D, the IMU readings determine the times."""
        used = self._choice.used(log)
        waits = self._choice.imu and (self._choice.cloud or self._choice.spatial)
        return after_readings(used) if waits else used

    def _front_end(self, ahead: Ahead | None) -> FrontEnd:
        """Create the front end of the leading sensor."""
        config, choice, checkpoint = self._config, self._choice, self._checkpoint
        if choice.cloud:
            with fewer_frames(self._dataset, None):
                first = first_map(self._used(self._dataset), config)
            return CloudLidar(config, checkpoint, self._registrations, first)
        if choice.spatial:
            return FreeCamera(config, checkpoint, self._registrations, self._odometries)
        known = self._registrations, self._mountings, self._odometries
        return PlanarRobot(config, checkpoint, *known, ahead)


def after_readings(log: Iterable[Measurement]) -> Iterator[Measurement]:
    """Yield a log in its order, with readings before the clouds of their time, however late they arrive."""
    waiting, newest_s = deque[tuple[float, Measurement]](), -math.inf
    for item in log:
        if isinstance(item, ImuReading):
            newest_s = max(newest_s, item.stamp_s)
            yield item
        else:
            times_s = item.times_s if isinstance(item, PointCloud) else None
            waiting.append((item.stamp_s if times_s is None else item.stamp_s + float(times_s.max()), item))
        while waiting and (waiting[0][0] <= newest_s or item.stamp_s - waiting[0][0] > LONGEST_STEP_S):
            yield waiting.popleft()[1]
    yield from (item for _, item in waiting)


@dataclass(slots=True)
class _Registered:
    """Registrations of colour cameras, each estimated once."""

    dataset: Dataset
    config: Config
    found: dict[str, ColorRegistration] = field(default_factory=dict)

    def __call__(self, cameras: Sequence[str]) -> dict[str, ColorRegistration]:
        """See `slam.doctor.diagnosis.Registrations`."""
        unknown = [name for name in cameras if name not in self.found]
        log = UsedMeasurements(self.dataset, self.config.sensors)
        self.found |= registrations_of(log, unknown, self.config)
        return {name: self.found[name] for name in cameras if name in self.found}


def findings_of(
    dataset: Dataset, config: Config, registrations: Registrations | None = None
) -> list[Finding]:
    """Return the findings about the sensors of a log, see `diagnose`; none if the doctor is off."""
    if not config.sensors.doctor:
        return []
    return diagnose(UsedMeasurements(dataset, config.sensors), registrations)


def settled(config: Config, findings: Iterable[Finding]) -> Config:
    """Return a configuration with the certain corrections; calibrations by the user are kept."""
    return calibrated(config, remedied(config.sensors.calibration, findings, only_sure=True))
