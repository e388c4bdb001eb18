"""One self-contained report.html a run: what came in, what was decided, how sure, at what cost.

Everything is passed in as plain arrays and texts, so the report draws any run and depends on none.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.evaluation import report_figures
from slam.evaluation.report_style import STYLE
from slam.measurements import BoolArray, FloatArray
from slam.storage.files import replacing

# Beyond this many rows the accepted loops are folded too, so that the page stays readable.
_MAX_OPEN_ROWS = 40


@dataclass(frozen=True, slots=True)
class LoopRow:
    """One loop candidate and what became of it.

    Attributes
    ----------
    from_keyframe, to_keyframe
        Keyframe numbers; the older one is ``to``.
    xy_from, xy_to
        Their final positions in the map frame, metres.
    score, threshold
        Of the verification; a candidate refused before it was scored has ``nan``.
    accepted
        Whether the loop holds in the final graph.
    reason
        Why it was refused; empty for an accepted one. Refusals of one kind share their words, for the
        report counts them.
    """

    from_keyframe: int
    to_keyframe: int
    xy_from: tuple[float, float]
    xy_to: tuple[float, float]
    score: float
    threshold: float
    accepted: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class MapPicture:
    """The occupancy grid as a grey picture.

    Attributes
    ----------
    image
        (rows, cols) grey values as in a nav2 map.pgm: 254 free, 0 occupied, 205 unknown. Row 0 is the
        top of the picture, the largest y.
    resolution_m
        Side of a pixel.
    origin_xy
        Outer corner of the lower-left pixel in the map frame, metres.
    """

    image: NDArray[np.uint8]
    resolution_m: float
    origin_xy: tuple[float, float]


@dataclass(frozen=True, slots=True)
class ReportData:
    """Everything that the report shows.

    Attributes
    ----------
    log_name, scans, path_length_m, duration_s
        The log: its name, how many scans were used, travel and time from first to last stamp.
    cpu_s, wall_s, peak_memory_mb
        What the run cost up to the report.
    map_picture
        The grid, or None where no map was made.
    trajectory_xy
        (N, 2) final positions in the map frame, in the order of the log.
    keyframe_stamps_s, inlier_share, residual_m, degenerate
        (K,) each, in the order of the log: the match behind every keyframe.
    scan_times_s
        (S,) time spent on each scan, in the order of the log.
    loops
        Every candidate, in the order in which they were met.
    reader_notes
        (what, how much) rows of the reader's report: dropped records by reason, clock steps.
    stage_times_s
        Wall seconds by stage, in the order to show.
    warnings
        One line each.
    effective_config
        YAML text.
    versions
        Version by library name.
    """

    log_name: str
    scans: int
    path_length_m: float
    duration_s: float
    cpu_s: float
    wall_s: float
    peak_memory_mb: float
    trajectory_xy: FloatArray
    keyframe_stamps_s: FloatArray
    inlier_share: FloatArray
    residual_m: FloatArray
    degenerate: BoolArray
    scan_times_s: FloatArray
    map_picture: MapPicture | None = None
    loops: Sequence[LoopRow] = ()
    reader_notes: Sequence[tuple[str, str]] = ()
    stage_times_s: Mapping[str, float] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    effective_config: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)


def write_report(path: Path, data: ReportData) -> None:
    """Write the report as one HTML file that asks nothing of the network.

    Raises
    ------
    MapFileError
        Where the folder is missing, not writable or full; an older report then stays as it was.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(_page(data))


def _page(data: ReportData) -> Iterator[str]:
    """The page in pieces, from the head down."""
    name = escape(data.log_name)
    yield (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Scanweave: {name}</title>\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<style>{STYLE}</style></head>\n<body><main>\n<h1><small>Scanweave report</small>{name}</h1>\n"
    )
    yield _headline(data)
    yield _warnings(data.warnings)
    yield _map(data)
    yield _scores(data)
    yield from _loops(data.loops)
    yield '<div class="columns">\n'
    yield _section(
        "Reader's report", _table(("what", "count"), data.reader_notes) or "<p>Nothing to report.</p>"
    )
    yield _section("Time by stage", _stages(data.stage_times_s) or "<p>No stage was timed.</p>")
    yield "</div>\n"
    yield _section("Effective configuration", _folded("show", f"<pre>{escape(data.effective_config)}</pre>"))
    yield _section(
        "Versions", _table(("library", "version"), data.versions.items()) or "<p>Not recorded.</p>"
    )
    yield "</main></body></html>\n"


def _headline(data: ReportData) -> str:
    """The run in ten numbers."""
    accepted = sum(loop.accepted for loop in data.loops)
    scan_ms = f"{1000.0 * float(np.median(data.scan_times_s)):.2f} ms" if data.scan_times_s.size else "–"
    real_time = f"{data.duration_s / data.wall_s:,.1f} ×" if data.wall_s > 0 else "–"
    facts = [
        ("scans", f"{data.scans:,}"),
        ("keyframes", f"{data.keyframe_stamps_s.size:,}"),
        ("loops accepted", f"{accepted:,} of {len(data.loops):,}"),
        ("path", f"{data.path_length_m:,.1f} m"),
        ("log lasts", _duration(data.duration_s)),
        ("wall time", f"{data.wall_s:,.1f} s"),
        ("CPU time", f"{data.cpu_s:,.1f} s"),
        ("median time a scan", scan_ms),
        ("real-time factor", real_time),
        ("peak memory", f"{data.peak_memory_mb:,.0f} MB"),
    ]
    cells = "".join(f"<div><dt>{what}</dt><dd>{value}</dd></div>" for what, value in facts)
    return f'<dl class="facts">{cells}</dl>\n'


