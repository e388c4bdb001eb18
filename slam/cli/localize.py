"""scanweave localize."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli.app import (
    ConfigOption,
    LogArgument,
    RecordOption,
    SetOption,
    StrictOption,
    TopicsOption,
    app,
    topics_override,
)
from slam.cli.progress import progress_of
from slam.cli.saved import MapArgument

if TYPE_CHECKING:
    from slam.config import Config
    from slam.datasets.dataset import Dataset
    from slam.localization.drive_log import DriveLog
    from slam.localization.known_map import KnownMap
    from slam.measurements import Measurement
    from slam.viewer import Viewer
    from slam.vision.prepared_frame import PreparedFrame


@app.command()
def localize(
    map_: MapArgument,
    log: LogArgument,
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the results; made where missing")],
    config: ConfigOption = None,
    set_: SetOption = None,
    strict: StrictOption = False,
    topics: TopicsOption = None,
    record: RecordOption = None,
    update: Annotated[
        bool, typer.Option("--update", help="then add the log to the map, as 'scanweave map LOG --into MAP'")
    ] = False,
) -> None:
    """Find and follow the robot of a log in a saved map, from no start pose; the map stays as it is."""
    started = time.perf_counter()
    from slam.config import load_config
    from slam.datasets import open_dataset
    from slam.errors import DatasetError, MapFileError
    from slam.evaluation.localization_report import write_localization_report
    from slam.localization.drive_log import STATES
    from slam.localization.known_map import KnownMap
    from slam.storage.files import make_folder
    from slam.storage.saved_map import open_saved_map
    from slam.viewer import recording

    settings = load_config(config, [*(set_ or []), *topics_override(topics)])
    saved = open_saved_map(map_)
    if update and len(saved.clouds):
        raise MapFileError(f"{saved.path} is of a 3D lidar and takes no other log; localise without --update")
    sensors = settings.sensors
    dataset = open_dataset(log, strict=strict, topics=sensors.topics, images=sensors.rgbd)
    make_folder(out)
    with recording(record) as viewer:
        if saved.grid is not None:
            viewer.grid("saved map", saved.grid.states(), saved.grid.resolution_m, saved.grid.T_map_grid)
        drive = _drive(KnownMap.of_saved(saved), dataset, settings, viewer)
    if not len(drive):
        wanted = "clouds of a 3D lidar" if len(saved.clouds) else "planar scans, or frames of its camera"
        raise DatasetError(
            f"{dataset.name} holds nothing that can be localised in {saved.path}, which takes {wanted}; see "
            "'scanweave inspect' for what the log holds and 'scanweave info' for the map"
        )
    written = drive.write(out)
    notes = [(reason, f"{tally.count:,}") for reason, tally in dataset.report.dropped.items()]
    report = out / "report.html"
    write_localization_report(report, f"{log.name} in {saved.path}", drive, saved.grid, notes)
    shares = ", ".join(f"{100.0 * drive.share_of(state):.0f} % {state.value}" for state in STATES)
    print(
        f"{len(drive)} scans and frames: {shares}; {len(drive.trajectory())} poses; "
        f"{time.perf_counter() - started:.1f} s"
    )
    print("wrote " + ", ".join(str(path) for path in [*written, report]))
    saved.close()
    if update:
        from slam.cli.map_into import map_into

        map_into(log, map_, None, settings if config or set_ else None, strict, resume=False)


def _drive(known_map: KnownMap, dataset: Dataset, settings: Config, viewer: Viewer) -> DriveLog:
    """Localise a whole log."""
    from slam.localization.drive_log import DriveLog
    from slam.localization.localizer import Localizer
    from slam.map_recording import record_localization

    localizer, drive = Localizer(known_map, settings), DriveLog()
    with progress_of("localising", "scans and frames") as progress:
        for measurement in _prepared(dataset, settings):
            before = time.perf_counter()
            output = localizer.add(measurement)
            if output is not None:
                drive.add(output, time.perf_counter() - before)
                record_localization(viewer, measurement, output)
                progress(len(drive))
    return drive


def _prepared(dataset: Dataset, settings: Config) -> Iterable[Measurement | PreparedFrame]:
    """The measurements that are used; a colour camera beside its depth camera is found out first."""
    from slam.sensor_choice import SensorChoice, used_measurements
    from slam.vision.prepared_frame import FramePreparer
    from slam.vision.registration_pairs import registrations_of

    choice = SensorChoice.of(dataset, settings.sensors)
    if not choice.cameras:
        return used_measurements(dataset, settings.sensors)
    measurements = used_measurements(dataset, settings.sensors)
    prepare = FramePreparer(settings.rgbd, registrations_of(measurements, choice.cameras, settings))
    return (prepare(measurement) for measurement in used_measurements(dataset, settings.sensors))
