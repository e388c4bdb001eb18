"""Results as tables: results.csv and results.parquet, one line per run, and the medians of the page."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.comparison.figures import Figure, figures_in
from slam.comparison.perform import Row
from slam.comparison.statistics import Interval, PairedDifference, interval_of, paired
from slam.storage.files import replacing, write_bytes

TOLD = ("dataset", "group", "configuration", "method", "seed", "status", "reason")
LAST = ("elapsed_s", "host", "key")


def columns_of(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Columns of the flat table; a metric that a run does not have is None."""
    columns: dict[str, list[Any]] = {name: [row[name] for row in rows] for name in TOLD}
    for figure in figures_in(list(rows)):
        columns[figure.name] = [row["figures"].get(figure.name) for row in rows]
    columns["warnings"] = ["; ".join(row["warnings"]) for row in rows]
    return columns | {name: [row[name] for row in rows] for name in LAST}


def write_tables(folder: Path, rows: Sequence[Row]) -> list[Path]:
    """Write ``results.csv`` and ``results.parquet``.

    Raises
    ------
    MapFileError
        If they cannot be written.
    """
    columns = columns_of(rows)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows(zip(*columns.values(), strict=True))
    write_bytes(folder / "results.csv", text.getvalue().encode())
    _write_parquet(folder / "results.parquet", columns)
    return [folder / "results.csv", folder / "results.parquet"]


def _write_parquet(path: Path, columns: dict[str, list[Any]]) -> None:
    """Write metrics as doubles, seeds as integers, everything else as text, also for an empty table."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    texts = {*TOLD, *LAST, "warnings"} - {"seed", "elapsed_s"}
    types = {
        name: pa.string() if name in texts else pa.int64() if name == "seed" else pa.float64()
        for name in columns
    }
    arrays = [pa.array(values, type=types[name]) for name, values in columns.items()]
    with replacing(path) as temporary:
        pq.write_table(pa.table(arrays, names=list(columns)), temporary)


def configurations_of(rows: Sequence[Row]) -> list[str]:
    """Names in the order of the experiment."""
    return list(dict.fromkeys(row["configuration"] for row in rows))


def values_of(rows: Sequence[Row], configuration: str, figure: Figure) -> dict[tuple[str, str, int], float]:
    """A configuration's values of a metric by group, data set and seed."""
    return {
        (row["group"], row["dataset"], row["seed"]): row["figures"][figure.name]
        for row in rows
        if row["configuration"] == configuration and np.isfinite(row["figures"].get(figure.name, np.nan))
    }


def median_of(rows: Sequence[Row], configuration: str, figure: Figure) -> Interval | None:
    """A configuration's median with its interval; None if it has no value."""
    groups: dict[str, list[float]] = {}
    for (group, _, _), value in values_of(rows, configuration, figure).items():
        groups.setdefault(group, []).append(value)
    return interval_of(groups) if groups else None


def difference_of(
    rows: Sequence[Row], configuration: str, reference: str, figure: Figure
) -> PairedDifference | None:
    """Compare a configuration with the reference; None without a common data set or a better direction."""
    if figure.smaller_is_better is None:
        return None
    return paired(
        values_of(rows, configuration, figure),
        values_of(rows, reference, figure),
        smaller_is_better=figure.smaller_is_better,
    )
