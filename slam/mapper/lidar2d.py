"""A robot on a floor: a 2D lidar leads, wheels predict, cameras see what it misses; SE(2)."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from slam.config import Config
from slam.graph.edge import Edge
from slam.graph.faulty_steps import settle_wheels
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_closure import LoopCandidate, LoopCloser
from slam.graph.place_search import PlaceSearch
from slam.heap import end_stage
from slam.mapper.camera_keyframes import CameraKeyframes
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.keyframe_fusion import KeyframeFusion
from slam.mapper.keyframe_store import registration_notes
from slam.mapper.map_result import MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.planar_chain import PlanarChain
from slam.mapper.protocol import Tracked
from slam.mapper.robot_cameras import CameraPoses, RobotCameras
from slam.mapper.tags import TagFinder
from slam.mapping.moving_things import MovingThings
from slam.matching.local_map import OrientedPoints
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.matching.scan_points import ScanPoints, points_by
from slam.measurements import BoolArray, ImuReading, LaserScan, Pose, WheelOdometry, pose2_from_row
from slam.odometry import STANDARD, Odometries
from slam.odometry.cached_odometry import CachedOdometry
from slam.odometry.clock_learner import Turns
from slam.odometry.gyro_yaw import YawGyro
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import WheelTracker
from slam.trajectory.readings import Readings
from slam.vision.color_registration import ColorRegistration
from slam.vision.prepared_frame import PreparedFrame


@dataclass(frozen=True, slots=True)
class _Moment:
    """The newest moment: its scan and points, None where a camera carries the robot on, and its pose."""

    stamp_s: float
    scan: LaserScan | None
    points: ScanPoints | None
    tracked: TrackedScan
    camera_poses: CameraPoses


class PlanarRobot:
    """Scans, wheels and cameras of a robot on a floor; see `slam.mapper.protocol.FrontEnd`.

    Parameters
    ----------
    ahead
        Whether only where scans were taken is asked, see `slam.mapper.forerunner`.
    """

    def __init__(
        self,
        config: Config,
        checkpoint: Checkpoint | None = None,
        registrations: Mapping[str, ColorRegistration] | None = None,
        mountings: Mapping[str, LearnedMounting] | None = None,
        odometries: Odometries = STANDARD,
        *,
        ahead: bool = False,
    ) -> None:
        self.readings = Readings()
        checkpoint, registrations = checkpoint or Checkpoint(), registrations or {}
        self._config, self._registrations = config, registrations
        self._gyro = YawGyro() if config.sensors.imu else None
        self._wheels = WheelTracker(config.wheels, self._gyro) if config.sensors.wheels else None
        odometry = CachedOdometry(odometries.lidar(config), checkpoint)
        self._tracker = MotionTracker(odometry, self._wheels, config.prediction, config.match, self._gyro)
        turns = Turns() if self._wheels is None else self._wheels.turns
        self.tags = TagFinder(config.sensors.tags, registrations)
        self._cameras = RobotCameras(
            config, mountings or {}, tags=self.tags, wheel_turns=turns, result_cache=checkpoint
        )
        self._chain = PlanarChain(config, self._tracker, self._wheels, self._cameras)
        self._closer = LoopCloser(config.loops, config.match, checkpoint)
        self._places = PlaceSearch(self._closer, config.loops, config.match, config.graph, checkpoint)
        self._pictures = CameraKeyframes(config, checkpoint, registrations)
        self._fusion = KeyframeFusion(config.fusion) if config.fusion.enabled else None
        self._moving, self._ahead = MovingThings(config.scan.range_max_m), ahead
        self._camera_poses: CameraPoses = {}
        self._scan_stamp_s = -np.inf
        self._newest: _Moment | None = None
        self._seen = OrientedPoints.none()
        self._keyframe_scans: list[LaserScan | None] = []
        self._travelled_m = 0.0
        self._wheels_name = ""

    def observe(self, measurement: Any) -> Tracked | None:
        """Take the next measurement; where the robot is then, if it tells that."""
        if isinstance(measurement, LaserScan):
            points = points_by(self._config.scan, measurement)
            self._scan_stamp_s = measurement.stamp_s
            return self._track(measurement.stamp_s, measurement, points)
        if isinstance(measurement, PreparedFrame):
            return self._add_frame(measurement)
        if isinstance(measurement, WheelOdometry):
            self._add_wheels(measurement)
        elif isinstance(measurement, ImuReading) and self._gyro is not None:
            self._gyro.add(measurement)
        return None

    def origin(self) -> Pose:
        """The map begins where the robot does."""
        return gtsam.Pose2()

    def step(self, key: int) -> tuple[Pose, Sequence[Edge]]:
        """Motion from the last keyframe to the newest moment, and its edges."""
        moment = self._newest
        assert moment is not None
        points = moment.points
        self._seen = OrientedPoints.none() if points is None else OrientedPoints.from_scan(points)
        step, edges = self._chain.add(key, moment.stamp_s, moment.tracked, moment.camera_poses)
        self._travelled_m += float(np.hypot(step[0], step[1]))
        return pose2_from_row(step), edges

    def recognise(self, key: int, graph: KeyframeGraph) -> list[LoopCandidate]:
        """Remember a keyframe, and try the places that it may have come back to."""
        moment = self._newest
        assert moment is not None
        self.extend_local_map()
        surface = OrientedPoints.surface(moment.points or ScanPoints.none())
        # What is seen is the first part of it: kept once.
        self._seen = surface.only(slice(len(self._seen)))
        self._closer.add_keyframe(self._seen, moment.tracked.pose, self._travelled_m, surface=surface)
        self._keyframe_scans.append(moment.scan)
        self._moving.keep(moment.scan)
        if self._fusion is not None and moment.scan is not None:
            self._fusion.add(key, moment.scan, self._cameras.pictures(moment.camera_poses))
        self._cameras.look_for_tags()
        tried = self._closer.close(key, graph.rows(), graph.uncertainty)
        if pictures := self._cameras.placed_pictures(moment.camera_poses):
            self._pictures.add(key, pictures, places=True)
            if moment.scan is None:
                tried += self._pictures.close(graph.poses())
        return tried

    def extend_local_map(self) -> None:
        """Let later scans be matched to the newest moment too, which is a keyframe."""
        moment = self._newest
        assert moment is not None
        if moment.points is not None:
            self._tracker.add_keyframe(moment.points, moment.tracked)

    def refuse(self) -> None:
        """Whatever a scan sees is a map."""

    def settle(self, graph: KeyframeGraph) -> None:
        """Say anew how cameras and wheels moved, as the whole run tells their clocks and mountings."""
        self._cameras.settle_clocks()
        led, stamps_s = self._cameras.led()
        before = self.readings.keyframe_wheels()
        self.readings.restamp(led, stamps_s)
        if self._wheels is not None:
            self._wheels.learn_clock(self._cameras.scan_turns, final=True)
            used = self._wheels.clock_was_used
            self.readings.read_wheels_at(self._wheels.clock.significant_s, None if used else led)
        stamps_s = self.readings.scan_stamps_s()[self.readings.keyframe_scans()]
        self._chain.settle(graph, stamps_s, before, self.readings.keyframe_wheels())
        settle_wheels(graph, self._config.loops.reach_m)

    def search_again(self, graph: KeyframeGraph, kept: BoolArray) -> list[LoopCandidate]:
        """Places all over the map; where they show which step was wrong, the graph begins without it."""
        stamps_s = self.readings.scan_stamps_s()[self.readings.keyframe_scans()]
        found = self._places.search(graph.rows(), stamps_s, graph.graph.edges, kept, graph.loops)
        if self._places.fault is not None:
            graph.graph.doubt(*self._places.fault)
        if not found:
            del self._places, self._closer  # it was the last search: what they know is large
            end_stage()
        return found

    def bases(self, poses: Sequence[Pose]) -> Sequence[Pose]:
        """The nodes are the bases."""
        return poses

    def complete(self, result: MapResult) -> None:
        """The repaired scans, and the grids that scans and images draw."""
        started, scans = time.perf_counter(), self._keyframe_scans
        result.notes += [*registration_notes(self._registrations), *self._cameras.notes()]
        if self._wheels is not None and self._wheels.clock.known:
            result.notes.append(self._wheels.clock.note("wheels", "lidar"))
        if self._wheels is not None and self._wheels.dead:
            result.warnings.append(
                "The wheels report no motion where the robot has moved; they were left out"
            )
            result.unused[self._wheels_name] = "they report no motion where the robot has moved"
        if self._gyro is not None:
            result.notes += self._gyro.notes()
            if self._gyro.unfit:
                why = "its turns are not those of the lidar: a wrong axis, sign, unit or clock"
                result.unused[self._gyro.sensor] = why
                result.warnings.append(f"{self._gyro.sensor} is not used: {why}")
        if self._fusion is not None:
            scans, result.fused = self._fusion.repair(scans)
            result.notes += [] if result.fused is None else [result.fused.note]
        scans = self._moving.taken_from(scans)
        result.stage_seconds["fusion"] = time.perf_counter() - started
        result.add_cameras(self._cameras.records(self._registrations), self._pictures.frames)
        result.map = replace(result.map, measured_scans=self._keyframe_scans, keyframe_scans=scans)
        result.draw(self._config)
        result.warnings += self._cameras.warnings()
        result.unused |= dict.fromkeys(
            self._cameras.unplaced(),
            "it is not known where it sits on the robot; it repaired scans only",
        )

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Where cameras sit that the log does not tell, as far as this run has shown."""
        return self._cameras.learned_mountings()

    def _add_wheels(self, reading: WheelOdometry) -> None:
        """Take a wheel odometry reading: a guess for the next scan, and a reading that wants a pose."""
        self._wheels_name = reading.sensor
        if self._wheels is None:
            self.readings.add_wheel(reading.stamp_s, None)
            return
        self.readings.add_wheel(reading.stamp_s, self._wheels.add(reading))

    def _add_frame(self, frame: PreparedFrame) -> Tracked | None:
        """Track a frame; where no scan has come for a while, the leading camera carries the robot on."""
        self._cameras.add(frame)
        if self._config.sensors.lidar and np.isneginf(self._scan_stamp_s):
            # The lidar is about to begin: without a scan the first keyframe would leave it nothing to match.
            self._scan_stamp_s = frame.stamp_s
        stamp_s = self._cameras.robot_stamp_s(frame)
        silent = stamp_s - self._scan_stamp_s > self._config.sensors.lidar_silent_s
        if not silent or not self._cameras.leads(frame.frame.sensor, stamp_s):
            return None
        camera = self._cameras.cameras[frame.frame.sensor]
        camera.led_scans.append(self.readings.scan_count)
        camera.led_s.append(frame.stamp_s)
        return self._track(stamp_s, None, None)

    def _track(self, stamp_s: float, scan: LaserScan | None, points: ScanPoints | None) -> Tracked:
        """Pose of a moment."""
        camera_poses = self._cameras.camera_poses(stamp_s)
        steps = [
            step.planar
            for step in self._cameras.steps(self._camera_poses, camera_poses)
            if step.planar is not None
        ]
        cameras = [Motion(step.motion, step.covariance) for step in steps]
        tracked = self._tracker.track(points, stamp_s, cameras)
        if tracked.motion is None:
            self._moving.lose()
        if scan is not None and not self._ahead:
            self._moving.add(scan, tracked.pose)
        if scan is not None and tracked.confident:
            self._cameras.note_scan_turn(stamp_s, tracked.pose[2])
            if self._wheels is not None:
                self._wheels.learn_clock(self._cameras.scan_turns)
            if self._gyro is not None:
                self._gyro.learn_clock(self._cameras.scan_turns)
        self._camera_poses = camera_poses
        self._newest = _Moment(stamp_s, scan, points, tracked, camera_poses)
        self.readings.add_scan(
            stamp_s,
            pose2_from_row(tracked.pose),
            None if tracked.wheels is None else tracked.wheels.pose,
            covariance=None if tracked.motion is None else tracked.motion.covariance,
            trusted=tracked.confident if scan is not None else bool(cameras),
        )
        return Tracked(stamp_s, tracked.motion, self._moved_on(tracked))

    def _moved_on(self, tracked: TrackedScan) -> bool:
        """Whether a scan is far enough from the last keyframe to be the next."""
        last, limits = self._chain.last, self._config.keyframes
        if last is None:
            return True
        step = between(last.pose, tracked.pose)
        return bool(np.hypot(step[0], step[1]) > limits.distance_m or abs(step[2]) > limits.angle_rad)
