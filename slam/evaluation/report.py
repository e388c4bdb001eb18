"""One self-contained report.html a run: what came in, what was decided, how sure, at what cost.

Everything is passed in as plain arrays and texts, so the report draws any run and depends on none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slam.evaluation import report_figures
from slam.evaluation.cloud_picture import CloudPicture
from slam.evaluation.fusion_figures import fusion_section
from slam.evaluation.page_parts import folded, image, paragraph, section, table
from slam.evaluation.report_cameras import CameraRow, camera_sections, cloud_section, side_view, truth_section
from slam.evaluation.report_style import STYLE
from slam.evaluation.truth_comparison import TruthComparison
from slam.mapper.keyframe_fusion import FusionSummary
from slam.measurements import BoolArray, FloatArray
from slam.storage.files import replacing

# Beyond this many rows the accepted loops are folded too, so that the page stays readable.
_MAX_OPEN_ROWS = 40

_FREE_GREY, LIDAR_HEIGHT_GREY = 254, 232
_MAP_LEGEND = "The map to drive by: black is what the robot must not hit, white is free, grey is unknown."
_LAYER_LEGENDS = {
    "lidar": "The lidar alone, at its own height (layers/lidar.yaml).",
    "depth": "The cameras alone, within the robot's height (layers/depth.yaml).",
    "fused": "Both as one probability: unknown where they contradict each other (layers/fused.yaml).",
}


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
    """A grid as a grey picture.

    Attributes
    ----------
    image
        (rows, cols) grey values as in a nav2 map.pgm: 254 free, 0 occupied, 205 unknown; and
        `LIDAR_HEIGHT_GREY`, free at the height of the lidar only. Row 0 is the top, the largest y.
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
        The log: its name, how many scans or frames were used, travel and time from first to last stamp.
    cpu_s, wall_s, peak_memory_mb
        What the run cost up to the report.
    map_picture
        The map to drive by, or None where no map was made.
    layers
        What it was made of, by name, all of one size; nothing where the lidar's grid is the map.
    trajectory_m
        (N, 3) final positions in the map frame, in the order of the log.
    keyframe_stamps_s, inlier_share, residual_m, degenerate
        (K,) each, in the order of the log: the match behind every keyframe.
    scan_times_s
        (S,) time spent on each scan or frame, in the order of the log.
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
    unit
        What the map was made of: ``scan``, or ``frame`` where there were only cameras.
    spatial
        Whether the trajectory leaves the floor.
    cameras
        What became of every camera's frames.
    truth
        The trajectory against its truth; None where the log has none.
    cloud
        The coloured cloud from above; None where there is none.
    fused
        What scans and depth images repaired of each other; None where there were not both.
    """

    log_name: str
    scans: int
    path_length_m: float
    duration_s: float
    cpu_s: float
    wall_s: float
    peak_memory_mb: float
    trajectory_m: FloatArray
    keyframe_stamps_s: FloatArray
    inlier_share: FloatArray
    residual_m: FloatArray
    degenerate: BoolArray
    scan_times_s: FloatArray
    map_picture: MapPicture | None = None
    layers: Mapping[str, MapPicture] = field(default_factory=dict)
    loops: Sequence[LoopRow] = ()
    reader_notes: Sequence[tuple[str, str]] = ()
    stage_times_s: Mapping[str, float] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    effective_config: str = ""
    versions: Mapping[str, str] = field(default_factory=dict)
    unit: Literal["scan", "frame"] = "scan"
    spatial: bool = False
    cameras: Sequence[CameraRow] = ()
    truth: TruthComparison | None = None
    cloud: CloudPicture | None = None
    fused: FusionSummary | None = None


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
    yield cloud_section(data.cloud) if data.cloud is not None else ""
    yield truth_section(data.truth, spatial=data.spatial) if data.truth is not None else ""
    yield from camera_sections(data.cameras)
    yield fusion_section(data.fused) if data.fused is not None else ""
    yield _scores(data)
    yield from _loops(data.loops)
    yield '<div class="columns">\n'
    yield section(
        "Reader's report", table(("what", "count"), data.reader_notes) or "<p>Nothing to report.</p>"
    )
    yield section("Time by stage", _stages(data.stage_times_s) or "<p>No stage was timed.</p>")
    yield "</div>\n"
    yield section("Effective configuration", folded("show", f"<pre>{escape(data.effective_config)}</pre>"))
    yield section("Versions", table(("library", "version"), data.versions.items()) or "<p>Not recorded.</p>")
    yield "</main></body></html>\n"


def _headline(data: ReportData) -> str:
    """The run in a few numbers."""
    accepted = sum(loop.accepted for loop in data.loops)
    scan_ms = f"{1000.0 * float(np.median(data.scan_times_s)):.2f} ms" if data.scan_times_s.size else "–"
    real_time = f"{data.duration_s / data.wall_s:,.1f} ×" if data.wall_s > 0 else "–"
    facts = [
        (f"{data.unit}s", f"{data.scans:,}"),
        ("keyframes", f"{data.keyframe_stamps_s.size:,}"),
        ("loops accepted", f"{accepted:,} of {len(data.loops):,}"),
        ("path", f"{data.path_length_m:,.1f} m"),
        ("log lasts", _duration(data.duration_s)),
        ("wall time", f"{data.wall_s:,.1f} s"),
        ("CPU time", f"{data.cpu_s:,.1f} s"),
        (f"median time a {data.unit}", scan_ms),
        ("real-time factor", real_time),
        ("peak memory", f"{data.peak_memory_mb:,.0f} MB"),
    ]
    if data.truth is not None:
        facts.append(("RMSE against the truth", f"{data.truth.error.translation_m.rmse:.3f} m"))
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
        data.trajectory_m[:, :2],
        loops_xyxy,
        image=None if picture is None else picture.image,
        resolution_m=1.0 if picture is None else picture.resolution_m,
        origin_xy=(0.0, 0.0) if picture is None else picture.origin_xy,
    )
    above = image(png, "map with trajectory and accepted loops")
    if data.spatial and len(data.trajectory_m):
        return section("Trajectory from above and from the side", above + side_view(data.trajectory_m))
    if picture is None:
        return section("Trajectory", above)
    return section("Map", paragraph(_map_legend(picture)) + above + _layers(data.layers, picture))


def _map_legend(picture: MapPicture) -> str:
    """What the greys mean, and how much of the floor is free; of what only the lidar saw free, how much."""
    free_m2, lidar_m2 = (
        picture.resolution_m**2 * np.count_nonzero(picture.image == grey)
        for grey in (_FREE_GREY, LIDAR_HEIGHT_GREY)
    )
    if not lidar_m2:
        return f"{_MAP_LEGEND} Free: {free_m2:.1f} m²."
    return (
        f"{_MAP_LEGEND} Light grey is free at the height of the lidar only, no camera saw all heights of the "
        f"robot there; layers.rule tells whether it may drive there. Free: {free_m2:.1f} m²; at the height "
        f"of the lidar only: {lidar_m2:.1f} m²."
    )


def _layers(layers: Mapping[str, MapPicture], decision: MapPicture) -> str:
    """What the map was made of, in small."""
    if not layers:
        return ""
    window = report_figures.known_window(decision.image)
    figures = "".join(
        f"<figure>{image(report_figures.small_map_png(layer.image[window]), f'{name} layer')}"
        f"<figcaption>{escape(_LAYER_LEGENDS[name])}</figcaption></figure>\n"
        for name, layer in layers.items()
    )
    return f'<div class="layers">{figures}</div>\n'


def _scores(data: ReportData) -> str:
    """How well the scans fitted, and what each of them cost; how frames fitted is told by camera."""
    times = image(
        report_figures.times_png(data.scan_times_s, data.unit), f"time a {data.unit}", css_class="plot"
    )
    if data.unit == "frame":
        return section("Time a frame", times)
    png = report_figures.scores_png(
        data.keyframe_stamps_s, data.inlier_share, data.residual_m, data.degenerate
    )
    degenerate = int(np.count_nonzero(data.degenerate))
    count = data.degenerate.size
    share = f"{degenerate:,} of {count:,} matches left a direction undetermined; " if count else ""
    text = f"<p>{share}such a direction is inflated in the graph, not trusted.</p>" if degenerate else ""
    plots = image(png, "match scores over the log", css_class="plot")
    return section("Scan matching", text + plots + times)


def _loops(loops: Sequence[LoopRow]) -> Iterator[str]:
    """Every candidate: accepted ones in sight, refused ones folded, with their reasons counted."""
    accepted = [loop for loop in loops if loop.accepted]
    refused = [loop for loop in loops if not loop.accepted]
    yield f"<section><h2>Loops</h2><p>{len(accepted):,} accepted, {len(refused):,} refused.</p>\n"
    if accepted:
        rows = (_score_cells(loop) for loop in accepted)
        all_rows = table(("from", "to", "apart", "score", "threshold"), rows, css_class="numbers")
        many = len(accepted) > _MAX_OPEN_ROWS
        yield folded(f"show the {len(accepted):,} accepted loops", all_rows) if many else all_rows
    if refused:
        reasons = Counter(loop.reason for loop in refused).most_common()
        yield table(("refused because", "loops"), ((reason, f"{count:,}") for reason, count in reasons))
        rows = ((*_score_cells(loop), loop.reason) for loop in refused)
        all_rows = table(("from", "to", "apart", "score", "threshold", "reason"), rows, css_class="numbers")
        yield folded(f"show the {len(refused):,} refused loops", all_rows)
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
