"""Mapping with a 3D lidar: clouds -> keyframes -> graph -> loops, in SE(3); the plan is cut by height.

Cameras beside it see what it passes: the map's colours and depth layer, see `slam.mapper.cloud_cameras`.
"""

from __future__ import annotations

import time
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np

from fusion.height_band import HeightBand
from slam.config import Config
from slam.errors import DatasetError, ScanweaveError
from slam.graph.anchored_steps import AnchoredSteps
from slam.graph.cloud_loops import CloudLoopCloser
from slam.graph.pose_graph import EdgeKind
from slam.graph.spatial_graph import SpatialGraph
from slam.mapper.cloud_cameras import CloudCameras
from slam.mapper.journal import Journal
from slam.mapper.keyframe_fusion import FusionSummary
from slam.mapper.map_result import MappedClouds, MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.scan_record import ScanRecorder
from slam.mapping.band_scan import band_scan, ground_of
from slam.mapping.cloud_keyframes import CloudKeyframes, CloudSpool
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.matching.cloud_points import at_middle_of_turn, thinned
from slam.measurements import FloatArray, LaserScan, PointCloud, WheelOdometry
from slam.odometry.cloud_tracker import CloudTracker, TrackedCloud
from slam.odometry.wheel_tracker import WheelTracker
from slam.trajectory.frame_poses import FramePoses, at_stamps
from slam.vision.color_registration import ColorRegistration
from slam.vision.prepared_frame import PreparedFrame

# A kept cloud is as fine as the map, and four times as fine as the matching.
_KEPT_SHARE = 0.25
# So many scans of which none matched are no log of a 3D lidar.
_HOPELESS = 20
# A larger share of doubtful matches is worth a warning.
_MOST_DOUBTFUL = 0.02


@dataclass(frozen=True, slots=True)
class _Plan:
    """The flat scan of each keyframe, repaired and as measured, the grid of them, and how it came about."""

    scans: list[LaserScan | None] = field(default_factory=list)
    measured: list[LaserScan | None] = field(default_factory=list)
    grid: OccupancyGrid | None = None
    ground_m: float = 0.0
    fused: FusionSummary | None = None
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


