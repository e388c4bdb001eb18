"""One self-contained report.html a run: what came in, what was decided, how sure, at what cost.

Everything is passed in as plain arrays and texts, so the report draws any run and depends on none.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from slam.evaluation import report_figures
from slam.evaluation.camera_figures import side_png, tracking_png, truth_png
from slam.evaluation.cloud_picture import CloudPicture
from slam.evaluation.fusion_figures import fusion_section
from slam.evaluation.pages import write_page
from slam.evaluation.report_cameras import CameraRow
from slam.evaluation.truth_comparison import TruthComparison
from slam.mapper.keyframe_fusion import FusionSummary
from slam.measurements import BoolArray, FloatArray

# Beyond this many rows the accepted loops are folded too, so that the page stays readable.
_MOST_OPEN_ROWS = 40

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
    accepted = [_score_cells(loop) for loop in data.loops if loop.accepted]
    refused = [(*_score_cells(loop), loop.reason) for loop in data.loops if not loop.accepted]
    write_page(
        path,
        "map.html",
        title=data.log_name,
        kind="report",
        data=data,
        headline=_headline(data),
        fusion=fusion_section(data.fused) if data.fused is not None else "",
        camera_rows=[camera.cells() for camera in data.cameras],
        registrations=[(camera.name, camera.registration) for camera in data.cameras],
        tracking=[(camera.name, tracking_png(camera.record.frames)) for camera in data.cameras],
        truth_deg=0.0 if data.truth is None else math.degrees(data.truth.error.rotation_rad.rmse),
        accepted=accepted,
        refused=refused,
        most_open=_MOST_OPEN_ROWS,
        reasons=[(why, f"{count:,}") for why, count in Counter(row[-1] for row in refused).most_common()],
        degenerate=int(np.count_nonzero(data.degenerate)),
        longest_s=max(data.stage_times_s.values(), default=0.0) or 1.0,
        versions=list(data.versions.items()),
        **_map(data),
        **_plots(data),
    )


def _headline(data: ReportData) -> list[tuple[str, str]]:
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
    return facts


def _duration(seconds: float) -> str:
    """Minutes and seconds, as a person says it."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def _map(data: ReportData) -> dict[str, Any]:
    """The map with trajectory and accepted loops drawn in, and what it was made of."""
    accepted = [(*loop.xy_from, *loop.xy_to) for loop in data.loops if loop.accepted]
    picture = data.map_picture
    from_side = data.spatial and len(data.trajectory_m) > 0
    title = "Trajectory from above and from the side" if from_side else "Trajectory"
    shows_map = picture is not None and not from_side
    return {
        "map_title": "Map" if shows_map else title,
        "map_legend": _map_legend(picture) if shows_map and picture is not None else "",
        "map_png": report_figures.map_png(
            data.trajectory_m[:, :2],
            np.asarray(accepted, dtype=np.float64).reshape(-1, 4),
            image=None if picture is None else picture.image,
            resolution_m=1.0 if picture is None else picture.resolution_m,
            origin_xy=(0.0, 0.0) if picture is None else picture.origin_xy,
        ),
        "side_png": side_png(data.trajectory_m) if from_side else None,
        "layers": _layers(data.layers, picture) if shows_map and picture is not None else [],
    }


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


def _layers(layers: Mapping[str, MapPicture], decision: MapPicture) -> list[tuple[str, str, bytes]]:
    """Name, legend and small picture of what the map was made of."""
    window = report_figures.known_window(decision.image)
    return [
        (name, _LAYER_LEGENDS[name], report_figures.small_map_png(layer.image[window]))
        for name, layer in layers.items()
    ]


def _plots(data: ReportData) -> dict[str, bytes | None]:
    """How well the scans fitted (how frames fitted is told by camera), what each cost; cloud and truth."""
    cloud, scores = data.cloud, None
    if data.unit == "scan":
        scores = report_figures.scores_png(
            data.keyframe_stamps_s, data.inlier_share, data.residual_m, data.degenerate
        )
    return {
        "scores_png": scores,
        "times_png": report_figures.times_png(data.scan_times_s, data.unit),
        "truth_png": None if data.truth is None else truth_png(data.truth, spatial=data.spatial),
        "cloud_png": None
        if cloud is None
        else report_figures.map_png(
            cloud.path_xy,
            np.empty((0, 4)),
            image=cloud.image,
            resolution_m=cloud.resolution_m,
            origin_xy=cloud.origin_xy,
        ),
    }


def _score_cells(loop: LoopRow) -> tuple[str, ...]:
    """The numbers of one loop as text; a missing score is a dash."""
    apart_m = float(np.hypot(loop.xy_from[0] - loop.xy_to[0], loop.xy_from[1] - loop.xy_to[1]))
    numbers = (f"{value:.3f}" if np.isfinite(value) else "–" for value in (loop.score, loop.threshold))
    return (str(loop.from_keyframe), str(loop.to_keyframe), f"{apart_m:.2f} m", *numbers)
