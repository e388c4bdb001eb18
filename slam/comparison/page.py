"""One self-contained report.html per comparison: ranking, significance, and pictures of each run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from slam.comparison.figures import Figure, figures_in, headline_in
from slam.comparison.perform import Row
from slam.comparison.pictures import distribution_png
from slam.comparison.runs import Plan
from slam.comparison.scenes import scenes
from slam.comparison.statistics import LEAST_PAIRS, Interval
from slam.comparison.store import ResultStore
from slam.comparison.tables import configurations_of, difference_of, median_of, values_of
from slam.evaluation import pages

# With more data sets, their pictures are collapsed, so that the page remains readable.
_MOST_OPEN = 4
# A text, or a text and the number to sort by.
Cell: TypeAlias = str | tuple[str, float]

_ABSENT: Cell = ("–", float("nan"))


def write_page(path: Path, plan: Plan, rows: Sequence[Row], store: ResultStore) -> None:
    """Write the page as one file without network access.

    Raises
    ------
    MapFileError
        If it cannot be written.
    """
    rows = list(rows)
    headline, figures = headline_in(rows), figures_in(rows)
    pages.write_page(
        path,
        "comparison.html",
        scripts=["sort.js"],
        title=plan.experiment.name,
        kind="comparison",
        plan=plan,
        headline=_headline(plan, rows),
        faults=[f"{_named(row)}: {row['status']}, {row['reason']}" for row in rows if row["status"] != "ok"],
        figures=[figure.title for figure in headline],
        medians=[_medians(rows, name, headline) for name in configurations_of(rows)],
        differences=_differences(plan, rows, headline),
        least_pairs=LEAST_PAIRS,
        distributions=_distributions(rows, headline),
        scenes=list(scenes(plan, rows, store)),
        many_scenes=len(plan.sources) > _MOST_OPEN,
        run_heads=["data set", "configuration", "seed", "status", *(one.title for one in figures), "key"],
        runs=[_run_cells(row, figures) for row in rows],
        versions=list(plan.versions.items()),
    )


def _headline(plan: Plan, rows: Sequence[Row]) -> list[tuple[str, str]]:
    """The comparison in a few numbers."""
    without = sum(row["status"] != "ok" for row in rows)
    return [
        ("data sets", f"{len(plan.sources):,}"),
        ("configurations", f"{len(configurations_of(rows)):,}"),
        ("runs", f"{len(rows):,} of {len(plan.runs):,}"),
        ("without a result", f"{without:,}"),
        ("process time", f"{sum(row['elapsed_s'] for row in rows) / 60.0:,.1f} min"),
        ("compared with", plan.reference),
    ]


def _named(row: Row) -> str:
    """The name of a run."""
    return ", ".join(part for part in (row["dataset"], row["configuration"], f"seed {row['seed']}") if part)


def _medians(rows: list[Row], name: str, figures: Sequence[Figure]) -> list[Cell]:
    """Medians over all runs of a configuration, with their intervals."""
    runs = [row for row in rows if row["configuration"] == name]
    done = sum(row["status"] == "ok" for row in runs)
    medians = (_median_cell(figure, median_of(rows, name, figure)) for figure in figures)
    return [name, (f"{done} of {len(runs)}", float(done)), *medians]


def _median_cell(figure: Figure, median: Interval | None) -> Cell:
    """A median with its interval."""
    if median is None:
        return _ABSENT
    text = figure.text(median.median)
    if median.count > 1:
        text += f" [{figure.text(median.low)}, {figure.text(median.high)}]"
    return text, median.median


def _differences(plan: Plan, rows: list[Row], figures: Sequence[Figure]) -> list[list[Cell]]:
    """Every configuration compared with the reference, pair by pair."""
    body: list[list[Cell]] = []
    for name in configurations_of(rows):
        for figure in figures if name != plan.reference else ():
            difference = difference_of(rows, name, plan.reference, figure)
            if difference is None:
                continue
            median = difference.difference
            texts = [f"{value:+,.{figure.decimals}f}" for value in (median.median, median.low, median.high)]
            ends = texts[1:] if median.count > 1 else ["–", "–"]
            better = (f"{difference.better} of {median.count}", difference.better / median.count)
            numbers = [(texts[0], median.median), (ends[0], median.low), (ends[1], median.high), better]
            body.append([name, figure.title, *numbers, difference.verdict])
    return body


def _distributions(rows: list[Row], figures: Sequence[Figure]) -> list[tuple[str, bytes]]:
    """A plot of all values per metric."""
    pictures = []
    for figure in figures:
        values = {
            name: list(sample.values())
            for name in configurations_of(rows)
            if (sample := values_of(rows, name, figure))
        }
        if values:
            pictures.append((figure.title, distribution_png(values, figure.title)))
    return pictures


def _run_cells(row: Row, figures: Sequence[Figure]) -> list[Cell]:
    """Cells of a run with all metrics."""
    cells = (
        _ABSENT if (value := row["figures"].get(figure.name)) is None else (figure.text(value), float(value))
        for figure in figures
    )
    seed = (str(row["seed"]), float(row["seed"]))
    return [row["dataset"], row["configuration"], seed, row["status"], *cells, row["key"]]
