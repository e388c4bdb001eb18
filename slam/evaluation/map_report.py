"""From a finished map to what the report page shows."""

from __future__ import annotations

import resource
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal

import gtsam
import numpy as np

from slam.config import Config, dump_config
from slam.datasets.dataset import Dataset, ReadReport
from slam.errors import ScanweaveError
from slam.evaluation.cloud_picture import cloud_from_above
from slam.evaluation.report import LIDAR_HEIGHT_GREY, LoopRow, MapPicture, ReportData
from slam.evaluation.report_cameras import CameraRow
from slam.evaluation.truth_comparison import TruthComparison, compare_with_truth
from slam.graph.loop_closure import LoopCandidate
from slam.graph.pose_graph import EdgeKind
from slam.mapper.map_result import MapResult
from slam.mapper.scan_record import CameraRecord
from slam.mapping.dense_map import ColoredCloud
from slam.mapping.layered_map import LayeredMap
from slam.mapping.occupancy_grid import FREE, OCCUPIED, OccupancyGrid, StateArray
from slam.measurements import BoolArray
from slam.storage.ply import read_cloud_ply

CLOUD_FILE = "cloud.ply"
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


@dataclass(frozen=True, slots=True)
class Beside:
    """What a report can show beside the map itself: the true trajectory, the coloured cloud."""

    truth: TruthComparison | None = None
    cloud: ColoredCloud | None = None
    warnings: tuple[str, ...] = ()


def beside_of(
    dataset: Dataset, result: MapResult, written: Iterable[Path], warnings: Iterable[str] = ()
) -> Beside:
    """Gather what lies beside a map.

    What cannot be had is a warning: the map itself is made.

    Parameters
    ----------
    written
        The files of the run; the coloured cloud is read from there, not fused again.
    warnings
        Of what could not be written.
    """
    truth, cloud, lines = None, None, list(warnings)
    try:
        true_trajectory = dataset.groundtruth()
        if true_trajectory is not None:
            truth = compare_with_truth(result.trajectory, true_trajectory)
    except ScanweaveError as error:
        lines.append(f"Not compared with the ground truth: {error}")
    try:
        for path in written:
            if path.name == CLOUD_FILE:
                cloud = read_cloud_ply(path)
    except ScanweaveError as error:
        lines.append(f"No picture of the coloured map: {error}")
    return Beside(truth, cloud, tuple(lines))


def report_data(
    log_name: str,
    reading: ReadReport,
    result: MapResult,
    config: Config,
    cost: RunCost,
    beside: Beside | None = None,
    layers: LayeredMap | None = None,
) -> ReportData:
    """Gather the report of a run; without layers its map is the lidar's grid, where there is one."""
    beside = beside or Beside()
    keyframes = result.keyframe_numbers
    scans = result.scans
    trajectory = result.trajectory
    spatial = isinstance(result.graph.pose(0), gtsam.Pose3)
    cloud = None
    if beside.cloud is not None:
        pixel_m = config.dense_map.voxel_m
        cloud = cloud_from_above(beside.cloud, trajectory.positions_m, pixel_m=pixel_m, level=spatial)
    return ReportData(
        log_name=log_name,
        scans=scans.stamps_s.size,
        path_length_m=float(np.linalg.norm(np.diff(trajectory.positions_m, axis=0), axis=1).sum()),
        duration_s=float(np.ptp(trajectory.stamps_s)),
        cpu_s=cost.cpu_s,
        wall_s=cost.wall_s,
        peak_memory_mb=cost.peak_memory_mb(),
        trajectory_m=trajectory.positions_m,
        keyframe_stamps_s=scans.stamps_s[keyframes],
        inlier_share=scans.inlier_shares[keyframes],
        residual_m=scans.residuals_m[keyframes],
        degenerate=scans.degenerate[keyframes] > 0.0,
        scan_times_s=scans.seconds,
        map_picture=_map_picture(result.grid, layers),
        layers=_layer_pictures(layers),
        loops=[_loop_row(loop, result, config) for loop in result.loops],
        reader_notes=_reader_notes(reading) + _edge_notes(result) + [("note", note) for note in result.notes],
        stage_times_s=result.stage_seconds,
        warnings=[*result.warnings, *_warnings(result), *beside.warnings],
        effective_config=dump_config(config),
        versions={name: found for name in _LIBRARIES if (found := _version(name))},
        unit=_unit(result),
        spatial=spatial,
        cameras=[
            CameraRow(name, record, _registration_text(record, config))
            for name, record in result.cameras.items()
        ],
        truth=beside.truth,
        cloud=cloud,
        fused=result.fused,
    )


