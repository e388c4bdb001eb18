"""scanweave localize."""

from __future__ import annotations

import math
import sys
import time
from typing import Annotated

import typer

from slam.cli.app import (
    CalibrationOption,
    ConfigOption,
    KnownMapArgument,
    LogArgument,
    OutOption,
    RecordOption,
    SetOption,
    StrictOption,
    TopicsOption,
    command,
    say,
    tell,
    topics_override,
)
from slam.cli.progress import interruptible, progress_bar


@command("localize house/ tuesday.log -o where/")
def localize(
    map_: KnownMapArgument,
    log: LogArgument,
    out: OutOption,
    config: ConfigOption = None,
    set_: SetOption = None,
    strict: StrictOption = False,
    topics: TopicsOption = None,
    calibration: CalibrationOption = None,
    record: RecordOption = None,
    start: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y YAW", help="initial pose of the robot in the map, in metres and degrees"),
    ] = None,
    start_sigma: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="M DEGREES", help="standard deviations of --start; default: 0.5 15"),
    ] = None,
    update: Annotated[
        bool,
        typer.Option("--update", help="then add the log to the map, like 'scanweave map LOG --into MAP'"),
    ] = False,
) -> None:
    """Localise the robot of a log in a saved map or a nav2 map, without changing the map."""
    started = time.perf_counter()
    from slam.app.localizing import START_SIGMA, localize_log
    from slam.config import load_config
    from slam.errors import MapFileError
    from slam.localization.drive_log import STATES
    from slam.outputs.grid_map import opened
    from slam.storage.map_file import MAP_NAME

    settings = load_config(config, [*(set_ or []), *topics_override(topics)], calibration=calibration)
    if (out / MAP_NAME).exists():
        raise MapFileError(f"{out} is the folder of a map, whose files would be replaced; give another --out")
    saved = opened(map_)
    if update and not saved.contents.node_poses:
        raise MapFileError(
            f"{saved.path} is only a grid and cannot take another log; localise without --update"
        )
    begin = None if start is None else (start[0], start[1], math.radians(start[2]))
    sigma = START_SIGMA if start_sigma is None else (start_sigma[0], math.radians(start_sigma[1]))
    with progress_bar() as show, interruptible(show) as on_progress:
        result = localize_log(
            saved,
            log,
            settings,
            start=begin,
            start_sigma=sigma,
            out=out,
            on_progress=on_progress,
            strict=strict,
            record=record,
        )
    saved.close()
    shares = ", ".join(f"{100.0 * result.drive.share_of(state):.0f} % {state.value}" for state in STATES)
    say(
        f"{len(result.drive)} scans and frames: {shares}; {len(result.trajectory)} poses; "
        f"{time.perf_counter() - started:.1f} s"
    )
    remedy = "its initial pose (--start)" if start is None else "another --start"
    unfound = f"the robot was not found in the map; a longer log or {remedy} may help"
    for warning in [*result.warnings, *([] if len(result.trajectory) else [unfound])]:
        tell(f"warning: {warning}", sys.stderr)
    say("wrote " + ", ".join(str(path) for path in result.written))
    if update:
        from slam.cli.map_log import map_into

        own_settings = settings if config or set_ else None
        map_into(log, map_, None, own_settings, strict=strict, resume=False, calibration=calibration)
