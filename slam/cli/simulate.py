"""scanweave simulate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from slam.cli.app import app
from slam.cli.progress import progress_of


@app.command()
def simulate(
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the log; must be empty or new")],
    rig: Annotated[
        str,
        typer.Option(help="which robot; a wrong name lists them"),
    ] = "xu2024",
    home: Annotated[int, typer.Option(min=0, help="which home: the seed of its plan and furniture")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="which drive: the seed of tour, noise and faults")] = 0,
    office: Annotated[bool, typer.Option("--office", help="an office instead of a home")] = False,
    duration: Annotated[
        float | None, typer.Option(min=1.0, help="seconds; one tour through all rooms if not given")
    ] = None,
    faults: Annotated[str, typer.Option(help="clocks, losses, people: none, usual or harsh")] = "usual",
    formats: Annotated[
        list[str] | None, typer.Option("--format", help="folder (CARMEN + TUM) or mcap; both if not given")
    ] = None,
) -> None:
    """Drive a simulated robot through a furnished home and record its sensors with the truth."""
    from slam.errors import ConfigError
    from slam.simulation.drive_faults import FAULT_PRESETS
    from slam.simulation.home import generate_home
    from slam.simulation.record import FORMATS, record_drive
    from slam.simulation.rigs import RIGS

    if rig not in RIGS:
        raise ConfigError(f"no rig '{rig}'; there are {', '.join(sorted(RIGS))}")
    if faults not in FAULT_PRESETS:
        raise ConfigError(f"no fault preset '{faults}'; there are {', '.join(FAULT_PRESETS)}")
    with progress_of("simulating", "s") as progress:
        summary = record_drive(
            generate_home(home, "office" if office else "home"),
            RIGS[rig],
            seed,
            out,
            FAULT_PRESETS[faults],
            duration,
            lambda done_s, _: progress(int(done_s)),
            formats=tuple(formats) if formats else FORMATS,
        )
    counts = ", ".join(f"{count} {name}" for name, count in summary.counts.items())
    print(f"{summary.duration_s:.0f} s, {summary.path_m:.1f} m through {len(summary.rooms)} rooms: {counts}")
    print(f"wrote {summary.folder}")
