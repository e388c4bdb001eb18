"""One self-contained report.html a run: what came in, what was decided, how certain, at what cost."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from slam.config import dump_config
from slam.evaluation import report_figures
from slam.evaluation.camera_figures import side_png, tracking_png, truth_png
from slam.evaluation.cloud_picture import cloud_from_above
from slam.evaluation.fusion_figures import fusion_section
from slam.evaluation.map_report import LIDAR_HEIGHT_GREY, ReportData
from slam.evaluation.pages import write_page
from slam.evaluation.report_cameras import camera_cells
from slam.evaluation.report_figures import FREE_GREY, MapPicture
from slam.evaluation.uncertainty_figures import sigma_png
from slam.graph.closings import closings
from slam.graph.loop_closure import LoopCandidate

# Beyond this many rows the accepted loops are folded too, so that the page stays readable.
_MOST_OPEN_ROWS = 40
_MOST_CLOSINGS = 10

_MAP_LEGEND = "The map to drive by: black is what the robot must not hit, white is free, grey is unknown."
_LAYER_LEGENDS = {
    "lidar": "The lidar alone, at its own height (layers/lidar.yaml).",
    "depth": "The cameras alone, within the robot's height (layers/depth.yaml).",
    "fused": "Both as one probability: unknown where they contradict each other (layers/fused.yaml).",
}


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
    truth = data.beside.truth
    write_page(
        path,
        "map.html",
        title=data.log_name,
        kind="report",
        data=data,
        headline=_headline(data),
        fusion=fusion_section(result.fused) if result.fused is not None else "",
        camera_rows=[camera_cells(name, record) for name, record in result.cameras.items()],
        tracking=[(name, tracking_png(record.frames)) for name, record in result.cameras.items()],
        truth=truth,
        truth_deg=0.0 if truth is None else math.degrees(truth.error.rotation_rad.rmse),
        truth_png=None if truth is None else truth_png(truth, spatial=data.spatial),
        cloud_png=_cloud(data),
        closings=_closings(data),
        accepted=accepted,
        refused=refused,
        most_open=_MOST_OPEN_ROWS,
        reasons=[(why, f"{count:,}") for why, count in Counter(row[-1] for row in refused).most_common()],
        longest_s=max(result.stage_seconds.values(), default=0.0) or 1.0,
        effective_config=dump_config(data.config),
        **_map(data),
        **_scores(data),
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


def _map(data: ReportData) -> dict[str, Any]:
    """The map with trajectory and accepted loops drawn in, and what it was made of."""
    found = data.result.map
    trajectory_m, xy = found.trajectory.positions_m, found.keyframe_poses[:, :2]
    loops = [(*xy[loop.keyframe], *xy[loop.place]) for loop in found.loops if loop.accepted]
    from_side, picture = data.spatial and len(trajectory_m) > 0, data.map_picture
    title = "Trajectory from above and from the side" if from_side else "Trajectory"
    ends, covariances = np.asarray(loops, np.float64).reshape(-1, 4), found.covariances
    png = report_figures.map_png(trajectory_m[:, :2], ends, picture, covariances)
    shown: dict[str, Any] = {"map_png": png, "map_title": title, "map_legend": "", "layers": []}
    shown["sigma_png"] = None if covariances is None else sigma_png(found.trajectory.stamps_s, covariances)
    if picture is not None and not from_side:
        window = report_figures.known_window(picture.image)
        shown["map_title"], shown["map_legend"] = "Map", _map_legend(picture)
        shown["layers"] = [
            (name, _LAYER_LEGENDS[name], report_figures.small_map_png(layer.image[window]))
            for name, layer in data.layer_pictures().items()
        ]
    return {**shown, "side_png": side_png(trajectory_m) if from_side else None}


def _map_legend(picture: MapPicture) -> str:
    """What the greys mean, and how much of the floor is free; of what only the lidar saw free, how much."""
    free_m2, lidar_m2 = (
        picture.resolution_m**2 * np.count_nonzero(picture.image == grey)
        for grey in (FREE_GREY, LIDAR_HEIGHT_GREY)
    )
    if not lidar_m2:
        return f"{_MAP_LEGEND} Free: {free_m2:.1f} m²."
    return (
        f"{_MAP_LEGEND} Light grey is free at the height of the lidar only, no camera saw all heights of the "
        f"robot there; layers.rule tells whether it may drive there. Free: {free_m2:.1f} m²; at the height "
        f"of the lidar only: {lidar_m2:.1f} m²."
    )


def _scores(data: ReportData) -> dict[str, Any]:
    """How well the scans fitted, and what each cost; how frames fitted is told by camera."""
    scans, keyframes = data.result.scans, data.result.map.readings
    degenerate = scans.degenerate[keyframes] > 0.0
    stamps_s, shares, residuals_m = (
        values[keyframes] for values in (scans.stamps_s, scans.inlier_shares, scans.residuals_m)
    )
    scores = None
    if data.unit == "scan":
        scores = report_figures.scores_png(stamps_s, shares, residuals_m, degenerate)
    return {
        "degenerate": int(np.count_nonzero(degenerate)),
        "scores_png": scores,
        "times_png": report_figures.times_png(scans.seconds, data.unit),
    }


def _cloud(data: ReportData) -> bytes | None:
    """The coloured map from above, with the trajectory."""
    if data.beside.cloud is None:
        return None
    pixel_m, positions_m = data.config.dense_map.voxel_m, data.result.map.trajectory.positions_m
    seen = cloud_from_above(data.beside.cloud, positions_m, pixel_m=pixel_m, level=data.spatial)
    return None if seen is None else report_figures.map_png(seen[1], np.empty((0, 4)), seen[0])


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