def _map_picture(grid: OccupancyGrid | None, layers: LayeredMap | None) -> MapPicture | None:
    """The map to drive by."""
    if layers is not None:
        drawn = _picture(layers.states("decision"), layers)
        drawn.image[::-1][layers.free_at_lidar_height()] = LIDAR_HEIGHT_GREY
        return drawn
    return None if grid is None else _picture(grid.states(), grid)


def _layer_pictures(layers: LayeredMap | None) -> dict[str, MapPicture]:
    """What the map was made of: all but the decision, which is the map itself."""
    names = () if layers is None else layers.names[:-1]
    return {name: _picture(layers.states(name), layers) for name in names if layers is not None}


def _picture(states: StateArray, grid: OccupancyGrid | LayeredMap) -> MapPicture:
    """States in nav2's grey values, top row first."""
    image = np.full(states.shape, 205, np.uint8)
    image[states == FREE] = 254
    image[states == OCCUPIED] = 0
    return MapPicture(
        np.ascontiguousarray(image[::-1]), grid.resolution_m, (grid.T_map_grid.x(), grid.T_map_grid.y())
    )


def _loop_row(loop: LoopCandidate, result: MapResult, config: Config) -> LoopRow:
    """One candidate for the table; its score is the share of points that fit, where it got so far."""
    source, place = result.keyframe_poses[loop.keyframe], result.keyframe_poses[loop.place]
    # A camera finds a place by its looks: only a lidar searches a window.
    by_scans = config.loops if result.clouds is None else config.cloud_loops
    limits = by_scans if loop.half_width_m > 0.0 else config.visual_loops
    return LoopRow(
        from_keyframe=loop.keyframe,
        to_keyframe=loop.place,
        xy_from=(float(source[0]), float(source[1])),
        xy_to=(float(place[0]), float(place[1])),
        score=float("nan") if loop.motion is None else loop.motion.inlier_share,
        threshold=limits.least_inlier_share,
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


def _unit(result: MapResult) -> Literal["scan", "frame"]:
    """What the map was made of."""
    return "scan" if any(scan is not None for scan in result.keyframe_scans) else "frame"


def _registration_text(record: CameraRecord, config: Config) -> str:
    """Whether a camera's colour is registered to its depth, and by what evidence."""
    registration = record.learned.registration
    if registration is None:
        asked = config.rgbd.registration == "auto"
        return "taken as registered" if asked else "taken as registered (rgbd.registration=given)"
    reason = registration.reason
    return f"registered by the log itself: {reason}" if registration.accepted else reason


def _warnings(result: MapResult) -> list[str]:
    """What a person should know before trusting the map."""
    lines = []
    scans = result.scans
    unit, count = _unit(result), scans.stamps_s.size
    carried = _carried_by_cameras(result)
    lost = int(np.count_nonzero(scans.unmatched & ~carried))
    if lost > _UNMATCHED_SHARE * count:
        lines.append(f"{lost:,} of {count:,} {unit}s matched nothing; their motion is dead reckoning.")
    helped = int(np.count_nonzero(scans.unmatched & carried))
    if unit == "scan" and helped > _UNMATCHED_SHARE * count:
        lines.append(f"At {helped:,} of {count:,} moments the lidar told nothing; cameras told the motion.")
    degenerate = float(scans.degenerate.mean())
    if degenerate > _UNMATCHED_SHARE:
        what = "corridors" if unit == "scan" else "flat or empty views"
        lines.append(
            f"{degenerate:.1%} of the {unit}s leave a direction open ({what}); its variance was inflated."
        )
    return lines


def _carried_by_cameras(result: MapResult) -> BoolArray:
    """(S,) whether a robot's cameras told the step between the keyframes around each moment.

    Where the frames themselves made the map, a lost one is lost.
    """
    count, keyframes = result.scans.stamps_s.size, result.keyframe_numbers
    told = np.zeros(len(keyframes), dtype=np.bool_)
    if isinstance(result.graph.pose(0), gtsam.Pose2):
        for edge, keep in zip(result.graph.edges, result.edges_kept, strict=True):
            if keep and edge.kind is EdgeKind.RGBD and edge.target == edge.source + 1:
                told[edge.target] = True
    # After the last keyframe the robot has hardly moved: what held before it holds on.
    return told[np.minimum(np.searchsorted(keyframes, np.arange(count)), len(keyframes) - 1)]


def _version(package: str) -> str:
    """Installed version, empty where the package is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
