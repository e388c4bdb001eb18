"""Path of a robot on a floor: match scans, use wheel odometry, gyroscope and cameras; no map yet."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.estimates import MotionEstimate
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.wheel_edges import calibrate_wheel_edges
from slam.mapper.map_result import MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.planar_chain import PlanarChain
from slam.mapper.robot_cameras import CameraPoses, RobotCameras
from slam.mapper.tags import TagFinder
from slam.matching.local_map import OrientedPoints
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.matching.scan_points import ScanPoints, points_by
from slam.measurements import FloatArray, ImuReading, LaserScan, WheelOdometry, pose2_from_row
from slam.odometry import Odometries
from slam.odometry.cached_odometry import CachedOdometry
from slam.odometry.clock_learner import Turns
from slam.odometry.gyro_yaw import YawGyro
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.surfel_odometry import LEAST_POINTS
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import WheelTracker
from slam.result_cache import ResultCache
from slam.trajectory.readings import Readings
from slam.vision.color_registration import ColorRegistration
from slam.vision.prepared_frame import PreparedFrame


@dataclass(frozen=True, slots=True)
class Moment:
    """A time at which the pose of the robot is known.

    Attributes
    ----------
    scan
        The scan; None if a camera continues the track.
    pose
        (3,) pose in the odometry frame.
    motion
        The match that gave the pose; None if nothing matched.
    new_keyframe
        Whether the robot has moved far enough for a keyframe.
    """

    stamp_s: float
    scan: LaserScan | None
    pose: FloatArray
    motion: MotionEstimate | None
    new_keyframe: bool


@dataclass(frozen=True, slots=True)
class Step:
    """The part of the map that a keyframe adds.

    Attributes
    ----------
    step
        (3,) the motion from the keyframe before.
    edges
        Edges to it from earlier keyframes.
    surface, seen
        Points of its scan for a map, base frame, and how many of them, the first, it has seen itself.
    """

    step: FloatArray
    edges: Sequence[Edge]
    surface: OrientedPoints
    seen: int


class Steps(Protocol):
    """Tracks the path of a robot: `PlanarOdometry`, or a process ahead, see `slam.mapper.lookahead`."""

    def observe(self, measurement: Any) -> Moment | None:
        """Process the next measurement; return the pose of the robot, if it is a scan."""
        ...

    def step(self, key: int) -> Step:
        """The newest moment becomes keyframe ``key``: later scans are matched to it too."""
        ...


class PlanarOdometry:
    """Track a robot on a floor by its scans, wheel odometry, gyroscope and cameras.

    Attributes
    ----------
    readings
        Readings of the log so far, with their poses in the odometry frame.
    """

    def __init__(
        self,
        config: Config,
        result_cache: ResultCache,
        odometries: Odometries,
        registrations: Mapping[str, ColorRegistration] | None = None,
        mountings: Mapping[str, LearnedMounting] | None = None,
    ) -> None:
        self.readings = Readings()
        self._config = config
        self._gyro = YawGyro() if config.sensors.imu else None
        self._wheels = WheelTracker(config.wheels, self._gyro) if config.sensors.wheels else None
        odometry = CachedOdometry(odometries.lidar(config), result_cache)
        self._tracker = MotionTracker(odometry, self._wheels, config.prediction, config.match, self._gyro)
        self.cameras = RobotCameras(
            config,
            mountings or {},
            tags=TagFinder(config.sensors.tags, registrations or {}),
            wheel_turns=Turns() if self._wheels is None else self._wheels.turns,
            result_cache=result_cache,
        )
        self._chain = PlanarChain(config, self._tracker, self._wheels, self.cameras)
        self._camera_poses: CameraPoses = {}
        self._scan_stamp_s = self._matched_s = -np.inf
        self._newest: tuple[float, ScanPoints | None, TrackedScan] | None = None
        self._wheels_name = ""
        # Stamps of keyframes without a match although the wheels report hardly any motion.
        self._unexplained_s: list[float] = []

    def observe(self, measurement: Any) -> Moment | None:
        """Process the next measurement; return the pose of the robot, if it is a scan."""
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

    def step(self, key: int) -> Step:
        """The newest moment becomes keyframe ``key``: later scans are matched to it too."""
        assert self._newest is not None
        stamp_s, points, tracked = self._newest
        last = self._chain.last
        blind = points is None or len(points.oriented()[0]) < LEAST_POINTS
        step, edges = self._chain.add(key, stamp_s, tracked, self._camera_poses, blind=blind)
        if points is None:
            return Step(step, edges, OrientedPoints.none(), 0)
        lost = tracked.motion is None and tracked.wheels and not blind
        near = math.hypot(step[0], step[1]) < self._config.match.search_half_width_m
        # A robot whose camera tracks on was not carried.
        seen = any(edge.kind is EdgeKind.RGBD for edge in edges)
        self._unexplained_s += [stamp_s] if lost and near and last and last.motion and not seen else []
        self._tracker.add_keyframe(points, tracked)
        return Step(step, edges, OrientedPoints.surface(points), len(points.oriented()[0]))

    def settle(self, graph: KeyframeGraph) -> None:
        """Recompute the steps of cameras and wheels with the clocks and mountings estimated in the run."""
        self.cameras.settle_clocks()
        led, stamps_s = self.cameras.led()
        before = self.readings.keyframe_wheels()
        self.readings.restamp(led, stamps_s)
        if self._wheels is not None:
            self._wheels.learn_clock(self.cameras.scan_turns, final=True)
            used = self._wheels.clock_was_used
            self.readings.read_wheels_at(self._wheels.clock.significant_s, None if used else led)
        stamps_s = self.readings.scan_stamps_s()[self.readings.keyframe_scans()]
        wheels, config = self.readings.keyframe_wheels(), self._config
        self._chain.settle(graph, stamps_s, before, wheels)
        calibrate_wheel_edges(graph, config.loops.reach_m, wheels, stamps_s, config.graph)

    def learned(self) -> tuple[Any, ...]:
        """Return what was learned on the whole path: plain objects, for `take_over`."""
        wheels = self._wheels, self._wheels_name, self._unexplained_s
        return self.readings, self._gyro, self.cameras.scan_turns, *wheels

    def take_over(self, learned: tuple[Any, ...]) -> None:
        """Adopt what another object has `learned`, for a robot without cameras."""
        readings, self._gyro, self.cameras.scan_turns, *wheels = learned
        self._wheels, self._wheels_name, self._unexplained_s = wheels
        vars(self.readings).update(vars(readings))

    def add_notes(self, result: MapResult) -> None:
        """Add notes about the wheels and the gyroscope for the user."""
        if self._wheels is not None and self._wheels.clock.known:
            result.notes.append(self._wheels.clock.note("wheels", "lidar"))
        if self._wheels is not None and self._wheels.dead and self._wheels_name:
            result.warnings.append(
                "The wheel odometry reports no motion while the robot moves; it is not used"
            )
            result.unused[self._wheels_name] = "it reports no motion while the robot moves"
        if self._unexplained_s:
            at_s, count = self._unexplained_s[0] - self.readings.scan_stamps_s()[0], len(self._unexplained_s)
            result.warnings.append(
                f"At {at_s:.1f} s a scan does not match what was seen there before ({count} such scans), "
                "although the wheels report hardly any motion: it was carried, or its view was blocked. "
                "If it was carried, the map after this moment is misplaced until a loop corrects it"
            )
        if self._gyro is not None:
            result.notes += self._gyro.notes()
            if self._gyro.unfit:
                why = "its rotation does not agree with the lidar's: a wrong axis, sign, unit or clock"
                result.unused[self._gyro.sensor] = why
                result.warnings.append(f"{self._gyro.sensor} is not used: {why}")

    def _add_wheels(self, reading: WheelOdometry) -> None:
        """Process a wheel odometry reading: it predicts the next scan, and gets a pose itself."""
        self._wheels_name = reading.sensor
        if self._wheels is None:
            self.readings.add_wheel(reading.stamp_s, None)
            return
        self.readings.add_wheel(reading.stamp_s, self._wheels.add(reading))

    def _add_frame(self, frame: PreparedFrame) -> Moment | None:
        """Track a frame; if there was no scan for a while, the leading camera continues the track."""
        self.cameras.add(frame)
        if self._config.sensors.lidar and np.isneginf(self._scan_stamp_s):
            # The lidar is about to start: a first keyframe without a scan would leave it nothing to match.
            self._scan_stamp_s = frame.stamp_s
        stamp_s = self.cameras.robot_stamp_s(frame)
        silent = stamp_s - self._scan_stamp_s > GAP_S
        if not silent or not self.cameras.leads(frame.frame.sensor, stamp_s):
            return None
        camera = self.cameras.cameras[frame.frame.sensor]
        camera.led_scans.append(self.readings.scan_count)
        camera.led_s.append(frame.stamp_s)
        return self._track(stamp_s, None, None)

    def _track(self, stamp_s: float, scan: LaserScan | None, points: ScanPoints | None) -> Moment:
        """Find the pose of a scan or frame."""
        camera_poses = self.cameras.camera_poses(stamp_s)
        steps = [
            step.planar
            for step in self.cameras.steps(self._camera_poses, camera_poses)
            if step.planar is not None
        ]
        cameras = [Motion(step.motion, step.covariance) for step in steps]
        tracked = self._tracker.track(points, stamp_s, cameras)
        if scan is not None and tracked.confident:
            self.cameras.scan_turns.add(stamp_s, float(tracked.pose[2]))
            if self._wheels is not None:
                self._wheels.learn_clock(self.cameras.scan_turns)
            if self._gyro is not None:
                self._gyro.learn_clock(self.cameras.scan_turns)
        self._camera_poses = camera_poses
        self._newest = stamp_s, points, tracked
        if tracked.motion is not None or points is None or tracked.wheels is not None or cameras:
            self._matched_s = stamp_s
        self.readings.add_scan(
            stamp_s,
            pose2_from_row(tracked.pose),
            None if tracked.wheels is None else tracked.wheels.pose,
            covariance=None if tracked.motion is None else tracked.motion.covariance,
            trusted=tracked.confident if scan is not None else bool(cameras),
        )
        last, limits = self._chain.last, self._config.keyframes
        due = last is None or limits.due(*between(last.pose, tracked.pose).tolist())
        # A robot that nothing has measured for so long has seen enough to begin anew where it is.
        due |= stamp_s - self._matched_s > GAP_S
        if due:
            self._matched_s = stamp_s
        return Moment(stamp_s, scan, tracked.pose, tracked.motion, due)
