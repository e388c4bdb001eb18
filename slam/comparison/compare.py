"""Runs a comparison, from the experiment file to its tables and its page."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slam.comparison.cluster import check_installed, client_of, run_all
from slam.comparison.experiment import load_experiment
from slam.comparison.outputs import write_outputs
from slam.comparison.perform import Row
from slam.comparison.runs import Plan, plan_of
from slam.comparison.store import ResultStore
from slam.storage.files import make_folder


@dataclass(frozen=True, slots=True)
class Comparison:
    """A finished comparison.

    Attributes
    ----------
    plan
        The planned runs.
    rows
        One row per run, in the order of the plan.
    done_now
        Number of runs done now, because they had no result before.
    written
        Written files: tables, page, and results for evo.
    """

    plan: Plan
    rows: list[Row]
    done_now: int
    written: list[Path]


def compare(
    experiment: Path,
    out: Path,
    *,
    data: Path | None = None,
    cache: Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    resume: bool = False,
    on_row: Callable[[Row, int, int], None] | None = None,
) -> Comparison:
    """Do all runs of an experiment and write the results.

    Parameters
    ----------
    out
        Folder for results; created if missing. With ``scheduler``, all workers must see it under this path.
    data
        Base folder of relative paths; the folder of the experiment file if None.
    cache
        Folder of simulated drives; ``out/drives`` if None.
    workers
        Number of parallel runs on this machine; the number of cores if None.
    scheduler
        Address of a Dask scheduler, instead of this machine.
    resume
        Keep existing results, except those of runs that were stopped by a limit or killed.
    on_row
        Called with each new row, the number of finished runs and their total number.

    Raises
    ------
    ScanweaveError
        If the experiment does not fit, a file is missing, a library is not installed, or the scheduler
        does not answer. A run that fails is a row, not an error.
    """
    check_installed()
    plan = plan_of(load_experiment(experiment), data or experiment.parent, cache or out / "drives")
    make_folder(out)
    store = ResultStore(out)
    missing = store.missing([run.key for run in plan.runs], resume=resume)
    todo = [run for run in plan.runs if run.key in missing]
    if todo:
        with client_of(workers or os.cpu_count() or 1, scheduler) as client:
            done: list[Row] = []

            def reported(row: Row) -> None:
                done.append(row)
                if on_row:
                    on_row(row, len(done), len(todo))

            run_all(client, todo, plan.sources, out, reported)
        store.sweep()
    rows = [row for run in plan.runs if (row := store.row(run.key)) is not None]
    return Comparison(plan, rows, len(todo), write_outputs(out, plan, rows))
