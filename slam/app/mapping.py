"""A log, or measurements of a program's own, to a saved map."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from slam.app.map_folder import Left, left_in
from slam.app.map_run import MapRun, run_into
from slam.app.measured import Measured
from slam.app.progress import OnProgress, silent
from slam.config import Config, config_of, holds_places, with_places
from slam.config.tags import FILE_NAME as TAGS_FILE
from slam.datasets.dataset import Dataset
from slam.datasets.opening import opened_by
from slam.errors import MapFileError
from slam.measurements import Measurement
from slam.storage.map_file import MAP_NAME
from slam.storage.map_identity import MapIdentity, identity_of
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
    """Map a log.

    Parameters
    ----------
    log
        A path that `slam.open_dataset` takes, or what it has opened.
    config
        The effective configuration, or its preset or file; None for the default preset.
    out
        Folder for ``map.db``, the files of other programs and the report, made where it is missing. None
        keeps the map in a temporary folder that goes with it; `Map.save` writes it elsewhere.
    on_progress
        Told how far it is, a few times a second or more often.
    resume
        Go on with what an interrupted run of the same log and settings has left in ``out``.
    overwrite
        Replace a finished map in ``out``.

    Returns
    -------
    The finished map, open.

    Raises
    ------
    ScanweaveError
        Where the log cannot be read or holds nothing to map, where ``out`` holds a finished map and is not
        to be replaced, or a file cannot be written.

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
    """`map_log`, with what its report tells and the files that were written.

    Parameters
    ----------
    strict
        Stop at the first damaged record instead of counting and skipping it; of a path.
    record
        Where a recording for the Rerun viewer goes; None for none.
    """
    config = config_of(config)
    dataset = opened_by(config.sensors, log, strict=strict)
    folder = dataset.path if dataset.path.is_dir() else dataset.path.parent
    if config.sensors.tags is None and holds_places(folder / TAGS_FILE):
        config = with_places(config, folder / TAGS_FILE)
    identity = identity_of(dataset, config)
    if out is None:
        return _in_memory(dataset, identity, on_progress)
    folder = Path(out)
    left = left_in(folder)
    if left in (Left.FINISHED, Left.DAMAGED) and not (resume or overwrite):
        raise MapFileError(
            f"{folder / MAP_NAME} is {left.value}; --force (overwrite=True) replaces it, another --out "
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
    """Map measurements of a program's own: scans, wheels, clouds, frames in the order in which they came.

    Parameters
    ----------
    measurements
        `slam.LaserScan`, `slam.WheelOdometry`, `slam.PointCloud`, `slam.RgbdFrame`. They are read several
        times: a list, a dataset, or whatever else can be iterated again; an iterator is gathered in memory.
    config
        The effective configuration, or its preset or file; None for the default preset.
    on_progress
        As in `map_log`.

    Returns
    -------
    The finished map in a temporary folder that goes with it; `Map.save` writes it elsewhere.

    Raises
    ------
    ScanweaveError
        Where the measurements hold nothing to map.

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
    """A map in a temporary folder that goes with it: neither files of other programs nor a report."""
    kept_in = TemporaryFolder()
    run = run_into(
        kept_in.path, dataset, identity, on_progress=on_progress or silent, exports=False, report=False
    )
    return replace(run, kept_in=kept_in)
