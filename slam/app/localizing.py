"""Localise a log in a saved map."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gtsam
import numpy as np

from fusion.showing import drawn, one_line, with_pictures
from slam.app.progress import OnProgress, Progress, silent
from slam.config import Config, config_of
from slam.datasets.dataset import Dataset
from slam.datasets.opening import opened_by
from slam.datasets.sensor_choice import SensorChoice, UsedMeasurements
from slam.doctor.finding import Finding
from slam.doctor.registration_pairs import registrations_of
from slam.errors import ConfigError, DatasetError, path_of
from slam.estimates import Trajectory
from slam.evaluation.localization_report import write_localization_report
from slam.localization.drive_log import DriveLog
from slam.localization.localizer import Localizer
from slam.localization.poses import Measured, diagonal
from slam.mapper.pipeline import after_readings, findings_of, settled
from slam.outputs.finished_map import Map
from slam.outputs.grid_map import GridMap, opened
from slam.storage.files import make_folder
from slam.storage.map_contents import MapContents
from slam.viewer.map_recording import record_localization
from slam.viewer.viewer import Viewer, recording
from slam.vision.color_registration import ColorRegistration

# Standard deviations of a given start, metres and radians: those that RViz sends with a pose set by hand.
START_SIGMA = (0.5, math.pi / 12.0)


@dataclass(frozen=True, slots=True)
class Localization:
    """The result of localising a log.

    Attributes
    ----------
    drive
        State, pose, covariance and confidence after every scan or frame.
    written
        The files that were written.
    warnings
        Reasons to doubt the poses, as text.
    """

    drive: DriveLog
    written: tuple[Path, ...]
    warnings: tuple[str, ...] = ()

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, drawn(blue=self.trajectory.positions_m[:, :2]))

    @property
    def trajectory(self) -> Trajectory:
        """Poses in the map wherever they are known, also those found later; sorted by stamp."""
        return self.drive.trajectory()


def localize_log(
    saved: Map | GridMap | Path | str,
    log: Path | str | Dataset,
    config: Config | str | None = None,
    *,
    start: tuple[float, float, float] | None = None,
    start_sigma: tuple[float, float] = START_SIGMA,
    out: Path | str | None = None,
    on_progress: OnProgress | None = None,
    strict: bool = False,
    record: Path | None = None,
) -> Localization:
    """Localise the robot of a log in a saved map; the map is not changed.

    Parameters
    ----------
    saved
        The map, or a grid map of another program (`load_grid_map`), or the path of either.
    log
        A path that `slam.open_dataset` accepts, or an opened dataset.
    config
        A configuration, or the name of a preset or file; None uses the default preset.
    start
        Approximate initial pose: x, y (metres) and yaw (radians) of the base in the map at the first reading.
        None searches the whole map.
    start_sigma
        Standard deviations of the initial pose, metres and radians.
    out
        Folder for ``trajectory.tum``, ``trajectory.csv`` and the report; None writes nothing.
    on_progress
        Function that is called with a `slam.Progress` during the run.
    strict
        Stop at the first damaged record instead of counting and skipping it. Used if ``log`` is a path.
    record
        File for a recording for the Rerun viewer; None writes none.

    Raises
    ------
    ScanweaveError
        If the log cannot be read or has no data that can be localised in the map, or a file cannot be
        written.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> monday = write_synthetic_log("monday", seed=1, duration_s=10.0).log_path
    >>> tuesday = write_synthetic_log("tuesday", seed=2, duration_s=10.0).log_path
    >>> found = slam.localize_log(slam.map_log(monday), tuesday)
    >>> len(found.trajectory) > 50
    True
    """
    saved, config = opened(saved), config_of(config)
    log = opened_by(config.sensors, log, strict=strict)
    findings = findings_of(log, config)
    config = settled(config, findings)
    registrations = _registrations(saved.contents, log, config)
    with recording(record) as viewer:
        if viewer is not None and saved.grid is not None:
            viewer.grid("saved map", saved.grid.states(), saved.grid.resolution_m, saved.grid.T_map_grid)
        known = None if start is None else _known(start, start_sigma)
        localizer = Localizer(saved, config, registrations, known)
        in_space = saved.contents.clouds is not None
        drive = _driven(localizer, log, config, viewer, on_progress or silent, in_space=in_space)
    if not len(drive):
        needed = "clouds of a 3D lidar" if saved.contents.clouds else "planar scans"
        needed += "" if saved.contents.frames is None else ", or frames of its camera"
        raise DatasetError(
            f"{log.name} contains nothing that can be localised in {saved.path}, which needs {needed}; "
            "'scanweave inspect' shows what the log contains"
        )
    warning = localizer.warning()
    warnings = () if warning is None else (warning,)
    written = () if out is None else _written(path_of(out, "out"), drive, saved, log, findings, warnings)
    return Localization(drive, written, warnings)


def _known(start: tuple[float, float, float], sigma: tuple[float, float]) -> Measured:
    """Return the given initial pose with its covariance."""
    shapes = np.shape(start), np.shape(sigma)
    if shapes != ((3,), (2,)) or not (np.isfinite([*start, *sigma]).all() and min(sigma) > 0.0):
        raise ConfigError(f"start {start}, sigma {sigma}: needs x, y, yaw, and two sigmas above zero, finite")
    return Measured(pose := gtsam.Pose2(*start), diagonal(pose, *sigma))


def _registrations(
    known_map: MapContents, log: Dataset, config: Config
) -> dict[str, ColorRegistration] | None:
    """Pose of the map's colour camera: None if the map has it, else from the log."""
    if config.rgbd.registration == "given":
        return {}
    if known_map.frames is None or known_map.registrations:
        return None
    choice = SensorChoice.of(log, config.sensors)
    return registrations_of(UsedMeasurements(log, config.sensors), choice.cameras, config)


def _driven(
    localizer: Localizer,
    log: Dataset,
    config: Config,
    viewer: Viewer | None,
    on_progress: OnProgress,
    *,
    in_space: bool,
) -> DriveLog:
    """Run the localiser on the whole log; in a map of clouds, readings of an IMU come before them."""
    drive, measurements = DriveLog(), iter(UsedMeasurements(log, config.sensors))
    if in_space and (choice := SensorChoice.of(log, config.sensors)).imu:
        measurements = after_readings(choice.used(log))
    for measurement in measurements:
        before = time.perf_counter()
        output = localizer.add(measurement)
        if output is not None:
            drive.add(output, time.perf_counter() - before)
            if viewer is not None:
                record_localization(viewer, measurement, output)
            on_progress(Progress("localising", len(drive), log.report.share))
    on_progress(Progress("localising", len(drive), 1.0))
    return drive


def _written(
    out: Path,
    drive: DriveLog,
    saved: Map | GridMap,
    log: Dataset,
    findings: Sequence[Finding],
    warnings: Sequence[str],
) -> tuple[Path, ...]:
    """Write trajectory, covariances and report into a folder."""
    make_folder(out)
    files = drive.write(out)
    notes = [(reason, f"{tally.count:,}") for reason, tally in log.report.dropped.items()]
    notes += [(finding.kind, finding.line) for finding in findings]
    write_localization_report(
        out / "report.html", f"{log.path.name} in {saved.path}", drive, saved.layers, notes, warnings
    )
    return (*files, out / "report.html")
