"""scanweave map."""

from __future__ import annotations

import sqlite3
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli.app import (
    CalibrationOption,
    ConfigOption,
    LogArgument,
    RecordOption,
    SetOption,
    StrictOption,
    TopicsOption,
    command,
    folder_of,
    say,
    tell,
    topics_override,
)
from slam.cli.progress import Show, interruptible, progress_bar
from slam.errors import ScanweaveError

if TYPE_CHECKING:
    from slam.app.joining import Joined
    from slam.app.map_run import MapRun
    from slam.config import Config


@command("map monday.log -o house/")
def map_command(
    log: LogArgument,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", parser=folder_of, help="output folder; created if missing")
    ] = None,
    into: Annotated[
        Path | None,
        typer.Option(
            "--into",
            metavar="MAP",
            help="add the log to this saved map; with --out, write the joined map there and keep MAP",
        ),
    ] = None,
    config: ConfigOption = None,
    set_: SetOption = None,
    no_odometry: Annotated[bool, typer.Option("--no-odometry", help="ignore wheel odometry")] = False,
    no_loops: Annotated[bool, typer.Option("--no-loops", help="disable loop closure")] = False,
    no_fusion: Annotated[
        bool, typer.Option("--no-fusion", help="disable the mutual repair of lidar and cameras")
    ] = False,
    strict: StrictOption = False,
    topics: TopicsOption = None,
    calibration: CalibrationOption = None,
    tags: Annotated[
        Path | None,
        typer.Option(
            help="tags and surveyed points (yaml); default: tags.yaml next to the log, if there is one"
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="continue the interrupted run whose map is in the folder")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="replace a finished map in the folder")] = False,
    record: RecordOption = None,
) -> None:
    """Map a log: write trajectory, pose graph, grid and report, and map.db with everything."""
    overrides = [*(set_ or []), *topics_override(topics)]
    left_out = {"sensors.wheels": no_odometry, "loops.enabled": no_loops, "fusion.enabled": no_fusion}
    overrides += [f"{part}=false" for part, is_off in left_out.items() if is_off]
    if into is not None and record is not None:
        raise typer.BadParameter("--record cannot be combined with --into")
    if into is None and out is None:
        raise typer.BadParameter("give --out for a new map, or --into to add the log to a saved map")
    if resume and force:
        raise typer.BadParameter("--resume continues a map, --force replaces it: give only one of them")
    from slam.config import load_config, with_places

    settings = load_config(config, overrides, calibration=calibration)
    if tags is not None:
        settings = with_places(settings, tags)
    if into is not None:
        own_settings = settings if config or overrides else None
        map_into(log, into, out, own_settings, strict=strict, resume=resume, calibration=calibration)
    else:
        assert out is not None
        map_log(log, out, settings, strict=strict, resume=resume, force=force, record=record)


def map_log(
    log: Path,
    out: Path,
    config: Config,
    *,
    strict: bool = False,
    resume: bool = False,
    force: bool = False,
    record: Path | None = None,
) -> MapRun:
    """Map a log into a folder, and tell of it."""
    started = time.perf_counter()
    from slam.app.mapping import run_log
    from slam.config.tags import FILE_NAME as TAGS_FILE

    with _told_of(out, resume=resume) as on:
        run = run_log(
            log, config, out=out, on_progress=on, resume=resume, overwrite=force, strict=strict, record=record
        )
    if run.report is None:
        say(f"{run.map.path} is already finished; there is nothing to resume")
        return run
    _tell(run, f", {time.perf_counter() - started:.1f} s")
    if config.sensors.tags is None and run.report.config.sensors.tags is not None:
        say(f"used {TAGS_FILE}, found next to the log; --tags gives another file")
    if run.report.beside.truth is not None:
        rmse = run.report.beside.truth.error.translation_m.rmse
        say(f"{rmse:.4f} m RMSE against the ground truth, rigidly aligned")
    say("wrote " + ", ".join(str(path) for path in run.written))
    return run


def map_into(
    log: Path,
    map_: Path,
    out: Path | None,
    config: Config | None,
    *,
    strict: bool,
    resume: bool,
    calibration: Path | None = None,
) -> Joined:
    """Map a log as one more session of a saved map, by its settings where none are given, and tell of it."""
    started = time.perf_counter()
    from slam.app.joining import WORK, join
    from slam.config import with_calibration
    from slam.outputs.finished_map import load_map

    known = load_map(map_)
    if config is None and calibration is not None:
        config = with_calibration(known.config, calibration)
    work = (out or known.path.parent) / WORK / "session"
    with _told_of(work, resume=resume, session=True) as on:
        joined = join(known, log, config, out=out, on_progress=on, resume=resume, strict=strict)
    if joined.session.report is not None:
        _tell(joined.session, "", f"{log.name} alone: ")
    together, placing = joined.connection.joined, joined.connection.placing
    assert together is not None
    say(
        f"recognised at {len(placing.anchors)} places, {together.loops_kept} of "
        f"{len(joined.connection.loops)} loops between the sessions hold, the map's own keyframes moved by "
        f"up to {together.moved_m:.3f} m; {len(together.contents.node_poses)} keyframes; "
        f"{time.perf_counter() - started:.1f} s"
    )
    say("wrote " + ", ".join(str(path) for path in joined.written))
    return joined


@contextmanager
def _told_of(folder: Path, *, resume: bool, session: bool = False) -> Iterator[Show]:
    """Show how far a map in a folder is: first what becomes of one that was begun, last how to go on.

    With ``session`` the map is added to another one afterwards.
    """
    from slam.app.map_folder import Left, left_in
    from slam.storage.map_file import MAP_NAME

    state, path, first = left_in(folder), folder / MAP_NAME, ""
    if state is Left.UNFINISHED:
        first = f"going on with {path}" if resume else f"replacing {path}, left by an interrupted run"
    elif resume and state is Left.NOTHING:
        first = f"nothing to resume in {folder}; mapping from the beginning"
    try:
        with progress_bar(first=first) as bar, interruptible(bar) as show:
            yield show
    except (KeyboardInterrupt, ScanweaveError, OSError) as error:
        cause = error.__cause__ or error
        stopped = isinstance(cause, KeyboardInterrupt | OSError | sqlite3.Error)  # not by what is in the log
        busy = isinstance(cause, BlockingIOError) or "locked" in str(cause)
        state = left_in(folder) if stopped and not busy else Left.NOTHING
        if state is Left.UNFINISHED or (state is Left.FINISHED and session):
            tell(f"{path} is kept; the same command with --resume continues it", sys.stderr)
        raise


def _tell(run: MapRun, took: str, of: str = "") -> None:
    """Warnings, notes and the figures of a run."""
    from slam.evaluation.map_info import extent_of

    report = run.report
    assert report is not None
    for warning in report.warnings:
        tell(f"warning: {warning}", sys.stderr)
    for note in report.result.notes:
        say(note)
    contents = report.result.map
    accepted = sum(loop.accepted for loop in contents.loops)
    path_m = extent_of(contents.trajectory, report.sessions)["path_length_m"]
    say(
        f"{of}{report.result.scans.stamps_s.size} {report.unit}s, {len(contents.node_poses)} keyframes, "
        f"{path_m:.1f} m, {accepted} of {len(contents.loops)} loops accepted, "
        f"{run.dropped} records dropped{took}"
    )
