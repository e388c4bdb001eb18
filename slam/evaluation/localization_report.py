"""report.html of a localised log: the path on the map, states and confidence over time, and the cost."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slam.evaluation.page_charts import chart
from slam.evaluation.page_data import way_data
from slam.evaluation.page_layers import layer_pictures
from slam.evaluation.pages import write_page
from slam.evaluation.work_page import WorkPage, work_page
from slam.localization.drive_log import STATES, DriveLog
from slam.localization.output import State
from slam.mapping.layered_map import LayeredMap
from slam.measurements import FloatArray

# Colours of the states: searching, tracking, lost.
_COLORS = ("soft", "blue", "red")


def write_localization_report(
    path: Path,
    title: str,
    drive: DriveLog,
    layers: LayeredMap | None,
    notes: Sequence[tuple[str, str]],
    warnings: Sequence[str] = (),
) -> None:
    """Write the report as one HTML file that needs no network.

    Parameters
    ----------
    layers
        Of the map; None of a map without a lidar.
    notes
        (what, how much) rows of records.
    warnings
        What makes the poses doubtful, in words.

    Raises
    ------
    MapFileError
        If the folder is missing, not writable or full; an older report then stays as it was.
    """
    page = _page(title, drive, layers)
    write_page(
        path,
        "localization.html",
        scripts=page.scripts,
        styles=page.styles,
        page=page,
        title=title,
        kind="localisation",
        shares=_shares(drive),
        cost=_cost(drive),
        notes=notes,
        lines=warnings,
    )


def _page(title: str, drive: DriveLog, layers: LayeredMap | None) -> WorkPage:
    """Return the data of the plan with the path."""
    sigmas = drive.sigmas()
    positions, yaws = (drive.of_trajectory(values).astype(np.float32) for values in sigmas)
    path, limits, chosen = way_data(drive.trajectory(), (positions, yaws))
    found_later = np.isnan(drive.of_trajectory(np.zeros(len(drive))))[chosen]
    columns = [("confidence", drive.confidences), ("share that the map explains", drive.supports)]
    path["more"] = [
        {
            "name": name.split(" ")[0],
            "title": name,
            "unit": "",
            "range": [0, 1],
            "values": drive.of_trajectory(values)[chosen],
        }
        for name, values in columns
    ]
    column = {
        "name": "found",
        "title": "when it was found",
        "classes": ["at once", "later, from when the robot was found"],
    }
    path["more"].append({**column, "values": found_later.astype(np.uint8)})
    head: dict[str, Any] = {
        "kind": "localization",
        "title": title,
        "planar": True,
        "unit": "measurement",
        "sessions": [title],
        "trajectory": path,
        "layers": layer_pictures(layers),
        "limits": limits,
        "charts": _charts(drive, sigmas),
    }
    return work_page(head, "Path in the map")


def _charts(drive: DriveLog, sigmas: tuple[FloatArray, FloatArray]) -> list[dict[str, Any]]:
    """Return charts of confidence by state, support, sigma and cost over time."""
    if not len(drive):
        return []
    since = drive.stamps_s - drive.stamps_s.min()
    states = {
        state.value: np.where(drive.states == number, drive.confidences, np.nan)
        for number, state in enumerate(STATES)
    }
    rows = [
        ("Share that the map explains", drive.supports, 1.0),
        ("Sigma of the position, cm", 100.0 * sigmas[0], None),
        ("Time per measurement, ms", 1000.0 * drive.seconds, None),
    ]
    charts = [chart("Confidence", "time, s", since, states, most=1.0, colors=_COLORS)]
    return charts + [
        chart(title, "time, s", since, {title: values}, **({} if most is None else {"most": most}))
        for title, values, most in rows
    ]


def _shares(drive: DriveLog) -> list[tuple[str, str]]:
    """Return the share of measurements in every state, and the poses recovered later."""
    rows = [(state.value, f"{100.0 * drive.share_of(state):.1f} %") for state in STATES]
    tracked = int(np.count_nonzero(drive.states == STATES.index(State.TRACKING)))
    later = len(drive.trajectory()) - tracked
    return [*rows, ("poses of earlier moments, found later", f"{later:,}")]


def _cost(drive: DriveLog) -> str:
    """Return the time per measurement, and that of the slowest."""
    if not len(drive):
        return "Nothing was localised."
    median, greatest = 1000.0 * np.median(drive.seconds), 1000.0 * drive.seconds.max()
    rate = len(drive) / drive.seconds.sum()
    return f"{median:.1f} ms per measurement (median), {greatest:.0f} ms at most, {rate:.0f} per second."
