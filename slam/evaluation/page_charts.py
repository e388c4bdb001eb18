"""Data of the charts on a page: series over time or over the log, thinned to what is visible."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fusion import Grade, Provenance
from slam.evaluation.trajectory_error import TruthComparison
from slam.mapper.keyframe_fusion import FusionSummary
from slam.mapper.map_result import MapResult
from slam.mapper.scan_record import ScanRecord
from slam.measurements import BoolArray, FloatArray

_POINTS = 4000
# Range shown above the 95th percentile; larger values are outside the chart.
_ABOVE, _FLATTENS = 1.25, 2.0
_STRETCHES = 250
_COLORS = ("blue", "orange", "green", "red", "soft", "mark")


def chart(
    title: str, across: str, x: FloatArray, series: Mapping[str, FloatArray], **more: Any
) -> dict[str, Any]:
    """Return a chart for the header of a page's data.

    Parameters
    ----------
    across
        What ``x`` (N,) is; it may run backward.
    series
        (N,) of each name; nan is no point.
    more
        ``lines``: whether points are joined; ``most``: upper end of the axis; ``band``: whether the first two
        series are the edges of a band; ``colors``: of the series.
    """
    if "most" not in more:
        # So a few large values do not flatten all others.
        known = np.concatenate([*(values[np.isfinite(values)] for values in series.values()), np.zeros(1)])
        top = _ABOVE * float(np.percentile(known, 95.0))
        if known.max() > _FLATTENS * top:
            more |= {"most": max(top, 1e-9), "above": int(np.count_nonzero(known > top))}
    colors = more.pop("colors", _COLORS)
    order = np.argsort(x, kind="stable")
    chosen = order[:: max(1, -(-len(order) // _POINTS))]
    return {
        "title": title,
        "across": across,
        "x": x[chosen].astype(np.float64),
        "series": [
            {"name": name, "color": colors[number % len(colors)], "values": values[chosen].astype(np.float32)}
            for number, (name, values) in enumerate(series.items())
        ],
        **more,
    }


def map_charts(result: MapResult, unit: str, truth: TruthComparison | None) -> list[dict[str, Any]]:
    """Return the charts of a run: fit of scans, certainty of poses, time, cameras."""
    charts = []
    if unit == "scan":
        charts += _scores(result)
    if result.map.covariances is not None and len(result.map.trajectory):
        charts += sigma_charts(result.map.trajectory.stamps_s, result.map.covariances)
    if truth is not None:
        errors_cm = 100.0 * truth.errors_m
        series = {"error, cm": errors_cm}
        charts.append(chart("Error against the ground truth, cm", "time, s", _since(truth.stamps_s), series))
    for name, record in result.cameras.items():
        charts += _tracking(name, record.frames)
    charts += [] if result.fused is None else _fusion(result.fused)
    if result.scans.seconds.size:
        charts.append(_times(result.scans.seconds, unit))
    return charts


def sigma_charts(stamps_s: FloatArray, covariances: FloatArray) -> list[dict[str, Any]]:
    """Return charts of the largest position sigma and the yaw sigma, from covariances as in `slam.Map`."""
    positions, yaws = sigmas_of(covariances)
    rows = (("Sigma of the position, cm", 100.0 * positions), ("Sigma of the yaw, degrees", np.degrees(yaws)))
    return [chart(title, "time, s", _since(stamps_s), {title: values}) for title, values in rows]


def sigmas_of(covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (N,) the largest sigma of each position, and of the yaw; metres, radians."""
    axes = 2 if covariances.shape[1] == 3 else 3
    positions = np.sqrt(np.linalg.eigvalsh(covariances[:, :axes, :axes])[:, -1])
    return positions, np.sqrt(covariances[:, -1, -1])


