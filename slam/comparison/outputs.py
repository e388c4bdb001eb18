"""Output files of a comparison: tables, the page, and results for evo."""

from __future__ import annotations

from pathlib import Path

from slam.comparison.evo_results import write_evo_results
from slam.comparison.page import write_page
from slam.comparison.perform import Row
from slam.comparison.runs import Plan
from slam.comparison.store import ResultStore
from slam.comparison.tables import write_tables


def write_outputs(out: Path, plan: Plan, rows: list[Row]) -> list[Path]:
    """Write ``results.csv``, ``results.parquet``, ``report.html`` and ``evo/``.

    Raises
    ------
    MapFileError
        If one cannot be written.
    """
    store = ResultStore(out)
    written = write_tables(out, rows)
    written += write_evo_results(out / "evo", rows, store)
    write_page(out / "report.html", plan, rows, store)
    return [*written, out / "report.html"]
