"""Front end for a 3D lidar: clouds give pose and map in SE(3), wheel odometry predicts, the plan is cut out.

Cameras add the colours and the depth layer of the map, see `slam.mapper.cloud_cameras`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from fusion.height_band import HeightBand, thin_to_voxels
from slam.config import Config
from slam.errors import DatasetError, ScanweaveError
from slam.graph.cloud_loops import CloudLoopCloser
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph, unmeasured
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.place_doubt import PlaceDoubt
from slam.heap import end_stage
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.cloud_cameras import CloudCameras
from slam.mapper.map_result import MapResult
from slam.mapper.protocol import FrontEnd, Tracked
from slam.mapping.band_scan import band_scan, ground_of
from slam.mapping.elevation import Elevation, elevation
from slam.matching.cloud_points import at_middle_of_turn
from slam.matching.local_cloud import moved
from slam.matching.upright import Gravity
from slam.measurements import FloatArray, ImuReading, LaserScan, PointCloud, Pose, WheelOdometry, spatial
from slam.odometry.before_first import BeforeFirst
from slam.odometry.clock_learner import Turns
from slam.odometry.cloud_tracker import NO_MAP, CloudTracker, FirstMap, TrackedCloud
from slam.odometry.imu_tracker import ImuTracker, apart_in_time
from slam.odometry.wheel_tracker import WheelTracker
from slam.storage.map_clouds import MapClouds
from slam.storage.map_parts import KeptScans
from slam.trajectory.readings import Readings
from slam.vision.color_registration import ColorRegistration
from slam.vision.prefetch import prefetched
from slam.vision.prepared_frame import PreparedFrame

# A stored cloud is as fine as the map, and four times as fine as the matching.
_KEPT_SHARE = 0.25
# A larger share of doubtful matches gives a warning.
_MOST_DOUBTFUL = 0.02


class CloudLidar(FrontEnd):
    """Front end for clouds, wheels and cameras of a robot in 3D; see `slam.mapper.protocol.FrontEnd`."""

    def __init__(
        self,
        config: Config,
        checkpoint: Checkpoint,
        registrations: Mapping[str, ColorRegistration],
        first: FirstMap = NO_MAP,
    ) -> None:
        self.readings = Readings()
        self._config, self._checkpoint = config, checkpoint
        self._wheels = WheelTracker(config.wheels) if config.sensors.wheels else None
        self._imu = ImuTracker() if config.sensors.imu else None
        self._tracker = CloudTracker(config, self._wheels, checkpoint, self._imu, first)
        self._before_first = BeforeFirst(first)
        self._down: dict[int, Gravity] = {}
        self._clouds = checkpoint.cloud_spool()
        turns = Turns() if self._wheels is None else self._wheels.turns
        self._cameras = CloudCameras(config, checkpoint, registrations, turns)
        self.tags = self._cameras.tags
        self._closer: CloudLoopCloser | None = None
        self._doubt = PlaceDoubt()
        self._newest: TrackedCloud | None = None
        self._last: gtsam.Pose3 | None = None
        self._stamps_s: list[float] = []
        self._stamp_s = 0.0
        self._T_base_lidar = gtsam.Pose3()
        self._matched, self._doubtful, self._unseen = 0, 0, list[str]()
        self._unseen_key: int | None = None
        # Pose of a cloud in the local map since the last keyframe, and (6, 6) of its match.
        self._between: tuple[gtsam.Pose3, FloatArray] | None = None

    def observe(self, measurement: Any) -> Tracked | None:
        """Process the next measurement; return the tracked pose, if it gives one."""
        if isinstance(measurement, PointCloud):
            return self._track(measurement)
        if isinstance(measurement, ImuReading):
            self._tracker.hear(measurement)
        elif isinstance(measurement, PreparedFrame):
            self._cameras.add(measurement)
        elif isinstance(measurement, WheelOdometry) and self._wheels is not None:
            self._tracker.roll(measurement.stamp_s, self._wheels.add(measurement))
        return None

    def origin(self) -> Pose:
        """Return the origin of the map: the first pose of the robot."""
        return gtsam.Pose3()

    def step(self, key: int) -> tuple[Pose, Sequence[Edge]]:
        """Return the motion from the last keyframe to the newest cloud, and its edges."""
        tracked = self._newest
        assert tracked is not None
        motion, edges, step = tracked.motion, list[Edge](), gtsam.Pose3()
        if self._last is not None:
            step = self._last.between(tracked.pose)
            if motion is not None:
                covariance = self._doubt.add(step, motion)
                if self._between is not None:
                    carried = tracked.pose.between(self._between[0]).AdjointMap()
                    covariance = covariance + carried @ self._between[1] @ carried.T
                if key == 1:
                    off = tracked.pose.between(self._last).AdjointMap() @ self._before_first.off
                    covariance = covariance + np.outer(off, off)
                edges.append(Edge(key - 1, key, step, covariance, EdgeKind.LIDAR, trusted=True))
            elif (seen := self._cameras.step(self._stamp_s)) is not None:
                step, covariance = seen
                edges.append(Edge(key - 1, key, step, covariance, EdgeKind.RGBD, trusted=True))
            elif self._imu is not None and (spread := self._imu.spread()) is not None:
                edges.append(Edge(key - 1, key, step, spread, EdgeKind.IMU, trusted=True))
            else:
                self._unseen_key = key
            if tracked.unseen_m and not edges:
                self._unseen.append(
                    f"{tracked.unseen_m:.0f} m before {self._stamp_s - self._stamps_s[0]:.0f} s"
                )
                # Any distance from zero to twice the guess, uniformly distributed, and any heading.
                spread = unmeasured(self._config.graph, planar=False)
                spread[2, 2] = math.pi**2 / 3.0
                spread[[3, 4], [3, 4]] = max(spread[3, 3], tracked.unseen_m**2 / 3.0)
                edges.append(Edge(key - 1, key, step, spread, EdgeKind.ASSUMED, trusted=True))
        if motion is None:
            self._doubt.begin()
        first = motion if self._last is None else None
        # The next step also has the error of the first cloud in the first map.
        self._between = None if first is None else (tracked.pose, first.covariance)
        self._last = tracked.pose
        return step, edges

    def recognise(self, key: int, graph: KeyframeGraph) -> list[LoopCandidate]:
        """Store a keyframe, and try to close loops with places it may have returned to."""
        tracked = self._newest
        assert tracked is not None
        if self._imu is not None and (gravity := self._imu.gravity()) is not None:
            self._down[key] = gravity
        if self._closer is None:
            self._closer = CloudLoopCloser(
                self._config, self._tracker.voxel_m, self._clouds.points, self._checkpoint
            )
        self._stamps_s.append(self._stamp_s)
        self._tracker.add_keyframe(tracked)
        kept_m = min(_KEPT_SHARE * self._tracker.voxel_m, self._config.grid.resolution_m)
        rows, intensities = tracked.points, self._tracker.intensities()
        if intensities is not None:
            rows = np.column_stack([rows, intensities])
        rows = thin_to_voxels(rows, kept_m)
        self._clouds.add(self._stamp_s, rows, self._T_base_lidar)
        self._cameras.add_keyframe(key, self._stamp_s, tracked.points, self._T_base_lidar)
        residual_m = np.nan if tracked.motion is None else tracked.motion.residual_m
        self._closer.add_keyframe(rows[:, :3], tracked.pose, residual_m, unseen=self._unseen_key == key)
        return self._closer.close(key, graph.poses(), graph.rows(), graph.uncertainty)

    def refuse(self) -> None:
        """Raise an error if the data are not enough for a map."""
        clouds = self.readings.scan_count
        if not self._stamps_s:
            raise DatasetError(
                f"none of {clouds:,} clouds has {self._config.cloud_odometry.least_pairs} usable "
                "points; look at cloud_odometry.range_min_m and range_max_m, and at 'scanweave inspect'"
            )
        if not self._matched and clouds >= FEWEST:
            raise DatasetError(
                f"none of {clouds:,} clouds matched another; planes need several rings, "
                "and points dense enough for cloud_odometry.voxel_m"
            )

    def settle(self, graph: KeyframeGraph) -> None:
        """Place the frames, and level the map if gravity is known; steps are final already.

        Loops across a gap without measurements are rejected if nothing else confirms them.
        """
        self.readings.before_first = self._before_first.offset
        for loop in [] if self._closer is None else self._closer.alone():
            graph.add_loop(loop)
        self._cameras.settle(graph, np.array(self._stamps_s))
        if self._down:
            graph.graph.level(apart_in_time(self._down))

    def complete(self, result: MapResult) -> None:
        """Add the clouds, and the plan of obstacles."""
        # The appearance of all places, and what is left of the final optimisation.
        self._closer = None
        end_stage()
        sigma_s = self._config.sensors.calibration.cloud_sigma_s
        result.map = replace(result.map, clouds=self._clouds, clock_sigma_s=sigma_s)
        result.add_cameras(self._cameras.records(), self._cameras.frames)
        result.notes.append(f"3D lidar: voxels of {self._tracker.voxel_m:.2f} m")
        self._draw_plan(result)
        result.warnings += [*self._doubts(), *self._cameras.warnings()]
        result.notes += self._cameras.notes()
        if self._imu is not None:
            result.add_imu_notes(*self._imu.outcome())
        result.unused |= self._cameras.unused()

    def _track(self, cloud: PointCloud) -> Tracked:
        """Find the pose of a cloud."""
        reported_s = cloud.stamp_s
        cloud = at_middle_of_turn(cloud, self._config.cloud_odometry)
        tracked = self._tracker.track(cloud)
        if not self.readings.scan_count:
            self._before_first.begin(reported_s, cloud.stamp_s, self._tracker.twist)
        if self._imu is not None:
            self._before_first.see(self._imu)
        self._newest, self._stamp_s = tracked, cloud.stamp_s
        self._matched += tracked.motion is not None
        self._doubtful += tracked.motion is not None and not tracked.motion.converged
        self._cameras.note_cloud(cloud.stamp_s, tracked)
        keyframe = tracked.new_keyframe and not self._passed(tracked)
        if keyframe:
            self._T_base_lidar = cloud.T_base_lidar
        guessed = tracked.motion is None and not keyframe and self._imu is not None
        if guessed and self._imu is not None and (spread := self._imu.spread()) is not None:
            self.readings.bridged[self.readings.scan_count] = spread
        self.readings.add_scan(cloud.stamp_s, tracked.pose, reported_s=reported_s)
        return Tracked(reported_s, tracked.motion, keyframe)

    def _passed(self, tracked: TrackedCloud) -> bool:
        """Add every second cloud only to the local map, if its pose is certain and it has no images."""
        motion = tracked.motion
        sure = motion is not None and motion.converged and not motion.degenerate
        if motion is None or not sure or self._last is None or self._between or self._cameras.frames:
            return False
        self._between = tracked.pose, motion.covariance
        self._tracker.add_keyframe(tracked)
        return True

    def _doubts(self) -> list[str]:
        """Return a warning about unmeasured parts of the path, and about clouds that matched only in part."""
        doubts, count = list[str](), f"{self._doubtful:,} of {self._matched:,} clouds"
        if self._unseen:
            doubts.append(
                f"no sensor observed the motion over about {', '.join(self._unseen)}: only loops "
                "or GNSS connect the parts before and after, and an error in them misplaces the later part"
            )
        if self._doubtful > _MOST_DOUBTFUL * self._matched:
            doubts.append(f"{count} match the map only in part; their motions are treated as uncertain")
        return doubts

    def _draw_plan(self, result: MapResult) -> None:
        """Draw the 2D scan of each keyframe, and the grids."""
        layers = self._config.layers
        thickness_m = self._config.cloud_odometry.thickness_m
        ground = ground_of(self._clouds, self._T_base_lidar, self._tracker.voxel_m, thickness_m)
        if ground is None:
            result.warnings.append(
                "No grid was built: no ground was seen, and its height does not follow from the mounting"
            )
            return
        source = "the mounting" if ground.by_mounting else "the clouds"
        result.notes.append(f"ground: {ground.height_m:+.2f} m in the base frame, from {source}")
        try:
            poses = [spatial(pose) for pose in result.map.node_poses]
            reach_m = self._config.cloud_map.plan_range_m
            result.ground = elevation(self._clouds, poses, ground.height_m, reach_m)
            measured = band_scans(self._clouds, poses, ground.height_m, result.ground, self._config)
            in_band = layers.climb_m < self._T_base_lidar.z() - ground.height_m < layers.robot_height_m
            scans, result.fused = self._cameras.repaired(measured, in_band=in_band)
        except ScanweaveError as error:
            result.warnings.append(f"No grid was built: {error}")
            return
        result.notes += [] if result.fused is None else [result.fused.note]
        result.map = replace(
            result.map, measured_scans=measured, keyframe_scans=scans, ground_m=ground.height_m
        )
        result.draw(self._config)


def band_scans(
    clouds: MapClouds, poses: Sequence[gtsam.Pose3], ground_m: float, ground: Elevation | None, config: Config
) -> KeptScans:
    """Return the 2D scan of each keyframe: obstacles, and free ground.

    Parameters
    ----------
    poses
        ``T_map_base`` of each keyframe.
    ground_m
        Height of the ground in the base frame, at the robot.
    ground
        Ground of the map; if unknown, it is level under each keyframe.
    """
    layers, T_base_lidar = config.layers, clouds.T_base_lidar(len(clouds) - 1)
    band = HeightBand(0.0, layers.robot_height_m, layers.climb_m)

    def scan(one: tuple[FloatArray, float, gtsam.Pose3]) -> LaserScan:
        points, stamp_s, T_map_base = one
        T_level_base, clears = level(T_map_base), ground is not None
        below_m: float | FloatArray = ground_m
        upright, lidar = moved(points, T_level_base), T_level_base.compose(T_base_lidar)
        if ground is not None:
            below_m = upright[:, 2] - ground.above_m(moved(points, T_map_base))
        return band_scan(upright, stamp_s, lidar, band, below_m, config.cloud_map, clears=clears)

    stamps_s = (clouds.stamp_s(key) for key in range(len(clouds)))
    return KeptScans.on_disk(prefetched(zip(clouds, stamps_s, poses, strict=True), scan, most_waiting=1))


def level(T_map_base: gtsam.Pose3) -> gtsam.Pose3:
    """Return ``T_level_base``: the tilt of the base in a level frame with the same position and yaw."""
    turn = gtsam.Rot3.Yaw(T_map_base.rotation().yaw())
    return gtsam.Pose3(turn.inverse().compose(T_map_base.rotation()), np.zeros(3))
