"""Write one self-contained report.html per run: input, decisions, uncertainty and cost."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fusion import Grade
from slam.config import dump_config
from slam.evaluation.map_info import extent_of
from slam.evaluation.map_report import ReportData
from slam.evaluation.page_charts import map_charts
from slam.evaluation.page_data import map_data
from slam.evaluation.pages import render, write_page
from slam.evaluation.saved_page import loop_section, map_work_page
from slam.evaluation.work_page import WorkPage
from slam.mapper.keyframe_fusion import FusionSummary
from slam.mapper.scan_record import CameraRecord
from slam.measurements import FloatArray


def write_report(path: Path, data: ReportData, head: Callable[[], Any] = lambda: None) -> None:
    """Write the report as one HTML file that needs no network.

    Parameters
    ----------
    head
        Returns `map_data` of the map without its digest, or None; called last.

    Raises
    ------
    MapFileError
        If the folder is missing, not writable or full; an older report then stays as it was.
    """
    result = data.result
    truth, degenerate = data.beside.truth, result.scans.degenerate[result.map.readings] > 0.0
    loops = loop_section(result.map, data.config, int(np.count_nonzero(degenerate)))
    page = _page(data, head())
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
        camera_rows=[_camera_cells(name, record) for name, record in result.cameras.items()],
        truth=truth,
        truth_deg=0.0 if truth is None else math.degrees(truth.error.rotation_rad.rmse),
        loops=loops,
        stages=_stages(data),
        effective_config=dump_config(data.config),
    )


def _headline(data: ReportData) -> list[tuple[str, str]]:
    """Return the main figures of a run."""
    loops, cost = data.result.map.loops, data.cost
    extent = extent_of(data.result.map.trajectory, data.sessions)
    seconds = data.result.scans.seconds
    facts = [
        (f"{data.unit}s", f"{seconds.size:,}"),
        ("keyframes", f"{len(data.result.map.node_poses):,}"),
        ("loops accepted", f"{sum(loop.accepted for loop in loops):,} of {len(loops):,}"),
        ("path", f"{extent['path_length_m']:,.1f} m"),
        ("log lasts", _duration(extent["duration_s"])),
        ("wall time", f"{cost.wall_s:,.1f} s"),
        ("CPU time", f"{cost.cpu_s:,.1f} s"),
        (
            f"median time per {data.unit}",
            f"{1e3 * float(np.median(seconds)):.2f} ms" if seconds.size else "–",
        ),
        ("real-time factor", f"{extent['duration_s'] / cost.wall_s:,.1f} ×" if cost.wall_s > 0 else "–"),
        ("peak memory", f"{cost.peak_memory_mb():,.0f} MB"),
    ]
    if data.beside.truth is not None:
        facts.append(("RMSE against the truth", f"{data.beside.truth.error.translation_m.rmse:.3f} m"))
    return facts


def _stages(data: ReportData) -> list[tuple[str, str, float]]:
    """Return the wall time by stage: seconds, percent of the longest; with the rest and the total."""
    stages = dict(data.result.stage_seconds)
    if not stages:
        return []
    stages["other"] = max(data.cost.wall_s - sum(stages.values()), 0.0)
    longest_s = max(stages.values()) or 1.0
    rows = [(name, f"{seconds:,.2f} s", 100.0 * seconds / longest_s) for name, seconds in stages.items()]
    return [*rows, ("total", f"{sum(stages.values()):,.2f} s", 0.0)]


def _duration(seconds: float) -> str:
    """Format minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def _page(data: ReportData, head: dict[str, Any] | None) -> WorkPage:
    """Return the interactive plan."""
    contents, truth = data.result.map, data.beside.truth
    if head is None:
        head = map_data(contents, data.config, title=data.log_name, sessions=data.sessions)
    head["digest"] = data.digest
    head["charts"] = map_charts(data.result, data.unit, truth)
    if truth is not None:
        head["truth"] = {"xy": truth.true_positions_m[:, :2].astype(np.float32)}
    return map_work_page(head, contents, data.config, data.beside.cloud)


def fusion_section(fused: FusionSummary) -> str:
    """Return the rig estimate of the pairs, and the repairs, as HTML."""
    return render(
        "fusion.html",
        fused=fused,
        grades=_grade_rows(fused) if fused.pairs else [],
        repaired=sum(pair.repaired is not None for pair in fused.pairs),
    )


def _grade_rows(fused: FusionSummary) -> list[tuple[str, ...]]:
    """Return pairs by grade, and their distance from the joint estimate."""
    rows: list[tuple[str, ...]] = []
    for grade in sorted(Grade, reverse=True):
        offsets = np.array([pair.u for pair in fused.pairs if pair.grade == grade])
        offset_px = "–"
        if fused.estimate is not None and offsets.size:
            offset_px = f"{np.median(np.abs(offsets - fused.estimate.u)):.1f}"
        share = f"{offsets.size / len(fused.pairs):.0%}"
        rows.append((grade.name.lower(), f"{offsets.size:,}", share, offset_px))
    return rows


def _camera_cells(name: str, record: CameraRecord) -> tuple[str, ...]:
    """Return the numbers of a camera as text; a dash if never measured."""
    frames = record.frames
    medians = [
        (frames.overlaps, "{:.2f}"),
        (frames.feature_counts, "{:.0f}"),
        (frames.residuals_px, "{:.2f}"),
        (1000.0 * frames.residuals_m, "{:.1f}"),
    ]
    return (
        name,
        f"{frames.stamps_s.size:,}",
        f"{np.count_nonzero(frames.unmatched):,}",
        f"{np.count_nonzero(frames.degenerate):,}",
        f"{record.motions:,}" if record.motions else "–",
        f"{record.refused_motions:,}" if record.motions else "–",
        *(_median(values, style) for values, style in medians),
    )


def _median(values: FloatArray, style: str) -> str:
    """Return the median of measured values."""
    known = values[np.isfinite(values)]
    return style.format(float(np.median(known))) if known.size else "–"
