"""The main loop: measurements -> keyframes -> graph -> loops -> optimised map."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.datasets.dataset import Dataset
from slam.errors import DatasetError, ScanweaveError
from slam.graph.keyframe_graph import KeyframeGraph, Step
from slam.graph.loop_closure import LoopCandidate, LoopCloser
from slam.graph.pose_graph import PoseGraph
from slam.mapping.occupancy_grid import InverseSensorModel, OccupancyGrid, PosedScan, build_grid
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between
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
from slam.scan_record import ScanRecord, ScanRecorder


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
        self._graph = KeyframeGraph(config.graph)
        self._closer = LoopCloser(config.loops, config.match)
        self._readings = Readings()
        self._record = ScanRecorder()
        self._last_keyframe: TrackedScan | None = None
        self._keyframe_scans: list[LaserScan] = []
        self._travelled_m = 0.0

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
        self._readings.add_scan(scan.stamp_s, tracked.pose, tracked.wheel_pose, sure=tracked.sure)
        if self._moved_on(tracked):
            key = self._add_keyframe(scan, points, tracked)
            for candidate in self._closer.close(key, self._graph.poses(), self._graph.uncertainty):
                self.add_loop(candidate)
            self._graph.update()
        self._record.add(scan.stamp_s, tracked.motion, time.perf_counter() - started)

    def add_loop(self, candidate: LoopCandidate) -> None:
        """Take a loop candidate: into the graph if it was accepted, into the report in any case."""
        self._graph.add_loop(candidate)

    def finish(self) -> MapResult:
        """Optimise everything, give every reading its pose, and draw the grid."""
        clock = [time.perf_counter()]
        outcome = self._graph.optimize(self._config.loops.inlier_probability)
        clock.append(time.perf_counter())
        keyframe_poses = self._graph.poses()
        trajectory = self._readings.trajectory(keyframe_poses)
        clock.append(time.perf_counter())
        grid, warnings = self._build_grid(keyframe_poses)
        clock.append(time.perf_counter())
        scans = self._record.finish()
        stages = ("final optimisation", "full trajectory", "occupancy grid")
        return MapResult(
            trajectory=trajectory,
            keyframe_poses=keyframe_poses,
            keyframe_numbers=self._readings.keyframe_scans(),
            keyframe_scans=self._keyframe_scans,
            graph=self._graph.graph,
            edges_kept=outcome.kept,
            loops=self._graph.loops,
            scans=scans,
            grid=grid,
            stage_seconds={
                "scans": float(scans.seconds.sum()),
                **dict(zip(stages, np.diff(clock).tolist(), strict=True)),
            },
            warnings=warnings,
        )

    def _moved_on(self, tracked: TrackedScan) -> bool:
        """Whether a scan is far enough from the last keyframe to be the next."""
        if self._last_keyframe is None:
            return True
        step = between(self._last_keyframe.pose, tracked.pose)
        limits = self._config.keyframes
        return bool(np.hypot(step[0], step[1]) > limits.distance_m or abs(step[2]) > limits.angle_rad)

    def _add_keyframe(self, scan: LaserScan, points: ScanPoints, tracked: TrackedScan) -> int:
        """Grow the local map, the graph and the loop closer by a scan; the keyframe's number."""
        key = 0
        if self._last_keyframe is not None:
            step = between(self._last_keyframe.pose, tracked.pose)
            self._travelled_m += float(np.hypot(step[0], step[1]))
            match = None
            if tracked.motion is not None:
                match = Step(step, tracked.motion.covariance + tracked.dispute)
            elapsed_s = scan.stamp_s - self._keyframe_scans[-1].stamp_s
            wheels = self._wheel_step(self._last_keyframe, tracked, elapsed_s)
            key = self._graph.add_keyframe(step, match, wheels, match_doubtful=self._doubtful(tracked))
        self._tracker.add_keyframe(points, tracked)
        self._closer.add_keyframe(OrientedPoints.from_scan(points), tracked.pose, self._travelled_m)
        self._readings.mark_keyframe()
        self._keyframe_scans.append(scan)
        self._last_keyframe = tracked
        return key

    def _doubtful(self, tracked: TrackedScan) -> bool:
        """Whether a match was contradicted, or too few points agree with it."""
        least = self._config.graph.sure_inlier_share
        return bool(tracked.motion is None or tracked.dispute.any() or tracked.motion.inlier_share < least)

    def _wheel_step(self, last: TrackedScan, tracked: TrackedScan, elapsed_s: float) -> Step | None:
        """Motion between two keyframes by the wheels; None without wheels or where they jumped."""
        if self._wheels is None or last.wheel_pose is None or tracked.wheel_pose is None:
            return None
        motion = between(last.wheel_pose, tracked.wheel_pose)
        if not self._wheels.plausible(motion, elapsed_s):
            return None
        return Step(motion, self._wheels.covariance(motion) * self._tracker.wheel_doubt + tracked.dispute)

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
