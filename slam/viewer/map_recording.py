"""Playback of a finished map: scans and images at their poses, loops at their times, the growing grid.

Everything is at the optimised poses, on the clock of the log.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from slam.config import Config
from slam.errors import ScanweaveError
from slam.localization.output import LocalizerOutput
from slam.mapper.map_result import MapResult
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.matching.local_cloud import moved
from slam.matching.planar import transform_points
from slam.measurements import FloatArray, LaserScan, Measurement, PointCloud, Pose, RgbdFrame, row_from_pose2
from slam.storage.map_contents import MapContents
from slam.trajectory.poses import Poses
from slam.viewer.viewer import Viewer

_GRIDS = 10  # moments at which the growing grid is shown


def record_map(viewer: Viewer, result: MapResult, config: Config) -> None:
    """Show a finished map."""
    contents, layers = result.map, result.map.layers(config)
    poses = contents.node_poses
    positions_m = Poses.of(poses).positions_m
    viewer.polyline("trajectory", contents.trajectory.positions_m)
    for name, holds in (("graph", True), ("refused edges", False)):
        ends = [
            (positions_m[factor.edge.source], positions_m[factor.edge.target])
            for factor in contents.factors
            if factor.kept is holds
        ]
        viewer.edges(name, np.array(ends).reshape(-1, 2, 3), holds=holds)
    for note in [*result.notes, *result.warnings]:
        viewer.note(note)
    _record_keyframes(viewer, result, poses, positions_m)
    for frame in contents.frames or ():
        viewer.at(frame.stamp_s)
        viewer.image(frame.sensor, frame.color, frame.depth_m)
    _record_grids(viewer, contents, config)
    if layers is not None:
        for name in layers.names:
            viewer.grid(f"{name} layer", layers.states(name), layers.resolution_m, layers.T_map_grid)


def record_localization(viewer: Viewer, measurement: Measurement, output: LocalizerOutput) -> None:
    """Show where a robot was found, and what it saw there."""
    viewer.at(output.stamp_s)
    viewer.figure("confidence", output.confidence)
    if output.pose is not None:
        viewer.pose(output.pose)
    if isinstance(measurement, LaserScan) and isinstance(output.pose, gtsam.Pose2):
        viewer.scan(_scan_points(measurement, output.pose))
    elif isinstance(measurement, PointCloud) and isinstance(output.pose, gtsam.Pose3):
        T_map_lidar = output.pose.compose(measurement.T_base_lidar)
        viewer.scan(moved(measurement.points_lidar.astype(np.float64), T_map_lidar))
    elif isinstance(measurement, RgbdFrame):
        viewer.image(measurement.sensor, measurement.color, measurement.depth_m)


def _record_keyframes(
    viewer: Viewer, result: MapResult, poses: Sequence[Pose], positions_m: FloatArray
) -> None:
    """Robot, scan and loops at every keyframe."""
    scans, shares = result.map.keyframe_scans, result.scans.inlier_shares[result.map.readings]
    loops_of: dict[int, list[tuple[int, bool]]] = {}
    for loop in result.map.loops:
        loops_of.setdefault(loop.keyframe, []).append((loop.place, loop.accepted))
    shown = False
    for key, (stamp_s, pose) in enumerate(zip(result.map.stamps_s, poses, strict=True)):
        viewer.at(float(stamp_s))
        viewer.pose(pose)
        scan = scans[key] if key < len(scans) else None
        if scan is not None and isinstance(pose, gtsam.Pose2):
            viewer.scan(_scan_points(scan, pose))
        if np.isfinite(shares[key]):
            viewer.figure("inlier share", float(shares[key]))
        loops = loops_of.get(key, [])
        if loops or shown:  # what the keyframe before has shown goes
            for name, holds in (("loops", True), ("refused loops", False)):
                ends = [(positions_m[place], positions_m[key]) for place, kept in loops if kept is holds]
                viewer.edges(name, np.array(ends).reshape(-1, 2, 3), holds=holds)
        shown = bool(loops)


def _record_grids(viewer: Viewer, contents: MapContents, config: Config) -> None:
    """The grid as it grows, and as it is saved."""
    if contents.grid is None:
        return
    stamps_s, count = contents.stamps_s, len(contents.keyframe_scans)
    for end in np.unique(np.linspace(1, count, _GRIDS + 1).astype(int))[:-1]:
        try:
            grid = grid_of_keyframes(contents.keyframe_scans[:end], contents.keyframe_poses[:end], config)
        except ScanweaveError:
            continue  # the whole one fitted, this one has no beam
        if grid is not None:
            _show(viewer, float(stamps_s[end - 1]), grid)
    _show(viewer, float(stamps_s[-1]), contents.grid)


def _show(viewer: Viewer, stamp_s: float, grid: OccupancyGrid) -> None:
    """The grid at a moment."""
    viewer.at(stamp_s)
    viewer.grid("occupancy", grid.states(), grid.resolution_m, grid.T_map_grid)


def _scan_points(scan: LaserScan, T_map_base: gtsam.Pose2) -> FloatArray:
    """(N, 2) points of a scan, map frame."""
    return transform_points(scan.points_laser(), row_from_pose2(T_map_base.compose(scan.T_base_laser)))
