"""The metrics of a run: their names in the tables, their units, and which direction is better."""

from __future__ import annotations

import re
from dataclasses import dataclass

from slam.comparison.perform import Row

# Name: title, decimals, whether smaller is better (None if neither).
_KNOWN: dict[str, tuple[str, int, bool | None]] = {
    "ate_m": ("ATE RMSE, m", 4, True),
    "ate_median_m": ("ATE median, m", 4, True),
    "ate_max_m": ("ATE greatest, m", 4, True),
    "ate_deg": ("ATE rotation, degrees", 3, True),
    "relations_m": ("relations, m", 4, True),
    "relations_std_m": ("relations spread, m", 4, True),
    "relations_deg": ("relations, degrees", 3, True),
    "relations_short_m": ("relations under 20 s, m", 4, True),
    "relations_long_m": ("relations over 20 s, m", 4, True),
    "relations_used": ("relations used", 0, None),
    "map_completeness": ("map complete", 3, False),
    "map_false_occupied": ("map falsely occupied", 3, True),
    "map_f1": ("map F1", 3, False),
    "map_collide": ("plans that collide", 3, True),
    "map_collide_hard": ("plans that hit with the middle", 3, True),
    "map_reach": ("reached of what can be reached", 3, False),
    "map_reach_near": ("reached within 4 m of the way", 3, False),
    "map_danger": ("cells falsely free", 0, True),
    "plane_completeness": ("lidar plane complete", 3, False),
    "plane_false_occupied": ("lidar plane falsely occupied", 3, True),
    "plane_f1": ("lidar plane F1", 3, False),
    "loop_precision": ("loop precision", 3, False),
    "loop_recall": ("loop recall", 3, False),
    "loops": ("loops", 0, None),
    "loops_tried": ("loops tried", 0, None),
    "real_time_factor": ("x real time", 1, False),
    "wall_s": ("wall, s", 1, True),
    "cpu_s": ("CPU, s", 1, True),
    "peak_mb": ("peak memory, MB", 0, True),
}
# The page shows medians and plots of these; the others are in its table of all runs.
HEADLINE = (
    *("relations_m", "relations_deg", "ate_m", "rpe", "map_f1", "map_completeness", "map_false_occupied"),
    *("map_collide", "map_reach", "map_reach_near", "map_danger"),
    *("loop_precision", "loop_recall", "real_time_factor", "cpu_s", "peak_mb"),
)
_RPE = re.compile(r"^rpe_([0-9.e+-]+)m_(m|deg)$")


@dataclass(frozen=True, slots=True)
class Figure:
    """How a metric is shown.

    Attributes
    ----------
    name, title
        Name in files, and title for the user.
    decimals
        Number of decimals shown.
    smaller_is_better
        None if neither is better, or unknown.
    """

    name: str
    title: str
    decimals: int
    smaller_is_better: bool | None

    def text(self, value: float) -> str:
        """A value as text; a dash if there is none."""
        return f"{value:,.{self.decimals}f}" if value == value else "–"


def figure_of(name: str) -> Figure:
    """The metric with a name; metrics of a user's program have their name as title."""
    if match := _RPE.match(name):
        unit = "m" if match[2] == "m" else "degrees"
        return Figure(name, f"RPE over {match[1]} m, {unit}", 4 if unit == "m" else 3, True)
    title, decimals, smaller = _KNOWN.get(name, (name, 4, None))
    return Figure(name, title, decimals, smaller)


def figures_in(rows: list[Row]) -> list[Figure]:
    """All metrics in any row: known ones in their usual order, then others as they appear."""
    present = list(dict.fromkeys(name for row in rows for name in row["figures"]))
    known = [name for name in _KNOWN if name in present]
    rpe = [name for name in present if _RPE.match(name)]
    at = next((n for n, name in enumerate(known) if name.startswith(("relations", "map"))), len(known))
    ordered = [*known[:at], *rpe, *known[at:]]
    return [figure_of(name) for name in [*ordered, *(name for name in present if name not in ordered)]]


def headline_in(rows: list[Row]) -> list[Figure]:
    """The metrics that the page shows first; all metrics if they come from a user's program."""
    figures = figures_in(rows)
    return [
        figure
        for name in HEADLINE
        for figure in figures
        if figure.name == name or (name == "rpe" and _RPE.match(figure.name) and figure.name.endswith("_m"))
    ]
