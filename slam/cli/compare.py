"""scanweave compare."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slam.cli.app import OutOption, RecordOption, command, say, tell
from slam.errors import ScanweaveError

if TYPE_CHECKING:
    from slam.comparison.perform import Row


@command("compare ablation -o study/")
def compare(
    experiment: Annotated[
        str, typer.Argument(metavar="EXPERIMENT", help="a .yaml file, or ablation, lidar2d or papers")
    ],
    out: OutOption,
    data: Annotated[
        Path | None,
        typer.Option(
            help="folder for relative paths; default: that of the experiment file, or the current one for a "
            "built-in experiment"
        ),
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="folder for simulated drives; default: OUT/drives")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="parallel runs on this machine; default: one per core")
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="address of a Dask scheduler; its workers must be able to read OUT and the data"),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="run only what has no result yet, or was stopped by a limit")
    ] = False,
    record: RecordOption = None,
) -> None:
    """Run data sets x configurations x seeds, each in its own process, and compare the results."""
    from slam.comparison.compare import compare as run_comparison
    from slam.comparison.experiment import find_experiment
    from slam.comparison.recording import record_comparison
    from slam.comparison.store import ResultStore
    from slam.viewer.viewer import recording

    if workers is not None and scheduler is not None:
        raise typer.BadParameter("--workers is for this machine; a scheduler has its own workers")
    file = find_experiment(experiment)
    with recording(record) as viewer:
        done = run_comparison(
            file,
            out,
            data=data or (None if file == Path(experiment) else Path()),
            cache=cache,
            workers=workers,
            scheduler=scheduler,
            resume=resume,
            on_row=_report,
        )
        if viewer is not None:
            record_comparison(viewer, done.rows, ResultStore(out))
    lost = [row for row in done.rows if row["status"] != "ok"]
    say(f"{len(done.rows)} runs, {done.done_now} of them now, {len(lost)} without a result")
    evo = sum(path.suffix == ".zip" for path in done.written)
    shown = [str(path) for path in done.written if path.suffix != ".zip"]
    say("wrote " + ", ".join(shown + ([f"{evo} results for evo in {out / 'evo'}"] if evo else [])))
    if done.rows and len(lost) == len(done.rows):
        raise ScanweaveError(f"no run has a result; the first: {lost[0]['reason']}")


def _report(row: Row, done: int, count: int) -> None:
    """One line a run, as it ends: on stderr, for the results are in the files."""
    name = ", ".join(part for part in (row["dataset"], row["configuration"], f"seed {row['seed']}") if part)
    reason = f" ({row['reason']})" if row["reason"] else ""
    line = f"[{done}/{count}] {name}: {row['status']}{reason}, {row['elapsed_s']:.1f} s"
    tell(line, sys.stderr)
