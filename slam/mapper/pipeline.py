"""The main loop: measurements -> keyframes -> graph -> loops -> optimised map."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias

from slam.config import Config, calibrated
from slam.datasets.dataset import Dataset
from slam.datasets.recording import fewer_frames, read_once
from slam.datasets.sensor_choice import SensorChoice, SensorTally, UsedMeasurements, use_lines
from slam.doctor.diagnosis import Registrations, diagnose, registrations_in
from slam.doctor.finding import Finding, remedied
from slam.errors import DatasetError
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.forerunner import Forerunner
from slam.mapper.imu_start import start_of
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.lidar3d import CloudLidar
from slam.mapper.map_result import MapResult
from slam.mapper.mapper import Mapper
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.protocol import FrontEnd
from slam.mapper.rgbd import FreeCamera
from slam.measurements import Measurement
from slam.odometry import STANDARD, Odometries
from slam.vision.color_registration import ColorRegistration
from slam.vision.features import forget_keypoints
from slam.vision.prefetch import prefetched
from slam.vision.prepared_frame import FramePreparer, PreparedFrame
from slam.vision.registration_pairs import paired_frames

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
        The effective configuration.
    on_step
        Called with the stage, ``mapping`` or ``optimising``, and the number of scans and frames so far.
    checkpoint
        Keeps what a run finds out, so that it can go on where it was interrupted; None keeps nothing.
    odometries
        What makes the odometries; `slam.comparison.methods` has others.

    Raises
    ------
    DatasetError
        Where the log holds nothing that can be mapped.
    """
    checkpoint = checkpoint or Checkpoint()
    with Forerunner(dataset, odometries, checkpoint) as forerunner:
        return _mapped(dataset, config, on_step, checkpoint, odometries, forerunner)


def _mapped(
    dataset: Dataset,
    config: Config,
    on_step: OnStep | None,
    checkpoint: Checkpoint,
    odometries: Odometries,
    forerunner: Forerunner,
) -> MapResult:
    """See `build_map`."""
    clock = [time.perf_counter()]
    registered = _Registered(dataset, config)
    choice = _choice(dataset, config)
    ahead = partial(forerunner.start, config, choice, registered)
    if choice.cameras:
        ahead()
    with read_once(dataset, ahead):
        findings = checkpoint.findings(lambda: findings_of(dataset, config, registered))
        if (mended := settled(config, findings)) != config:
            forerunner.stop()
            registered = _Registered(dataset, config := mended)
            choice = _choice(dataset, config)
    registrations = checkpoint.registrations(lambda: registered(choice.cameras))
    mountings = checkpoint.mountings()
    prepare = None
    if choice.cameras:
        prepare = FramePreparer(config.rgbd, registrations, lambda: checkpoint.knows_more)
    leader = _front_end(choice, dataset, config, checkpoint, registrations, mountings, odometries)
    mapper = Mapper(config, leader)
    clock += [time.perf_counter()] * 2
    forerunner.start(config, choice, registered, registrations)
    tally = _feed(mapper, dataset, choice, prepare, on_step)
    if not mountings and (mountings := mapper.learned_mountings()):
        # The way up to there was mapped without these cameras; now they are known from its beginning.
        clock[2] = time.perf_counter()
        checkpoint.begin_again(findings, registrations, mountings)
        forerunner.stop()
        forerunner.start(config, choice, registered, registrations)
        mapper = Mapper(config, PlanarRobot(config, checkpoint, registrations, mountings, odometries))
        tally = _feed(mapper, dataset, choice, prepare, on_step)
    forget_keypoints()
    clock.append(time.perf_counter())
    reading_s = clock[3] - clock[2] - sum(mapper.stage_seconds.values())
    dataset.report.note_share(1.0)
    if on_step:
        on_step("mapping", mapper.scan_count)
        checkpoint.on_answer = partial(on_step, "optimising", mapper.scan_count)
        checkpoint.on_answer()
    result = mapper.finish()
    result.stage_seconds = {
        "sensors looked at": clock[1] - clock[0],
        **({"a first way, to learn mountings": clock[2] - clock[1]} if clock[2] > clock[1] else {}),
        "reading the log": reading_s,
        **result.stage_seconds,
    }
    result.uses = tally.uses(dataset.report, result.unused)
    result.notes += [f"{finding.line} (used)" for finding in findings if finding.sure and finding.remedies]
    result.notes += use_lines(result.uses)
    result.warnings += [finding.line for finding in findings if not (finding.sure and finding.remedies)]
    result.warnings += dataset.report.warnings
    return result


@dataclass(slots=True)
class _Registered:
    """Where colour cameras sit, each found once."""

    dataset: Dataset
    config: Config
    found: dict[str, ColorRegistration] = field(default_factory=dict)

    def __call__(self, cameras: Sequence[str]) -> dict[str, ColorRegistration]:
        """See `slam.doctor.diagnosis.Registrations`."""
        unknown = [name for name in cameras if name not in self.found]
        log = UsedMeasurements(self.dataset, self.config.sensors)
        self.found |= registrations_in(log, unknown, self.config)
        return {name: self.found[name] for name in cameras if name in self.found}


def _choice(dataset: Dataset, config: Config) -> SensorChoice:
    """How the log is mapped, by its beginning; a few images of each camera show that it is there."""
    with fewer_frames(dataset, paired_frames):
        return SensorChoice.of(dataset, config.sensors)


def findings_of(
    dataset: Dataset, config: Config, registrations: Registrations | None = None
) -> list[Finding]:
    """What is wrong with the sensors of a log, see `diagnose`; nothing where that is not asked for."""
    if not config.sensors.doctor:
        return []
    return diagnose(UsedMeasurements(dataset, config.sensors), registrations)


def settled(config: Config, findings: Iterable[Finding]) -> Config:
    """A configuration with the remedies of what is beyond doubt; what a person has calibrated stays."""
    return calibrated(config, remedied(config.sensors.calibration, findings, only_sure=True))


def _front_end(
    choice: SensorChoice,
    dataset: Dataset,
    config: Config,
    checkpoint: Checkpoint,
    registrations: Mapping[str, ColorRegistration],
    mountings: Mapping[str, LearnedMounting],
    odometries: Odometries,
) -> FrontEnd:
    """The sensor that leads."""
    if choice.cloud:
        start = start_of(choice.used(dataset), config) if choice.imu and config.sensors.imu else None
        return CloudLidar(config, checkpoint, registrations, start)
    if choice.spatial:
        return FreeCamera(config, checkpoint, registrations, odometries)
    return PlanarRobot(config, checkpoint, registrations, mountings, odometries)


def _feed(
    mapper: Mapper,
    dataset: Dataset,
    choice: SensorChoice,
    prepare: FramePreparer | None,
    on_step: OnStep | None,
) -> SensorTally:
    """Hand the whole log to a mapper, frames prefetched; how much of it there was."""
    tally = SensorTally(choice)
    used = choice.used(tally.counted(dataset))
    measurements: Iterable[Measurement | PreparedFrame] = used
    if prepare is not None:
        measurements = prefetched(used, prepare)
    for measurement in measurements:
        mapper.add(measurement)
        if on_step:
            on_step("mapping", mapper.scan_count)
    if mapper.scan_count == 0:
        raise DatasetError(
            f"{dataset.name} holds no scan or frame that can be mapped; "
            "see 'scanweave inspect' for what it holds"
        )
    return tally