def _duration(seconds: float) -> str:
    """Minutes and seconds, as a person says it."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def _warnings(warnings: Sequence[str]) -> str:
    """The warnings, above everything that they may put in doubt."""
    if not warnings:
        return ""
    lines = "".join(f"<li>{escape(warning)}</li>" for warning in warnings)
    return f'<section class="warnings"><h2>Warnings</h2><ul>{lines}</ul></section>\n'


def _map(data: ReportData) -> str:
    """The map with trajectory and accepted loops drawn in."""
    accepted = [(*loop.xy_from, *loop.xy_to) for loop in data.loops if loop.accepted]
    loops_xyxy = np.asarray(accepted, dtype=np.float64).reshape(-1, 4)
    picture = data.map_picture
    png = report_figures.map_png(
        data.trajectory_xy,
        loops_xyxy,
        image=None if picture is None else picture.image,
        resolution_m=1.0 if picture is None else picture.resolution_m,
        origin_xy=(0.0, 0.0) if picture is None else picture.origin_xy,
    )
    return _section("Map", _image(png, "map with trajectory and accepted loops"))


def _scores(data: ReportData) -> str:
    """How well the scans fitted, and what each of them cost."""
    png = report_figures.scores_png(
        data.keyframe_stamps_s, data.inlier_share, data.residual_m, data.degenerate, data.scan_times_s
    )
    degenerate = int(np.count_nonzero(data.degenerate))
    count = data.degenerate.size
    share = f"{degenerate:,} of {count:,} matches left a direction undetermined; " if count else ""
    text = f"<p>{share}such a direction is inflated in the graph, not trusted.</p>" if degenerate else ""
    return _section("Scan matching", text + _image(png, "match scores over the log", css_class="plot"))


def _loops(loops: Sequence[LoopRow]) -> Iterator[str]:
    """Every candidate: accepted ones in sight, refused ones folded, with their reasons counted."""
    accepted = [loop for loop in loops if loop.accepted]
    refused = [loop for loop in loops if not loop.accepted]
    yield f"<section><h2>Loops</h2><p>{len(accepted):,} accepted, {len(refused):,} refused.</p>\n"
    if accepted:
        rows = (_score_cells(loop) for loop in accepted)
        table = _table(("from", "to", "apart", "score", "threshold"), rows, css_class="numbers")
        folded = len(accepted) > _MAX_OPEN_ROWS
        yield _folded(f"show the {len(accepted):,} accepted loops", table) if folded else table
    if refused:
        reasons = Counter(loop.reason for loop in refused).most_common()
        yield _table(("refused because", "loops"), ((reason, f"{count:,}") for reason, count in reasons))
        rows = ((*_score_cells(loop), loop.reason) for loop in refused)
        table = _table(("from", "to", "apart", "score", "threshold", "reason"), rows, css_class="numbers")
        yield _folded(f"show the {len(refused):,} refused loops", table)
    yield "</section>\n"


def _score_cells(loop: LoopRow) -> tuple[str, ...]:
    """The numbers of one loop as text; a missing score is a dash."""
    apart_m = float(np.hypot(loop.xy_from[0] - loop.xy_to[0], loop.xy_from[1] - loop.xy_to[1]))
    numbers = (f"{value:.3f}" if np.isfinite(value) else "–" for value in (loop.score, loop.threshold))
    return (str(loop.from_keyframe), str(loop.to_keyframe), f"{apart_m:.2f} m", *numbers)


def _stages(times_s: Mapping[str, float]) -> str:
    """Stage times with a bar each, relative to the longest."""
    longest = max(times_s.values(), default=0.0) or 1.0
    rows = "".join(
        f'<tr><td>{escape(stage)}</td><td>{seconds:,.2f} s</td><td class="bar">'
        f'<i style="width:{100.0 * max(seconds, 0.0) / longest:.1f}%"></i></td></tr>'
        for stage, seconds in times_s.items()
    )
    return f'<table class="bars"><tbody>{rows}</tbody></table>' if rows else ""


def _section(title: str, content: str) -> str:
    """A titled part of the page."""
    return f"<section><h2>{escape(title)}</h2>\n{content}</section>\n"


def _folded(label: str, content: str) -> str:
    """Content that opens on a click, without a script."""
    return f"<details><summary>{escape(label)}</summary>\n{content}</details>\n"


def _image(png: bytes, description: str, css_class: str = "map") -> str:
    """A picture inside the page itself."""
    data = base64.b64encode(png).decode("ascii")
    return f'<img class="{css_class}" alt="{escape(description)}" src="data:image/png;base64,{data}">\n'


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], css_class: str = "") -> str:
    """A table of texts, or nothing without rows."""
    # The end tags of rows and cells may be left out in HTML; with thousands of rows that is a third.
    body = "\n".join("<tr><td>" + "<td>".join(map(escape, row)) for row in rows)
    if not body:
        return ""
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    return f'<table class="{css_class}"><thead><tr>{titles}</tr></thead>\n<tbody>\n{body}\n</tbody></table>\n'
