"""scanweave demo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam.cli.app import command, folder_of, say
from slam.cli.map_log import map_log
from slam.cli.simulate import simulate_into

_ROOMS, _DURATION_S = 3, 25.0


@command()
def demo(
    out: Annotated[
        Path, typer.Option("--out", "-o", parser=folder_of, help="folder for the log and the results")
    ] = Path("demo-out"),
    seed: Annotated[int, typer.Option(min=0, help="random seed of the home and the drive")] = 1,
) -> None:
    """Simulate a robot with a lidar and four depth cameras in a furnished home, and map its log."""
    from slam.config import load_config
    from slam.errors import MapFileError
    from slam.evaluation.map_info import extent_of
    from slam.simulation.drive_faults import FAULT_PRESETS
    from slam.simulation.home import generate_home
    from slam.simulation.rigs import RIGS
    from slam.storage.map_file import MAP_NAME

    log = out / f"simulated-{seed}"
    if (out / MAP_NAME).exists() and not any(out.glob("simulated-*")):
        raise MapFileError(f"{out / MAP_NAME} is another map; give another --out")
    say(f"simulates {_DURATION_S:.0f} s of a robot in a furnished home, and maps its log: a minute or two")
    # The same seed gives the same log: what an earlier demo left is used again.
    if not (log / "scans.log").is_file():
        home = generate_home(seed, rooms=_ROOMS)
        simulate_into(log, home, RIGS["xu2024"], seed, FAULT_PRESETS["usual"], _DURATION_S, ("folder",))
    # The coloured surface is left out: the maps of the floor are what the demo is about.
    run = map_log(log, out, load_config(overrides=["dense_map.enabled=false"]), force=True)
    assert run.report is not None and run.report.beside.truth is not None
    say(f"open {out / 'report.html'} to look at it")
    error_m = run.report.beside.truth.error.translation_m.rmse
    path_m = extent_of(run.report.result.map.trajectory, run.report.sessions)["path_length_m"]
    say(f"score: {100.0 * error_m:.1f} cm ATE RMSE over {path_m:.1f} m")
