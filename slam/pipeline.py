"""The main loop: measurements -> keyframes -> graph -> loops -> optimised map."""

from __future__ import annotations

import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.datasets.dataset import Dataset
from slam.errors import DatasetError, ScanweaveError
from slam.graph.loop_closure import LoopCandidate, LoopCloser
from slam.graph.pose_graph import Edge, EdgeKind, PoseGraph
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.mapping.occupancy_grid import InverseSensorModel, OccupancyGrid, PosedScan, build_grid
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between, compose
from slam.matching.scan_points import ScanPoints, extract_points
from slam.measurements import (
    BoolArray,
    FloatArray,
    LaserScan,
    Trajectory,
    WheelOdometry,
    pose2_from_row,
    row_from_pose2,
)
from slam.odometry import make_lidar_odometry
from slam.odometry.motion_tracker import MotionTracker, TrackedScan
from slam.odometry.wheel_tracker import WheelTracker
from slam.readings import Readings


@dataclass(frozen=True, slots=True)
class ScanRecord:
    """What the report tells of every scan, one array entry a scan.

    Attributes
    ----------
    stamps_s, seconds
        Time of the scan and the time that its processing took.
    inlier_shares, residuals_m
        Of the lidar match; NaN where there was none.
    degenerate
        Whether the match had a weak direction.
    """

    stamps_s: FloatArray
    seconds: FloatArray
    inlier_shares: FloatArray
    residuals_m: FloatArray
    degenerate: FloatArray


@dataclass(frozen=True, slots=True)
class MapResult:
    """A finished map.

    Attributes
    ----------
    trajectory
        A pose for every reading of the log.
    keyframe_poses
        (K, 3) optimised x, y, yaw, map frame.
    keyframe_scans
        The sweep of each keyframe.
    graph
        All edges with their provenance.
    loops
        Every loop candidate with its verdict.
    scans
        Scores and timings of every scan.
    keyframe_numbers
        (K,) scan number of each keyframe.
    edges_kept
        (E,) False where the final optimisation refused an edge of the graph.
    grid
        The occupancy grid; None where it could not be built, ``warnings`` then says why.
    stage_seconds
        Wall time by stage.
    warnings
        One line each, for people.
    """

    trajectory: Trajectory
    keyframe_poses: FloatArray
    keyframe_numbers: NDArray[np.int64]
    keyframe_scans: list[LaserScan]
    graph: PoseGraph
    edges_kept: BoolArray
    loops: list[LoopCandidate]
    scans: ScanRecord
    grid: OccupancyGrid | None
    stage_seconds: dict[str, float]
    warnings: list[str]


def build_map(dataset: Dataset, config: Config, on_scan: Callable[[int], None] | None = None) -> MapResult:
    """Run the whole log through the mapper.

    Parameters
    ----------
    dataset
        The log.
    config
        The effective configuration.
    on_scan
        Called with the number of scans so far, for a progress bar.

    Raises
    ------
    DatasetError
        Where the log holds no scan that can be mapped.
    """
    mapper = Mapper(config)
    for measurement in dataset:
        if isinstance(measurement, WheelOdometry):
            mapper.add_odometry(measurement)
        elif isinstance(measurement, LaserScan):
            mapper.add_scan(measurement)
            if on_scan:
                on_scan(mapper.scan_count)
    if mapper.scan_count == 0:
        raise DatasetError(f"{dataset.name} holds no lidar scan; see 'scanweave inspect' for what it holds")
    return mapper.finish()


