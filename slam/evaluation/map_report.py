"""From a finished map to what the report page shows."""

from __future__ import annotations

import resource
import sys
from collections import Counter
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from slam.config import Config, dump_config
from slam.datasets.dataset import ReadReport
from slam.evaluation.report import LoopRow, MapPicture, ReportData
from slam.graph.loop_closure import LoopCandidate
from slam.map_result import MapResult
from slam.mapping.occupancy_grid import FREE, OCCUPIED, OccupancyGrid
from slam.measurements import FloatArray

_LIBRARIES = ("scanweave", "gtsam", "numpy", "numba", "kiss-icp", "open3d-cpu", "opencv-python-headless")
# More unmatched scans than this share deserve a line at the top of the page.
_UNMATCHED_SHARE = 0.01


@dataclass(frozen=True, slots=True)
class RunCost:
    """What a run cost up to the report."""

    wall_s: float
    cpu_s: float

    @staticmethod
    def peak_memory_mb() -> float:
        """Greatest resident size of this process so far."""
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (1024.0**2 if sys.platform == "darwin" else 1024.0)


def report_data(
    log_name: str, reading: ReadReport, result: MapResult, config: Config, cost: RunCost
) -> ReportData:
    """Gather the report of a run."""
    keyframes = result.keyframe_numbers
    scans = result.scans
    trajectory = result.trajectory
    steps = np.diff(trajectory.positions_m[:, :2], axis=0)
    return ReportData(
        log_name=log_name,
        scans=scans.stamps_s.size,
        path_length_m=float(np.hypot(steps[:, 0], steps[:, 1]).sum()),
        duration_s=float(np.ptp(trajectory.stamps_s)),
        cpu_s=cost.cpu_s,
        wall_s=cost.wall_s,
        peak_memory_mb=cost.peak_memory_mb(),
        trajectory_xy=trajectory.positions_m[:, :2],
        keyframe_stamps_s=scans.stamps_s[keyframes],
        inlier_share=scans.inlier_shares[keyframes],
        residual_m=scans.residuals_m[keyframes],
        degenerate=scans.degenerate[keyframes] > 0.0,
        scan_times_s=scans.seconds,
        map_picture=None if result.grid is None else _picture(result.grid),
        loops=[_loop_row(loop, result.keyframe_poses, config) for loop in result.loops],
        reader_notes=_reader_notes(reading) + _edge_notes(result),
        stage_times_s=result.stage_seconds,
        warnings=[*result.warnings, *_warnings(result)],
        effective_config=dump_config(config),
        versions={name: found for name in _LIBRARIES if (found := _version(name))},
    )


def _picture(grid: OccupancyGrid) -> MapPicture:
    """The grid in nav2's grey values, top row first."""
    states = grid.states()
    image = np.full(states.shape, 205, np.uint8)
    image[states == FREE] = 254
    image[states == OCCUPIED] = 0
    return MapPicture(
        np.ascontiguousarray(image[::-1]), grid.resolution_m, (grid.T_map_grid.x(), grid.T_map_grid.y())
    )


def _loop_row(loop: LoopCandidate, poses: FloatArray, config: Config) -> LoopRow:
    """One candidate for the table; its score is the share of points that fit, where it got so far."""
    source, place = poses[loop.keyframe], poses[loop.place]
    return LoopRow(
        from_keyframe=loop.keyframe,
        to_keyframe=loop.place,
        xy_from=(float(source[0]), float(source[1])),
        xy_to=(float(place[0]), float(place[1])),
        score=float("nan") if loop.motion is None else loop.motion.inlier_share,
        threshold=config.loops.least_inlier_share,
        accepted=loop.accepted,
        reason=loop.reason,
    )


def _reader_notes(reading: ReadReport) -> list[tuple[str, str]]:
    """What the reader met, as rows."""
    rows = [(f"records: {name}", f"{count:,}") for name, count in sorted(reading.records.items())]
    rows += [(f"ignored: {name}", f"{count:,}") for name, count in sorted(reading.ignored.items())]
    for reason, tally in sorted(reading.dropped.items()):
        rows.append((f"dropped: {reason}", f"{tally.count:,} (first at line {tally.lines[0]})"))
    for sensor, tally in sorted(reading.backward_steps.items()):
        rows.append((f"stamps backward: {sensor}", f"{tally.count:,} (largest {tally.largest:.3f} s)"))
    for note, tally in sorted(reading.notes.items()):
        rows.append((note, f"{tally.count:,}"))
    return rows


def _edge_notes(result: MapResult) -> list[tuple[str, str]]:
    """Edges of the graph by provenance, and how many were refused."""
    kinds = Counter(edge.kind for edge in result.graph.edges)
    refused = Counter(
        edge.kind for edge, keep in zip(result.graph.edges, result.edges_kept, strict=True) if not keep
    )
    return [
        (f"edges: {kind}", f"{count:,}" + (f" ({refused[kind]:,} refused)" if refused[kind] else ""))
        for kind, count in kinds.items()
    ]


def _warnings(result: MapResult) -> list[str]:
    """What a person should know before trusting the map."""
    lines = []
    unmatched = int(np.isnan(result.scans.inlier_shares[1:]).sum())
    count = result.scans.stamps_s.size
    if unmatched > _UNMATCHED_SHARE * count:
        lines.append(f"{unmatched:,} of {count:,} scans matched nothing; their motion is dead reckoning.")
    degenerate = float(result.scans.degenerate.mean())
    if degenerate > _UNMATCHED_SHARE:
        lines.append(
            f"{degenerate:.1%} of the scans leave a direction open (corridors); its variance was inflated."
        )
    return lines


def _version(package: str) -> str:
    """Installed version, empty where the package is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
