"""report.html of a localised drive: states and confidence over time, the way over the map, what it cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slam.evaluation.figure_parts import BLUE, GREY, ORANGE, RED, figure_of, plain, png_of
from slam.evaluation.pages import write_page
from slam.evaluation.report_figures import MapPicture, map_png
from slam.localization.drive_log import STATES, DriveLog
from slam.localization.output import State
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import FloatArray

_COLORS: Mapping[State, str] = {State.SEARCHING: GREY, State.TRACKING: BLUE, State.LOST: RED}


def write_localization_report(
    path: Path, title: str, drive: DriveLog, grid: OccupancyGrid | None, notes: Sequence[tuple[str, str]]
) -> None:
    """Write the report as one HTML file that asks nothing of the network.

    Parameters
    ----------
    title
        The log and the map.
    grid
        Of the map; None of a map without a lidar.
    notes
        (what, how much) rows of the reader's report.

    Raises
    ------
    MapFileError
        Where the folder is missing, not writable or full; an older report then stays as it was.
    """
    write_page(
        path,
        "localization.html",
        title=title,
        kind="localisation",
        shares=_shares(drive),
        map_png=_map_png(drive, grid),
        time_png=_time_png(drive),
        cost=_cost(drive),
        notes=notes,
    )


def _shares(drive: DriveLog) -> list[tuple[str, str]]:
    """Share of the measurements in every state, and the poses that were filled in later."""
    rows = [(state.value, f"{100.0 * drive.share_of(state):.1f} %") for state in STATES]
    tracked = int(np.count_nonzero(drive.states == STATES.index(State.TRACKING)))
    later = len(drive.trajectory()) - tracked
    return [*rows, ("poses found later, by going back from where it was found", f"{later:,}")]


def _cost(drive: DriveLog) -> str:
    """Time a measurement, and of the slowest."""
    if not len(drive):
        return "Nothing was localised."
    median, greatest = 1000.0 * np.median(drive.seconds), 1000.0 * drive.seconds.max()
    rate = len(drive) / drive.seconds.sum()
    return (
        f"{median:.1f} ms a measurement (median), {greatest:.0f} ms at most, {rate:.0f} a second on average."
    )


def _map_png(drive: DriveLog, grid: OccupancyGrid | None) -> bytes:
    """The trajectory over the grid."""
    picture = None if grid is None else MapPicture.of(grid.states(), grid.resolution_m, grid.T_map_grid)
    return map_png(drive.trajectory().positions_m[:, :2], np.zeros((0, 4)), picture)


def _time_png(drive: DriveLog) -> bytes:
    """Confidence, coloured by state, and support below it."""
    figure = figure_of(1000, 460)
    below = figure.add_axes((0.065, 0.10, 0.92, 0.38))
    above = figure.add_axes((0.065, 0.54, 0.92, 0.38), sharex=below)
    elapsed_s: FloatArray = drive.stamps_s - drive.stamps_s.min(initial=np.inf)
    for number, state in enumerate(STATES):
        here = drive.states == number
        above.plot(
            elapsed_s[here],
            drive.confidences[here],
            linestyle="none",
            marker="o",
            markersize=2,
            color=_COLORS[state],
            label=state.value,
        )
    above.set(ylabel="confidence", ylim=(-0.03, 1.03))
    above.legend(loc="lower left", bbox_to_anchor=(-0.01, 0.985), ncols=3, fontsize=8, frameon=False)
    below.plot(elapsed_s, drive.supports, linestyle="none", marker="o", markersize=2, color=ORANGE)
    below.set(ylabel="share that the map explains", xlabel="time, s", ylim=(-0.03, 1.03))
    for axes in (above, below):
        plain(axes)
    return png_of(figure)