class Mapper:
    """State of a run: feed measurements in log order, then finish."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._wheels = WheelTracker(config.wheels) if config.lidar_odometry.use_wheel_odometry else None
        self._tracker = MotionTracker(
            make_lidar_odometry(config.lidar_odometry, config.match),
            self._wheels,
            config.prediction,
            config.match,
        )
        self._graph = PoseGraph(gtsam.Pose2())
        self._uncertainty = UncertaintyGraph()
        self._closer = LoopCloser(config.loops, config.match)
        self._readings = Readings()
        self._keyframes: list[TrackedScan] = []
        self._keyframe_scans: list[LaserScan] = []
        self._poses = np.zeros((0, 3))
        self._travelled_m = 0.0
        self._loops: list[LoopCandidate] = []
        self._loop_edges: dict[int, int] = {}
        self._updated_edges = 0
        self._record = _ScanRecorder()

    @property
    def scan_count(self) -> int:
        """Scans so far."""
        return self._readings.scan_count

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Take a wheel odometry reading: a guess for the next scan, and a reading that wants a pose."""
        if self._wheels is None:
            self._readings.add_wheel(reading.stamp_s, None)
            return
        self._wheels.add(reading)
        self._readings.add_wheel(reading.stamp_s, row_from_pose2(reading.T_odom_base))

    def add_scan(self, scan: LaserScan) -> None:
        """Match a scan; where the robot has moved on, make it a keyframe and close loops."""
        started = time.perf_counter()
        settings = self._config.scan
        points = extract_points(scan, settings.range_min_m, settings.range_max_m, settings.neighbours)
        tracked = self._tracker.track(points, scan.stamp_s)
        self._readings.add_scan(scan.stamp_s, tracked.pose, tracked.wheel_pose)
        if self._moved_on(tracked):
            self._add_keyframe(scan, points, tracked)
            self._close_loops()
        self._record.add(scan.stamp_s, tracked, time.perf_counter() - started)

    def add_loop(self, candidate: LoopCandidate) -> None:
        """Take a loop candidate: into the graph if it was accepted, into the report in any case."""
        if candidate.accepted and candidate.motion is not None:
            self._loop_edges[len(self._graph.edges)] = len(self._loops)
            motion = candidate.motion
            self._add_edge(
                Edge(
                    candidate.place,
                    candidate.keyframe,
                    motion.T_reference_base,
                    motion.covariance,
                    EdgeKind.LOOP,
                    trusted=False,
                )
            )
        self._loops.append(candidate)

    def finish(self) -> MapResult:
        """Optimise everything and hand over the result."""
        started = time.perf_counter()
        self._graph.update()
        outcome = self._graph.optimize(self._config.loops.inlier_probability)
        for edge, loop in self._loop_edges.items():
            if not outcome.kept[edge]:
                self._loops[loop] = self._loops[loop].refused("disagrees with the other loops (GNC)")
        optimised = time.perf_counter()
        keyframe_poses = self._graph.planar_poses()
        trajectory = self._readings.trajectory(keyframe_poses)
        spread = time.perf_counter()
        grid, warnings = self._build_grid(keyframe_poses)
        scans = self._record.finish()
        return MapResult(
            trajectory=trajectory,
            keyframe_poses=keyframe_poses,
            keyframe_numbers=self._readings.keyframe_scans(),
            keyframe_scans=self._keyframe_scans,
            graph=self._graph,
            edges_kept=outcome.kept,
            loops=self._loops,
            scans=scans,
            grid=grid,
            stage_seconds={
                "scans": float(scans.seconds.sum()),
                "final optimisation": optimised - started,
                "full trajectory": spread - optimised,
                "occupancy grid": time.perf_counter() - spread,
            },
            warnings=warnings,
        )

    def _build_grid(self, keyframe_poses: FloatArray) -> tuple[OccupancyGrid | None, list[str]]:
        """The grid from the optimised keyframes; a map that would not fit in memory is a warning."""
        settings = self._config.grid
        model = InverseSensorModel(
            p_hit=settings.hit_probability,
            p_miss=settings.miss_probability,
            max_hit_range_m=settings.hit_range_m,
            max_clear_range_m=settings.clear_range_m,
        )
        scans = (
            PosedScan.of(scan, pose2_from_row(pose))
            for scan, pose in zip(self._keyframe_scans, keyframe_poses, strict=True)
        )
        try:
            return build_grid(scans, settings.resolution_m, model, max_cells=settings.greatest_cells), []
        except ScanweaveError as error:
            return None, [f"No grid was built: {error}"]

    def _moved_on(self, tracked: TrackedScan) -> bool:
        """Whether a scan is far enough from the last keyframe to be the next."""
        if not self._keyframes:
            return True
        step = between(self._keyframes[-1].pose, tracked.pose)
        limits = self._config.keyframes
        return bool(np.hypot(step[0], step[1]) > limits.distance_m or abs(step[2]) > limits.angle_rad)

    def _add_keyframe(self, scan: LaserScan, points: ScanPoints, tracked: TrackedScan) -> None:
        """Grow the local map, the graph and the loop closer by a scan."""
        self._tracker.add_keyframe(points, tracked)
        self._uncertainty.add_node()
        if self._keyframes:
            step = between(self._keyframes[-1].pose, tracked.pose)
            self._travelled_m += float(np.hypot(step[0], step[1]))
            self._poses = np.vstack([self._poses, compose(self._poses[-1], step)])
            key = self._graph.add_node(pose2_from_row(self._poses[-1]))
            for edge in self._chain_edges(
                key, step, tracked, scan.stamp_s - self._keyframe_scans[-1].stamp_s
            ):
                self._add_edge(edge)
        else:
            self._poses = np.zeros((1, 3))
        self._keyframes.append(tracked)
        self._keyframe_scans.append(scan)
        self._readings.mark_keyframe()
        self._closer.add_keyframe(OrientedPoints.from_scan(points), tracked.pose, self._travelled_m)

    def _chain_edges(self, key: int, step: FloatArray, tracked: TrackedScan, elapsed_s: float) -> list[Edge]:
        """Edges from the last keyframe: the lidar's where it matched, the wheels' beside it or instead."""
        edges = []
        if tracked.motion is not None:
            covariance = tracked.motion.covariance + tracked.dispute
            # A match may be wrong as a loop may be: a loose twin holds the chain where it is refused.
            edges.append(self._edge(key, step, covariance, EdgeKind.LIDAR, trusted=False))
            loose = covariance + self._chain_covariance(self._config.graph.loose_share)
            edges.append(self._edge(key, step, loose, EdgeKind.ASSUMED, trusted=True))
        last = self._keyframes[-1]
        if self._wheels is not None and last.wheel_pose is not None and tracked.wheel_pose is not None:
            wheel_step = between(last.wheel_pose, tracked.wheel_pose)
            if self._wheels.plausible(wheel_step, elapsed_s):
                covariance = self._wheels.covariance(wheel_step) * self._tracker.wheel_doubt + tracked.dispute
                edges.append(
                    self._edge(key, wheel_step, covariance, EdgeKind.WHEEL, trusted=tracked.motion is None)
                )
        if not any(edge.trusted for edge in edges):
            edges.append(self._edge(key, step, self._chain_covariance(1.0), EdgeKind.ASSUMED, trusted=True))
        return edges

    def _chain_covariance(self, share: float) -> FloatArray:
        """Covariance (3, 3) of a step that nothing measured, its sigmas scaled by a share."""
        lost = self._config.graph
        sigmas = share * np.array([lost.lost_sigma_m, lost.lost_sigma_m, lost.lost_sigma_rad])
        return np.diag(sigmas**2)

    def _edge(
        self, key: int, step: FloatArray, covariance: FloatArray, kind: EdgeKind, *, trusted: bool
    ) -> Edge:
        """An edge from the keyframe before ``key`` to it."""
        return Edge(key - 1, key, pose2_from_row(step), covariance, kind, trusted)

    def _add_edge(self, edge: Edge) -> None:
        """Into the graph, and into the map of relative uncertainties."""
        self._graph.add_edge(edge)
        self._uncertainty.add_edge(
            edge.source, edge.target, row_from_pose2(edge.T_source_target), edge.covariance
        )

    def _close_loops(self) -> None:
        """Try loops from the newest keyframe; bring the estimate up to date now and then."""
        key = len(self._keyframes) - 1
        for candidate in self._closer.close(key, self._poses, self._uncertainty):
            self.add_loop(candidate)
        # Without a new loop the chain alone, which _poses already follows, is the estimate.
        pending = any(edge >= self._updated_edges for edge in self._loop_edges)
        if pending and key % self._config.graph.incremental_every == 0:
            self._graph.update()
            self._poses = self._graph.planar_poses()
            self._updated_edges = len(self._graph.edges)


class _ScanRecorder:
    """Scores and timings of the scans, as flat arrays."""

    def __init__(self) -> None:
        self._columns = [array("d") for _ in range(5)]

    def add(self, stamp_s: float, tracked: TrackedScan, seconds: float) -> None:
        """Take one scan."""
        motion = tracked.motion
        row = (
            stamp_s,
            seconds,
            np.nan if motion is None else motion.inlier_share,
            np.nan if motion is None else motion.residual_m,
            0.0 if motion is None else float(motion.degenerate),
        )
        for column, value in zip(self._columns, row, strict=True):
            column.append(value)

    def finish(self) -> ScanRecord:
        """As arrays."""
        return ScanRecord(*(np.array(column) for column in self._columns))