class CloudMapper:
    """State of a run: feed clouds in log order, then finish; see `slam.mapper.protocol.Mapper`.

    The map frame is that of the first base pose.
    """

    def __init__(self, config: Config, journal: Journal | None = None) -> None:
        self._config, self._journal = config, journal or Journal()
        settings = config.cloud_odometry
        self._wheels = WheelTracker(config.wheels) if settings.use_wheel_odometry else None
        self._tracker = CloudTracker(settings, self._wheels, self._journal)
        spool = self._journal.cloud_spool()
        self._clouds: CloudSpool = CloudKeyframes() if spool is None else spool
        self._cameras = CloudCameras(config, self._journal)
        self._closer: CloudLoopCloser | None = None
        self._graph = SpatialGraph(gtsam.Pose3(), config.graph)
        self._steps = AnchoredSteps(settings.local_map_keyframes)
        self._frames = FramePoses()
        self._record = ScanRecorder()
        self._last_keyframe: gtsam.Pose3 | None = None
        self._travelled_m = 0.0
        self._stamps_s: list[float] = []
        # The stamps of the log, by which the trajectory is told; all else goes by the middle of each turn.
        self._seen_s = array("d")
        self._T_base_lidar = gtsam.Pose3()
        self._matched, self._doubtful = 0, 0

    @property
    def scan_count(self) -> int:
        """Clouds so far."""
        return len(self._frames)

    def note_registrations(self, registrations: Mapping[str, ColorRegistration]) -> None:
        """Take down where colour cameras sit that are not registered to depth."""
        self._cameras.note_registrations(registrations)

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """None: the log must tell where a camera sits."""
        return {}

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Take a wheel odometry reading, for the next guess."""
        if self._wheels is not None:
            self._cameras.note_wheels(reading)
            self._wheels.add(reading)

    def add_scan(self, scan: LaserScan) -> None:
        """A planar scan tells less than a cloud."""

    def add_frame(self, frame: PreparedFrame) -> None:
        """Take a camera's frame."""
        self._cameras.add(frame)

    def add_cloud(self, cloud: PointCloud) -> None:
        """Match a cloud; where the robot has moved on, make it a keyframe and close loops."""
        started = time.perf_counter()
        self._seen_s.append(cloud.stamp_s)
        cloud = at_middle_of_turn(cloud, self._config.cloud_odometry)
        tracked = self._tracker.track(cloud)
        self._frames.add(cloud.stamp_s, tracked.pose)
        self._matched += tracked.motion is not None
        self._doubtful += tracked.motion is not None and not tracked.motion.converged
        self._cameras.note_cloud(cloud.stamp_s, tracked)
        if tracked.new_keyframe:
            self._T_base_lidar = cloud.T_base_lidar
            self._stamps_s.append(cloud.stamp_s)
            key, closer = self._add_keyframe(tracked)
            for candidate in closer.close(key, self._graph.poses()):
                self._graph.add_loop(candidate)
            self._graph.update()
        self._record.add(self._seen_s[-1], tracked.motion, time.perf_counter() - started)

    def finish(self) -> MapResult:
        """Optimise everything, give every cloud its pose, and draw the plan."""
        self._check()
        clock = [time.perf_counter()]
        outcome = self._graph.optimize(self._config.loops.inlier_probability)
        clock.append(time.perf_counter())
        bases = self._graph.poses()
        trajectory = at_stamps(self._frames.trajectory(bases, gtsam.Pose3()), np.array(self._seen_s))
        clock.append(time.perf_counter())
        planar = np.array([[pose.x(), pose.y(), pose.rotation().yaw()] for pose in bases])
        plan = self._plan(planar)
        clock.append(time.perf_counter())
        record = self._record.finish()
        return MapResult(
            trajectory=trajectory,
            keyframe_poses=planar,
            keyframe_numbers=self._frames.keyframes(),
            keyframe_scans=plan.scans,
            graph=self._graph.graph,
            edges_kept=outcome.kept,
            loops=self._graph.loops,
            scans=record,
            grid=plan.grid,
            stage_seconds={
                "scans": float(record.seconds.sum()),
                "final optimisation": clock[1] - clock[0],
                "full trajectory": clock[2] - clock[1],
                "grid": clock[3] - clock[2],
            },
            warnings=[*plan.warnings, *self._doubts(), *self._cameras.warnings()],
            notes=[f"3D lidar: voxels of {self._tracker.voxel_m:.2f} m", *plan.notes, *self._cameras.notes()],
            dense=self._cameras.dense(bases),
            fused=plan.fused,
            cameras=self._cameras.records(),
            measured_scans=plan.measured,
            clouds=MappedClouds(self._clouds, bases, self._T_base_lidar, plan.ground_m),
        )

    def _check(self) -> None:
        """Refuse what is no map."""
        if not len(self._clouds):
            raise DatasetError(
                f"none of {len(self._frames):,} clouds has {self._config.cloud_odometry.least_pairs} usable "
                "points; look at cloud_odometry.range_min_m and range_max_m, and at 'scanweave inspect'"
            )
        if not self._matched and len(self._frames) >= _HOPELESS:
            raise DatasetError(
                f"none of {len(self._frames):,} clouds matched another; planes need several rings, "
                "and points dense enough for cloud_odometry.voxel_m"
            )

    def _doubts(self) -> list[str]:
        """A warning where clouds fitted the map only in part."""
        if self._doubtful <= _MOST_DOUBTFUL * self._matched:
            return []
        return [
            f"{self._doubtful:,} of {self._matched:,} clouds fit only in part; their motions count as unsure"
        ]

    def _add_keyframe(self, tracked: TrackedCloud) -> tuple[int, CloudLoopCloser]:
        """Grow the local map, the graph and the loop closer by a cloud; its number."""
        covariance, motion, stamp_s = None, tracked.motion, self._stamps_s[-1]
        key, bridge = len(self._clouds), None
        if self._closer is None:
            settings, voxel_m = self._config.cloud_odometry, self._tracker.voxel_m
            self._closer = CloudLoopCloser(
                self._config.cloud_loops, settings, voxel_m, self._clouds, self._journal
            )
        if self._last_keyframe is not None:
            step = self._last_keyframe.between(tracked.pose)
            kind = EdgeKind.LIDAR
            if motion is not None:
                covariance, bridge = self._steps.add(key, step, tracked.pose, motion)
            elif (seen := self._cameras.step(stamp_s)) is not None:
                (step, covariance), kind = seen, EdgeKind.RGBD
            self._graph.add_keyframe(step, covariance, kind)
            covariance = self._graph.graph.edges[-1].covariance
            self._travelled_m += float(np.linalg.norm(step.translation()))
        if motion is None:
            self._steps.begin(key, tracked.pose)
        self._last_keyframe = tracked.pose
        self._tracker.add_keyframe(tracked)
        self._frames.mark_keyframe()
        kept_m = min(_KEPT_SHARE * self._tracker.voxel_m, self._config.cloud_map.voxel_m)
        self._clouds.add(stamp_s, thinned(tracked.points, kept_m), self._T_base_lidar)
        self._cameras.add_keyframe(key, stamp_s, tracked.points, self._T_base_lidar)
        residual_m = np.nan if motion is None else motion.residual_m
        self._closer.add_keyframe(tracked.points, tracked.pose, self._travelled_m, covariance, residual_m)
        if bridge is not None:
            self._graph.add_bridge(bridge)
            self._closer.add_bridge(bridge)
        return key, self._closer

    def _plan(self, poses: FloatArray) -> _Plan:
        """The flat scan of each keyframe, and the grid of them."""
        settings, layers = self._config.cloud_map, self._config.layers
        lidar_m = float(self._T_base_lidar.z())
        thickness_m = self._config.cloud_odometry.thickness_m
        ground = ground_of(self._clouds, self._T_base_lidar, self._tracker.voxel_m, thickness_m)
        if ground is None:
            return _Plan(warnings=["No grid was built: no ground was seen, and no mounting tells its height"])
        ground_m, source = ground.height_m, "the mounting" if ground.by_mounting else "sight"
        notes = [f"ground: {ground_m:+.2f} m in the base frame, by {source}"]
        try:
            if layers.climb_m >= layers.robot_height_m:
                raise DatasetError("layers.climb_m leaves no height to layers.robot_height_m; make it lower")
            band = HeightBand(0.0, layers.robot_height_m, layers.climb_m)
            measured: list[LaserScan | None] = [
                band_scan(points, stamp_s, self._T_base_lidar, band, ground_m, settings)
                for points, stamp_s in zip(self._clouds, self._stamps_s, strict=True)
            ]
            in_band = layers.climb_m < lidar_m - ground_m < layers.robot_height_m
            scans, fused = self._cameras.repaired(measured, in_band=in_band)
            notes += [] if fused is None else [fused.note]
            grid = grid_of_keyframes(scans, poses, self._config)
            return _Plan(scans, measured, grid, ground_m, fused, notes)
        except ScanweaveError as error:
            return _Plan(ground_m=ground_m, notes=notes, warnings=[f"No grid was built: {error}"])
