"""scanweave map LOG --into MAP: one more session in a saved map."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from slam.cli.map_opening import finished_map, opened_map
from slam.cli.progress import interrupted_between_scans, progress_of
from slam.errors import MapFileError, ScanweaveError
from slam.storage.map_file import MAP_NAME

if TYPE_CHECKING:
    from slam.config import Config
    from slam.datasets.dataset import Dataset
    from slam.sessions.connection import Connection
    from slam.storage.map_identity import MapIdentity
    from slam.storage.saved_map import SavedMap

# Where the session is mapped and the joined map is written until it is whole.
_WORK = "joining"


def map_into(
    log: Path, map_: Path, out: Path | None, settings: Config | None, strict: bool, resume: bool
) -> None:
    """Map a log, join it to a saved map, and let the joined map take its place, or go to another folder.

    Parameters
    ----------
    settings
        By which the log is mapped; None takes those of the map.

    Raises
    ------
    ScanweaveError
        Where the two do not connect, or a file is at fault; the saved map is as it was.
    """
    started = time.perf_counter()
    from slam.datasets import open_dataset
    from slam.sessions.joined_files import only_one_in
    from slam.storage.files import make_folder
    from slam.storage.map_identity import identity_of
    from slam.storage.saved_map import open_saved_map

    known = open_saved_map(map_)
    _refuse_unfit(known, str(known.path))
    if out is None and known.path.name != MAP_NAME:
        raise MapFileError(f"{known.path} is not named {MAP_NAME}; say with --out where the joined map goes")
    dataset = open_dataset(log, strict=strict, topics=settings.sensors.topics if settings else ())
    identity = identity_of(dataset.path, settings or known.config)
    if any(session.log_fingerprint == identity.log_fingerprint for session in known.sessions):
        raise ScanweaveError(f"{log} is in {known.path} already; the map is as it was")
    folder = known.path.parent if out is None else out
    was_there = folder.exists()
    make_folder(folder / _WORK / "session")
    with only_one_in(folder):
        try:
            session = _mapped(dataset, identity, folder / _WORK / "session", resume)
            connection, written = _joined(log, known, session, folder)
        finally:
            _tidy_up(folder, was_there)
    print(_summary(connection, f"{time.perf_counter() - started:.1f} s"))
    print("wrote " + ", ".join(str(path) for path in written))


def _mapped(dataset: Dataset, identity: MapIdentity, folder: Path, resume: bool) -> SavedMap:
    """The map of the log alone, and its report."""
    started = time.perf_counter()
    from slam.evaluation.map_report import RunCost, beside_of, report_data
    from slam.evaluation.report import write_report
    from slam.journal import Journal
    from slam.pipeline import build_map
    from slam.run_outputs import contents_of
    from slam.storage.map_contents import write_contents
    from slam.storage.saved_map import open_saved_map

    if resume and finished_map(folder, identity):
        return open_saved_map(folder)
    with opened_map(folder, identity, resume=resume) as file:
        with (
            progress_of("mapping", "scans and frames") as advance,
            interrupted_between_scans(advance) as on_scan,
        ):
            result = build_map(dataset, identity.config, on_scan, Journal(file))
        cost = RunCost(time.perf_counter() - started, time.process_time())
        beside = beside_of(dataset, result, [])
        data = report_data(identity.log_name, dataset.report, result, identity.config, cost, beside)
        write_report(folder / "report.html", data)
        write_contents(file, contents_of(result))
        file.seal()
    for warning in data.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for note in result.notes:
        print(note)
    print(
        f"{identity.log_name} alone: {data.scans} {data.unit}s, {len(result.keyframe_poses)} keyframes, "
        f"{data.path_length_m:.1f} m, {dataset.report.dropped_count} records dropped"
    )
    return open_saved_map(folder)


def _joined(log: Path, known: SavedMap, session: SavedMap, folder: Path) -> tuple[Connection, list[Path]]:
    """Connect the two, and write the joined map into a folder; what was written."""
    from slam.sessions.connection import connect
    from slam.sessions.joined_files import move_into, write_joined
    from slam.storage.files import write_bytes

    try:
        _refuse_unfit(session, f"what was mapped of {log}")
        connection = connect(known, session)
        if connection.joined is None:
            raise ScanweaveError(
                f"{log} does not connect to {known.path}: {connection.reason}; the map is as it was"
            )
    except ScanweaveError:
        shutil.rmtree(session.path.parent)  # to go on with it would lead here again
        raise
    whole = folder / _WORK / "map"
    shutil.rmtree(whole, ignore_errors=True)  # of a run that was killed
    write_joined(whole, known, session, connection.joined)
    report = (session.path.parent / "report.html").read_bytes()
    write_bytes(whole / f"report-{len(known.sessions) + 1}.html", report)
    written = move_into(folder, whole)
    shutil.rmtree(session.path.parent)
    return connection, written


def _tidy_up(folder: Path, was_there: bool) -> None:
    """Remove what was made for the work, but for a session that ``--resume`` can go on with."""
    if (folder / _WORK / "session" / MAP_NAME).exists():
        return
    shutil.rmtree(folder / _WORK, ignore_errors=True)
    if not was_there and not any(folder.iterdir()):
        folder.rmdir()


def _summary(connection: Connection, took: str) -> str:
    """The outcome in a line."""
    joined = connection.joined
    assert joined is not None
    return (
        f"recognised at {len(connection.placing.anchors)} places, {joined.loops_kept} of "
        f"{len(connection.loops)} loops between the sessions hold, the map's own keyframes moved by up to "
        f"{joined.moved_m:.3f} m; {len(joined.contents.node_poses)} keyframes; {took}"
    )


def _refuse_unfit(saved: SavedMap, name: str) -> None:
    """Refuse a map whose sessions cannot be joined by their scans."""
    if len(saved.clouds):
        raise ScanweaveError(f"{name} is of a 3D lidar; only maps of a robot on a floor take sessions")
    if not saved.planar:
        raise ScanweaveError(f"{name} is of a camera in space; only maps of a robot on a floor take sessions")
    if saved.grid is None or all(scan is None for scan in saved.keyframe_scans):
        raise ScanweaveError(f"{name} holds no lidar scan; sessions are joined by their scans")
