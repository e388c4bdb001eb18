"""One self-contained report.html a run: what came in, what was decided, how certain, at what cost."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path

import numpy as np

from slam.config import dump_config
from slam.evaluation.map_report import ReportData
from slam.evaluation.page_charts import map_charts
from slam.evaluation.page_cloud import cloud_data, image_data
from slam.evaluation.page_data import map_data
from slam.evaluation.page_layers import LEGENDS, areas_m2
from slam.evaluation.pages import write_page
from slam.evaluation.report_cameras import camera_cells
from slam.evaluation.report_fusion import fusion_section
from slam.evaluation.work_page import WorkPage, work_page
from slam.graph.closings import closings
from slam.graph.loop_closure import LoopCandidate
from slam.mapping.layered_map import LayeredMap

# Beyond this many rows the accepted loops are folded too, so that the page stays readable.
_MOST_OPEN_ROWS = 40
_MOST_CLOSINGS = 10


def write_report(path: Path, data: ReportData) -> None:
    """Write the report as one HTML file that asks nothing of the network.

    Raises
    ------
    MapFileError
        Where the folder is missing, not writable or full; an older report then stays as it was.
    """
    result, loops = data.result, data.result.map.loops
    accepted = [_score_cells(loop, data) for loop in loops if loop.accepted]
    refused = [(*_score_cells(loop, data), loop.reason) for loop in loops if not loop.accepted]
    truth, page = data.beside.truth, _page(data)
    degenerate = result.scans.degenerate[result.map.readings] > 0.0
    write_page(
        path,
        "map.html",
        scripts=page.scripts,
        styles=page.styles,
        page=page,
        title=data.log_name,
        kind="report",
        data=data,
        headline=_headline(data),
        fusion=fusion_section(result.fused) if result.fused is not None else "",
        camera_rows=[camera_cells(name, record) for name, record in result.cameras.items()],
        truth=truth,
        truth_deg=0.0 if truth is None else math.degrees(truth.error.rotation_rad.rmse),
        degenerate=int(np.count_nonzero(degenerate)),
        closings=_closings(data),
        accepted=accepted,
        refused=refused,
        most_open=_MOST_OPEN_ROWS,
        reasons=[(why, f"{count:,}") for why, count in Counter(row[-1] for row in refused).most_common()],
        longest_s=max(result.stage_seconds.values(), default=0.0) or 1.0,
        effective_config=dump_config(data.config),
    )


def _headline(data: ReportData) -> list[tuple[str, str]]:
    """The run in a few numbers."""
    loops, cost = data.result.map.loops, data.cost
    seconds = data.result.scans.seconds
    facts = [
        (f"{data.unit}s", f"{seconds.size:,}"),
        ("keyframes", f"{len(data.result.map.node_poses):,}"),
        ("loops accepted", f"{sum(loop.accepted for loop in loops):,} of {len(loops):,}"),
        ("path", f"{data.path_length_m:,.1f} m"),
        ("log lasts", _duration(data.duration_s)),
        ("wall time", f"{cost.wall_s:,.1f} s"),
        ("CPU time", f"{cost.cpu_s:,.1f} s"),
        (f"median time a {data.unit}", f"{1e3 * float(np.median(seconds)):.2f} ms" if seconds.size else "–"),
        ("real-time factor", f"{data.duration_s / cost.wall_s:,.1f} ×" if cost.wall_s > 0 else "–"),
        ("peak memory", f"{cost.peak_memory_mb():,.0f} MB"),
    ]
    if data.beside.truth is not None:
        facts.append(("RMSE against the truth", f"{data.beside.truth.error.translation_m.rmse:.3f} m"))
    return facts


def _duration(seconds: float) -> str:
    """Minutes and seconds, as a person says it."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def _page(data: ReportData) -> WorkPage:
    """The plan to work in."""
    found, truth = data.result.map, data.beside.truth
    head = map_data(found, data.config, title=data.log_name)
    head["charts"] = map_charts(data.result, data.unit, truth)
    for name, (part, told) in {
        "cloud": cloud_data(found, data.beside.cloud),
        "images": image_data(found),
    }.items():
        head[name] = part
        head["limits"] += told
    if truth is not None:
        head["truth"] = {"xy": truth.true_positions_m[:, :2].astype(np.float32)}
    layers = data.layers
    return work_page(head, "Trajectory" if layers is None else "Map", _legend(layers))


def _legend(layers: LayeredMap | None) -> str:
    """What the greys mean, and how much of the floor is free; of what only the lidar saw free, how much."""
    if layers is None:
        return ""
    free_m2, lidar_m2 = areas_m2(layers)
    if not lidar_m2:
        return f"{LEGENDS['map']} Free: {free_m2:.1f} m²."
    return (
        f"{LEGENDS['map']} Light grey is free at the height of the lidar only, no camera saw all heights of "
        f"the robot there; layers.rule tells whether it may drive there. Free: {free_m2:.1f} m²; at the "
        f"height of the lidar only: {lidar_m2:.1f} m²."
    )


def _closings(data: ReportData) -> list[tuple[str, ...]]:
    """The loops that closed most, one row each."""
    held = [factor.edge for factor in data.result.map.factors if factor.kept]
    # Claims about places support each other over as much of the way.
    reach_m = 2.0 * data.config.loops.least_path_m
    found = closings(held, data.result.map.node_poses, reach_m, _MOST_CLOSINGS)
    return [
        (
            f"{one.place} to {one.keyframe}",
            str(one.loops),
            f"{one.path_m:,.0f} m",
            f"{one.before_m:.2f} m",
            f"{one.after_m:.3f} m",
            f"{one.after_sigmas:.1f}",
            "nothing" if math.isinf(one.without_m) else f"{one.without_m:.2f} m",
        )
        for one in found
    ]


def _score_cells(loop: LoopCandidate, data: ReportData) -> tuple[str, ...]:
    """The numbers of one loop as text; a loop that was refused before it was scored has a dash."""
    poses = data.result.map.keyframe_poses
    x, y = (poses[loop.keyframe] - poses[loop.place])[:2]
    score = "–" if loop.motion is None else f"{loop.motion.inlier_share:.3f}"
    apart = f"{math.hypot(x, y):.2f} m"
    return str(loop.keyframe), str(loop.place), apart, score, f"{data.config.loops.least_inlier_share:.3f}"
