"""scanweave simulate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli.app import command, folder_of, say
from slam.cli.progress import progress_bar

if TYPE_CHECKING:
    from slam.simulation.drive_faults import DriveFaults
    from slam.simulation.home_model import Home
    from slam.simulation.record import DriveSummary
    from slam.simulation.rigs import Rig


@command()
def simulate(
    out: Annotated[
        Path, typer.Option("--out", "-o", parser=folder_of, help="folder for the log; must be empty or new")
    ],
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
    from slam.simulation.record import FORMATS
    from slam.simulation.rigs import RIGS

    if rig not in RIGS:
        raise ConfigError(f"no rig '{rig}'; there are {', '.join(sorted(RIGS))}")
    if faults not in FAULT_PRESETS:
        raise ConfigError(f"no fault preset '{faults}'; there are {', '.join(FAULT_PRESETS)}")
    summary = simulate_into(
        out,
        generate_home(home, "office" if office else "home"),
        RIGS[rig],
        seed,
        FAULT_PRESETS[faults],
        duration,
        tuple(formats) if formats else FORMATS,
    )
    counts = ", ".join(f"{count} {name}" for name, count in summary.counts.items())
    say(f"{summary.duration_s:.0f} s, {summary.path_m:.1f} m through {len(summary.rooms)} rooms: {counts}")
    say(f"wrote {summary.folder}")


def simulate_into(
    out: Path,
    home: Home,
    rig: Rig,
    seed: int,
    faults: DriveFaults | None,
    duration_s: float | None,
    formats: tuple[str, ...],
) -> DriveSummary:
    """Record a drive, and show how far it is."""
    from slam.app.progress import Progress
    from slam.simulation.record import record_drive

    with progress_bar("s driven") as show:

        def on_progress(done_s: float, all_s: float) -> None:
            show(Progress("simulating", int(done_s), done_s / all_s))

        return record_drive(home, rig, seed, out, faults, duration_s, on_progress, formats=formats)
