"""One self-contained report.html a comparison: who is ahead, how surely, and what each run looked like."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from slam.comparison.figures import Figure, figures_in, headline_in
from slam.comparison.page_tables import SCRIPT, STYLE, Cell, sortable, text_cell
from slam.comparison.perform import Row
from slam.comparison.pictures import distribution_png
from slam.comparison.runs import Plan
from slam.comparison.scenes import scene_sections
from slam.comparison.statistics import LEAST_PAIRS, Interval
from slam.comparison.store import ResultStore
from slam.comparison.tables import configurations_of, difference_of, median_of, values_of
from slam.evaluation.page_parts import folded, image, paragraph, section
from slam.evaluation.report_style import STYLE as PAGE_STYLE
from slam.storage.files import replacing

_ABSENT: Cell = ("–", float("nan"))


def write_page(path: Path, plan: Plan, rows: Sequence[Row], store: ResultStore) -> None:
    """Write the page as one file that asks nothing of the network.

    Raises
    ------
    MapFileError
        Where it cannot be written.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(_page(plan, list(rows), store))


def _page(plan: Plan, rows: list[Row], store: ResultStore) -> Iterator[str]:
    """The page in pieces, from the head down."""
    name = escape(plan.experiment.name)
    yield (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Scanweave: {name}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{PAGE_STYLE}{STYLE}</style></head>\n"
        f"<body><main>\n<h1><small>Scanweave comparison</small>{name}</h1>\n"
    )
    if plan.experiment.description:
        yield paragraph(plan.experiment.description)
    yield _headline(plan, rows)
    yield _faults(rows)
    yield _medians(rows)
    yield _differences(plan, rows)
    yield _distributions(rows)
    yield from scene_sections(plan, rows, store)
    yield section("All runs", _all_runs(rows) or "<p>No run.</p>")
    yield section("Versions", folded("show", _versions(plan)))
    yield f"</main><script>{SCRIPT}</script></body></html>\n"


def _headline(plan: Plan, rows: Sequence[Row]) -> str:
    """The comparison in a few numbers."""
    ended = Counter(row["status"] for row in rows)
    facts = [
        ("data sets", f"{len(plan.sources):,}"),
        ("configurations", f"{len(configurations_of(rows)):,}"),
        ("runs", f"{len(rows):,} of {len(plan.runs):,}"),
        ("without a result", f"{len(rows) - ended['ok']:,}"),
        ("process time", f"{sum(row['elapsed_s'] for row in rows) / 60.0:,.1f} min"),
        ("compared with", escape(plan.reference)),
    ]
    cells = "".join(f"<div><dt>{what}</dt><dd>{value}</dd></div>" for what, value in facts)
    return f'<dl class="facts">{cells}</dl>\n'


def _faults(rows: Sequence[Row]) -> str:
    """Runs without a result, above everything that they are missing from."""
    lines = [
        f"<li>{escape(_named(row))}: {escape(row['status'])}, {escape(row['reason'])}</li>"
        for row in rows
        if row["status"] != "ok"
    ]
    if not lines:
        return ""
    return f'<section class="warnings"><h2>Runs without a result</h2><ul>{"".join(lines)}</ul></section>\n'


def _named(row: Row) -> str:
    """A run in words."""
    return ", ".join(part for part in (row["dataset"], row["configuration"], f"seed {row['seed']}") if part)


def _medians(rows: list[Row]) -> str:
    """Medians over all runs of a configuration, with their intervals."""
    figures = headline_in(rows)
    body = []
    for name in configurations_of(rows):
        medians = [median_of(rows, name, figure) for figure in figures]
        cells = [_median_cell(figure, median) for figure, median in zip(figures, medians, strict=True)]
        runs = [row for row in rows if row["configuration"] == name]
        done = sum(row["status"] == "ok" for row in runs)
        body.append([text_cell(name), (f"{done} of {len(runs)}", float(done)), *cells])
    if not figures:
        return ""
    note = paragraph(
        "Medians; in brackets the bootstrap interval of 95 %, drawn from groups of data sets first and from "
        "the runs of each group then. Click a head to sort."
    )
    return section(
        "Configurations", note + sortable(["configuration", "runs", *(f.title for f in figures)], body)
    )


def _median_cell(figure: Figure, median: Interval | None) -> Cell:
    """A median with its interval."""
    if median is None:
        return _ABSENT
    text = figure.text(median.median)
    if median.count > 1:
        text += f" [{figure.text(median.low)}, {figure.text(median.high)}]"
    return text, median.median


def _differences(plan: Plan, rows: list[Row]) -> str:
    """Every configuration against the reference, pair by pair."""
    body = []
    for name in configurations_of(rows):
        for figure in headline_in(rows) if name != plan.reference else ():
            found = difference_of(rows, name, plan.reference, figure)
            if found is None:
                continue
            one = found.difference
            body.append(
                [
                    text_cell(name),
                    text_cell(figure.title),
                    (f"{one.median:+,.{figure.decimals}f}", one.median),
                    (f"{one.low:+,.{figure.decimals}f}" if one.count > 1 else "–", one.low),
                    (f"{one.high:+,.{figure.decimals}f}" if one.count > 1 else "–", one.high),
                    (f"{found.better} of {one.count}", found.better / one.count),
                    text_cell(found.verdict),
                ]
            )
    if not body:
        return ""
    note = paragraph(
        f"Each run minus the run of '{plan.reference}' on the same data set and seed: median of the "
        "differences with the bootstrap interval of 95 %. 'better' and 'worse' where the interval leaves out "
        f"zero, else 'undecided'; nothing is said of fewer than {LEAST_PAIRS} pairs."
    )
    head = ["configuration", "figure", "difference", "from", "to", "better in", "verdict"]
    return section(f"Compared with '{plan.reference}', pair by pair", note + sortable(head, body))


def _distributions(rows: list[Row]) -> str:
    """A plot of all values a figure."""
    pictures = []
    for figure in headline_in(rows):
        values = {
            name: list(found.values())
            for name in configurations_of(rows)
            if (found := values_of(rows, name, figure))
        }
        if values:
            png = distribution_png(values, figure.title)
            pictures.append(image(png, f"{figure.title} by configuration", css_class="plot"))
    return section("Distributions", f'<div class="pictures">{"".join(pictures)}</div>') if pictures else ""


def _all_runs(rows: list[Row]) -> str:
    """Every run with every figure."""
    figures = figures_in(rows)
    head = ["data set", "configuration", "seed", "status", *(figure.title for figure in figures), "key"]
    body = [
        [
            text_cell(row["dataset"]),
            text_cell(row["configuration"]),
            (str(row["seed"]), float(row["seed"])),
            text_cell(row["status"]),
            *(_figure_cell(figure, row) for figure in figures),
            text_cell(row["key"]),
        ]
        for row in rows
    ]
    return sortable(head, body)


def _figure_cell(figure: Figure, row: Row) -> Cell:
    """A figure of a run."""
    value = row["figures"].get(figure.name)
    return _ABSENT if value is None else (figure.text(value), float(value))


def _versions(plan: Plan) -> str:
    """What decided the results besides the experiment."""
    return sortable(
        ["library", "version"], [[text_cell(name), text_cell(told)] for name, told in plan.versions.items()]
    )