def _scores(result: MapResult) -> list[dict[str, Any]]:
    """Return charts of the fit of scans; matches with an undetermined direction have their own colour."""
    scans, keyframes = result.scans, result.map.readings
    if not len(keyframes):
        return []
    since, open_ = _since(scans.stamps_s[keyframes]), scans.degenerate[keyframes] > 0.0
    shares = _split(scans.inlier_shares[keyframes], open_)
    residuals_mm = _split(1000.0 * scans.residuals_m[keyframes], open_)
    return [
        chart("Share of matching points", "time, s", since, shares, most=1.0),
        chart("Residual of the points, mm", "time, s", since, residuals_mm),
    ]


def _split(values: FloatArray, open_: BoolArray) -> dict[str, FloatArray]:
    """Split values of all matches, and of those with an undetermined direction."""
    series = {"match": np.where(open_, np.nan, values)}
    return series | ({"a direction is undetermined": np.where(open_, values, np.nan)} if open_.any() else {})


def _tracking(name: str, frames: ScanRecord) -> list[dict[str, Any]]:
    """Return charts of the fit of a camera's frames; a lost frame is a point at zero."""
    rows = {
        "share of matching points": frames.inlier_shares,
        "overlap": frames.overlaps,
        "features that agree": frames.feature_counts,
        "reprojection, px": frames.residuals_px,
        "distance to the surface, mm": 1000.0 * frames.residuals_m,
    }
    lost = np.where(frames.unmatched, 0.0, np.nan)
    since, also = _since(frames.stamps_s), {"lost": lost} if frames.unmatched.any() else {}
    return [
        chart(f"{name}: {title}", "time, s", since, {title: values, **also})
        for title, values in rows.items()
        if np.isfinite(values).any()
    ]


def _fusion(fused: FusionSummary) -> list[dict[str, Any]]:
    """Return charts of the offset of every pair by grade, and of the repaired share of each scan."""
    charts = []
    if fused.pairs:
        since = _since(np.array([pair.stamp_s for pair in fused.pairs]))
        offsets, grades = (np.array([getattr(pair, name) for pair in fused.pairs]) for name in ("u", "grade"))
        series = {
            f"grade {grade.name.lower()}": np.where(grades == grade, offsets, np.nan) for grade in Grade
        }
        if fused.estimate is not None:
            series["u of the rig"] = np.full(len(offsets), float(fused.estimate.u))
        charts.append(chart("Fusion: offset u of every pair, samples", "time, s", since, series))
    repaired = [pair for pair in fused.pairs if pair.repaired is not None]
    if repaired:
        counts = np.array([pair.repaired for pair in repaired], dtype=np.float64)
        percent = 100.0 * counts / counts.sum(axis=1, keepdims=True)
        kinds = (Provenance.FILLED, Provenance.INTERPOLATED, Provenance.AVERAGED)
        series = {kind.name.lower(): percent[:, kind] for kind in kinds}
        since = _since(np.array([pair.stamp_s for pair in repaired]))
        charts.append(chart("Fusion: beams of the scan that were repaired, %", "time, s", since, series))
    return charts


def _times(seconds: FloatArray, unit: str) -> dict[str, Any]:
    """Return a chart of median and range of the time per scan along the log: a flat line is constant cost."""
    size = -(-seconds.size // _STRETCHES)
    count = -(-seconds.size // size)
    padding = np.full(count * size - seconds.size, np.nan)
    stretches = 1000.0 * np.concatenate([seconds, padding]).reshape(count, size)
    middle = np.minimum((np.arange(count) + 0.5) * size, seconds.size)
    high = np.nanpercentile(stretches, 95.0, axis=1)
    # The first one loads compiled code: it may be outside the chart rather than flatten all others.
    top = max(min(1.15 * float(high.max()), 4.0 * float(np.percentile(high, 95.0))), 1e-3)
    series = {"95 %": high, "min": np.nanmin(stretches, axis=1), "median": np.nanmedian(stretches, axis=1)}
    return chart(f"Time per {unit}, ms", unit, middle, series, lines=True, band=True, most=top)


def _since(stamps_s: FloatArray) -> FloatArray:
    """Return seconds since the first."""
    return stamps_s - stamps_s.min() if stamps_s.size else stamps_s
