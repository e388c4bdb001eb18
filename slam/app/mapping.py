"""Map a log, or measurements of a program, and save the map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from slam.app.map_folder import Left, left_in
from slam.app.map_run import MapRun, run_into
from slam.app.progress import OnProgress, silent
from slam.config import Config, config_of, holds_places, with_places
from slam.config.tags import FILE_NAME as TAGS_FILE
from slam.datasets.dataset import Dataset, ReadReport
from slam.datasets.opening import opened_by
from slam.errors import DatasetError, MapFileError, path_of
from slam.estimates import Trajectory
from slam.mapper.protocol import SENSORS
from slam.measurements import Measurement
from slam.storage.map_file import MAP_NAME
from slam.storage.map_identity import MapIdentity, identity_of
from slam.storage.measurement_soundness import checked
from slam.temporary import TemporaryFolder

if TYPE_CHECKING:
    from slam.outputs.finished_map import Map


def map_log(
    log: Path | str | Dataset,
    config: Config | str | None = None,
    *,
    out: Path | str | None = None,
    on_progress: OnProgress | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> Map:
    """Map a log and return the finished map.

    Parameters
    ----------
    log
        A path that `slam.open_dataset` accepts, or an opened dataset.
    config
        A configuration, or the name of a preset or file; None uses the default preset.
    out
        Folder for ``map.db``, the exported files and the report; created if missing. None keeps the map in
        a temporary folder that is deleted with it; `Map.save` writes it elsewhere.
    on_progress
        Function that is called with a `slam.Progress` a few times per second or more often.
    resume
        Continue an interrupted run of the same log and settings in ``out``.
    overwrite
        Replace a finished map in ``out``.

    Returns
    -------
    The finished map, open.

    Raises
    ------
    ScanweaveError
        If the log cannot be read or has no data to map, ``out`` holds a finished map that must not be
        replaced, or a file cannot be written.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> house = slam.map_log(write_synthetic_log("monday", duration_s=10.0).log_path, out="house")
    >>> house.keyframe_poses.shape[1], len(house.trajectory) > 100
    (3, True)
    >>> house.close()
    """
    return run_log(log, config, out=out, on_progress=on_progress, resume=resume, overwrite=overwrite).map


def run_log(
    log: Path | str | Dataset,
    config: Config | str | None = None,
    *,
    out: Path | str | None = None,
    on_progress: OnProgress | None = None,
    resume: bool = False,
    overwrite: bool = False,
    strict: bool = False,
    record: Path | None = None,
) -> MapRun:
    """As `map_log`; also return the content of the report and the files that were written.

    Parameters
    ----------
    strict
        Stop at the first damaged record instead of counting and skipping it. Used if ``log`` is a path.
    record
        File for a recording for the Rerun viewer; None writes none.
    """
    config = config_of(config)
    dataset = opened_by(config.sensors, log, strict=strict)
    folder = dataset.path if dataset.path.is_dir() else dataset.path.parent
    if config.sensors.tags is None and holds_places(folder / TAGS_FILE):
        config = with_places(config, folder / TAGS_FILE)
    identity = identity_of(dataset, config)
    if out is None:
        return _in_memory(dataset, identity, on_progress)
    folder = path_of(out, "out")
    state = left_in(folder)
    if state in (Left.FINISHED, Left.DAMAGED) and not (resume or overwrite):
        raise MapFileError(
            f"{folder / MAP_NAME} is {state.value}; --force (overwrite=True) replaces it, another --out "
            "(out=) keeps it"
        )
    return run_into(
        folder, dataset, identity, on_progress=on_progress or silent, resume=resume, record=record
    )


def build_map(
    measurements: Iterable[Measurement],
    config: Config | str | None = None,
    *,
    on_progress: OnProgress | None = None,
) -> Map:
    """Map measurements of your program: scans, wheel odometry, clouds and frames, in the order of arrival.

    Parameters
    ----------
    measurements
        `slam.LaserScan`, `slam.WheelOdometry`, `slam.PointCloud`, `slam.RgbdFrame`. They are read several
        times: give a list, a dataset or another iterable. An iterator is first copied into memory.
    config
        A configuration, or the name of a preset or file; None uses the default preset.
    on_progress
        As in `map_log`.

    Returns
    -------
    The finished map, in a temporary folder that is deleted with it; `Map.save` writes it elsewhere.

    Raises
    ------
    ScanweaveError
        If the measurements have no data to map.

    Examples
    --------
    A square room of 6 m by 4 m, seen by a robot that stands in its middle and turns.

    >>> import numpy as np, slam
    >>> bearings = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    >>> def seen_at(number):
    ...     around = bearings + 0.1 * number
    ...     far = np.minimum(3.0 / np.abs(np.cos(around)), 2.0 / np.abs(np.sin(around) + 1e-9))
    ...     return slam.LaserScan(0.1 * number, far.astype(np.float32), -np.pi, np.pi / 180, 20.0)
    >>> room = slam.build_map([seen_at(number) for number in range(20)])
    >>> rows, columns = (room.grid.states() == 100).nonzero()
    >>> bool(abs(np.ptp(columns) * room.grid.resolution_m - 6.0) < 0.2)
    True
    """
    config = config_of(config)
    measured = Measured(measurements)
    return _in_memory(measured, identity_of(measured, config), on_progress).map


def _in_memory(dataset: Dataset, identity: MapIdentity, on_progress: OnProgress | None) -> MapRun:
    """Map into a temporary folder that is deleted with the map, without exported files or a report."""
    kept_in = TemporaryFolder()
    run = run_into(
        kept_in.path, dataset, identity, on_progress=on_progress or silent, exports=False, report=False
    )
    return replace(run, kept_in=kept_in)


class Measured:
    """Measurements as a dataset; see `slam.datasets.dataset.Dataset`.

    Parameters
    ----------
    measurements
        In the order in which they came. What can be iterated only once is gathered in memory first.
    """

    def __init__(self, measurements: Iterable[Measurement], name: str = "measurements") -> None:
        if not isinstance(measurements, Iterable) or isinstance(measurements, str):
            raise DatasetError(f"{measurements!r} is no list of measurements; slam.map_log maps a log")
        once = iter(measurements) is measurements
        self._measurements = list(measurements) if once else measurements
        # It lies in no file, whatever files there are.
        self.name, self.path = name, Path("memory:") / name
        self.report = ReadReport()

    def __iter__(self) -> Iterator[Measurement]:
        """The measurements, with a new report.

        Raises
        ------
        DatasetError
            There is none, or something that is no measurement.
        """
        report = self.report = ReadReport()
        count = len(self._measurements) if isinstance(self._measurements, Sequence) else 0
        for number, measurement in enumerate(self._measurements, start=1):
            if type(measurement) not in SENSORS:
                measurement = checked(measurement, f"number {number}")
            report.observe(measurement, number)
            if count:
                report.note_share(number / count)
            yield measurement
        if report.measurement_count == 0:
            raise DatasetError("there is no measurement; give scans, clouds or frames")

    def groundtruth(self) -> Trajectory | None:
        """None: a program that knows the truth compares with `slam.evaluate`."""
        return None
