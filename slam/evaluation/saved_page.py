"""Page of a saved map without its run, the plan of any map with cloud and images, and its loops."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from slam.config import Config, dump_config
from slam.errors import ScanweaveError
from slam.evaluation.map_info import extent_of
from slam.evaluation.map_report import CLOUD_FILE
from slam.evaluation.page_charts import sigma_charts
from slam.evaluation.page_cloud import cloud_data, image_data
from slam.evaluation.page_data import map_data
from slam.evaluation.page_layers import LEGENDS, areas_m2
from slam.evaluation.pages import page_parts, render
from slam.evaluation.work_page import WorkPage, work_page
from slam.graph.closings import closings
from slam.graph.loop_candidate import LoopCandidate
from slam.mapping.dense_map import ColoredCloud
from slam.mapping.layered_map import LayeredMap
from slam.outputs.finished_map import Map
from slam.storage.files import replacing
from slam.storage.map_contents import MapContents
from slam.storage.map_edits import regions_of
from slam.storage.ply import read_cloud_ply
from slam.storage.whole_folder import REPORT

# Names of user regions, as the page shows them.
_KINDS = ("erase", "keep_out", "slow", "crop", "place")

# With more rows than this, accepted loops are folded, too, so that the page stays readable.
_MOST_OPEN_ROWS = 40
_MOST_CLOSINGS = 10


def saved_page(saved: Map, connect: str = "'none'") -> Iterator[str]:
    """Yield the page part by part.

    Parameters
    ----------
    connect
        Permitted connections of its scripts, see `slam.evaluation.pages.page_parts`.
    """
    contents, config = saved.contents, saved.config
    title = saved.path.parent.name if len(saved.sessions) > 1 else saved.sessions[0].log_name
    head = map_data(contents, config, title=title, sessions=saved.sessions, digest=saved.digest)
    head["applied"] = _applied(contents)
    if contents.covariances is not None:
        head["charts"] = sigma_charts(contents.trajectory.stamps_s, contents.covariances)
    cloud, path = None, saved.path.parent / CLOUD_FILE
    if contents.frames is not None and path.is_file():
        try:
            cloud = read_cloud_ply(path)
        except ScanweaveError as error:
            head["limits"].append(f"No cloud: {error}")
    page = map_work_page(head, contents, config, cloud)
    loops = contents.loops
    return page_parts(
        "saved.html",
        scripts=page.scripts,
        styles=page.styles,
        connect=connect,
        page=page,
        title=title,
        kind="map",
        headline=[
            ("keyframes", f"{len(contents.node_poses):,}"),
            ("poses", f"{len(contents.trajectory):,}"),
            ("loops accepted", f"{sum(loop.accepted for loop in loops):,} of {len(loops):,}"),
            ("path", f"{extent_of(contents.trajectory, saved.sessions)['path_length_m']:,.1f} m"),
            ("digest", saved.digest[:12]),
        ],
        warnings=list(saved.warnings),
        notes=[("note", note) for note in saved.notes],
        logs=[(log.log_name, f"{log.keyframes:,}", f"{log.poses:,}") for log in saved.sessions],
        loops=loop_section(contents, config),
        effective_config=dump_config(config),
    )


def write_saved_page(saved: Map) -> Path:
    """Write the page as ``report.html`` into the map's folder; return its path.

    Raises
    ------
    MapFileError
        If it cannot be written.
    """
    path = saved.path.parent / REPORT
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(saved_page(saved))
    return path


def map_work_page(
    head: dict[str, Any], contents: MapContents, config: Config, cloud: ColoredCloud | None = None
) -> WorkPage:
    """Return the plan of a map's data, with its cloud and images."""
    for name, (part, limits) in (("cloud", cloud_data(contents, cloud)), ("images", image_data(contents))):
        head[name] = part
        head["limits"] += limits
    layers = contents.layers(config)
    legend = _legend(layers)
    for layer in head["layers"][:1]:
        layer["legend"] = legend
    return work_page(head, "Trajectory" if layers is None else "Map", legend)


def _legend(layers: LayeredMap | None) -> str:
    """Return the legend of greys, the free area, and the area that only the lidar saw as free."""
    if layers is None:
        return ""
    free_m2, lidar_m2 = areas_m2(layers)
    if not lidar_m2:
        return f"{LEGENDS['map']} Free: {free_m2:.1f} m²."
    return (
        f"{LEGENDS['map']} Light grey is free at the height of the lidar only: no camera saw all heights of "
        f"the robot there. layers.rule decides whether it may drive there. Free: {free_m2:.1f} m²; at the "
        f"height of the lidar only: {lidar_m2:.1f} m²."
    )


def _applied(contents: MapContents) -> dict[str, Any]:
    """Return the texts of the edits, and the current positions of their zones and places in the map."""
    regions = [
        {
            "kind": kind,
            "name": region.name,
            "points": region.points(contents.keyframe_poses).round(3).tolist(),
        }
        for kind in _KINDS
        for region in regions_of(contents.edits, kind)
    ]
    return {"texts": [entry.text for entry in contents.edits], "regions": regions}


def loop_section(saved: MapContents, config: Config, degenerate: int = 0) -> str:
    """Return HTML; ``degenerate`` counts keyframes whose match has an undetermined direction."""
    accepted = [_score_cells(loop, saved, config) for loop in saved.loops if loop.accepted]
    refused = [(*_score_cells(loop, saved, config), loop.reason) for loop in saved.loops if not loop.accepted]
    return render(
        "loops.html",
        closings=_closings(saved, config),
        degenerate=degenerate,
        matches=len(saved.readings),
        accepted=accepted,
        refused=refused,
        most_open=_MOST_OPEN_ROWS,
        reasons=[(why, f"{count:,}") for why, count in Counter(row[-1] for row in refused).most_common()],
    )


def _closings(saved: MapContents, config: Config) -> list[tuple[str, ...]]:
    """Return the loops that corrected the largest errors, one row each."""
    inliers = [factor.edge for factor in saved.factors if factor.kept]
    # Place claims support each other over this path length.
    reach_m = 2.0 * config.loops.least_path_m
    rows = closings(inliers, saved.node_poses, reach_m, _MOST_CLOSINGS)
    return [
        (
            f"{row.place} to {row.keyframe}",
            str(row.loops),
            f"{row.path_m:,.0f} m",
            f"{row.before_m:.2f} m",
            f"{row.after_m:.3f} m",
            f"{row.after_sigmas:.1f}",
            "nothing" if math.isinf(row.without_m) else f"{row.without_m:.2f} m",
        )
        for row in rows
    ]


def _score_cells(loop: LoopCandidate, saved: MapContents, config: Config) -> tuple[str, ...]:
    """Return the numbers of one loop as text; a loop that was rejected before scoring has a dash."""
    poses = saved.keyframe_poses
    x, y = (poses[loop.keyframe] - poses[loop.place])[:2]
    score = "–" if loop.motion is None else f"{loop.motion.inlier_share:.3f}"
    distance = f"{math.hypot(x, y):.2f} m"
    return str(loop.keyframe), str(loop.place), distance, score, f"{config.loops.least_inlier_share:.3f}"
