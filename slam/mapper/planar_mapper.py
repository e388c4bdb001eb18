"""Mapping with a robot on a floor: lidar, wheels and cameras -> keyframes -> graph -> loops, in SE(2)."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np

from slam.config import Config
from slam.errors import ScanweaveError
from slam.graph.keyframe_graph import KeyframeGraph, Step
from slam.graph.loop_closure import LoopCandidate, LoopCloser
from slam.graph.step_vote import agree, vote
from slam.mapper.journal import Journal
from slam.mapper.keyframe_fusion import KeyframeFusion
from slam.mapper.keyframe_store import registration_notes
from slam.mapper.map_result import MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.planar_places import PlanarPlaces
from slam.mapper.robot_cameras import CameraMarks, CameraStep, RobotCameras
from slam.mapper.scan_record import ScanRecorder
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between, compose
from slam.matching.scan_points import ScanPoints, extract_points
from slam.measurements import FloatArray, LaserScan, PointCloud, WheelOdometry, row_from_pose2
from slam.odometry import STANDARD, Odometries
from slam.odometry.motion_tracker import MotionTracker, TrackedScan
from slam.odometry.remembered_odometry import RememberedOdometry
from slam.odometry.wheel_tracker import WheelTracker
from slam.trajectory.readings import Readings
from slam.vision.color_registration import ColorRegistration
from slam.vision.planar_motion import agreed_motion
from slam.vision.prepared_frame import PreparedFrame

# A keyframe that matched nothing was guessed to this share of a step that nothing measured. A match is made
# to those before it while no more guessed ones than this have joined the local map.
_GUESS_SHARE = 0.1
_MOST_GUESSED = 5
# Where the wheels are farther from that by more squared sigmas than three degrees of freedom have on average,
# it was rather made to the guessed one itself.
_WHEELS_AGREE = 3.0


class PlanarMapper:
    """State of a run: feed measurements in log order, then finish; see `slam.mapper.protocol.Mapper`."""

    def __init__(
        self,
        config: Config,
        mountings: Mapping[str, LearnedMounting] | None = None,
        journal: Journal | None = None,
        odometries: Odometries = STANDARD,
    ) -> None:
        journal = journal or Journal()
        self._config = config
        self._wheels = WheelTracker(config.wheels) if config.lidar_odometry.use_wheel_odometry else None
        self._tracker = MotionTracker(
            RememberedOdometry(odometries.lidar(config), journal),
            self._wheels,
            config.prediction,
            config.match,
        )
        self._graph = KeyframeGraph(config.graph)
        self._closer = LoopCloser(config.loops, config.match, journal)
        self._readings = Readings()
        self._record = ScanRecorder()
        self._last_keyframe: TrackedScan | None = None
        self._matched: tuple[int, TrackedScan | None] = (0, None)
        self._guessed = 0
        self._guess_steps: list[Step] = []
        self._cameras = RobotCameras(config.rgbd_odometry, config.sensors, mountings or {}, answers=journal)
        self._places = PlanarPlaces(config, journal)
        self._fusion = KeyframeFusion(config.fusion) if config.fusion.enabled else None
        self._marks: CameraMarks = {}
        self._keyframe_marks: CameraMarks = {}
        self._scan_stamp_s = -np.inf
        self._keyframe_stamps: list[float] = []
        self._camera_doubts: list[tuple[float, FloatArray]] = []
        self._keyframe_scans: list[LaserScan | None] = []
        self._registrations: Mapping[str, ColorRegistration] = {}
        self._travelled_m = 0.0

    @property
    def scan_count(self) -> int:
        """Scans so far."""
        return self._readings.scan_count

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Where cameras sit that the log does not tell, as far as this run has shown."""
        return self._cameras.learned_mountings()

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Take a wheel odometry reading: a guess for the next scan, and a reading that wants a pose."""
        if self._wheels is None:
            self._readings.add_wheel(reading.stamp_s, None)
            return
        self._cameras.note_wheel_turn(reading.stamp_s, reading.T_odom_base.theta())
        self._wheels.add(reading)
        self._readings.add_wheel(reading.stamp_s, row_from_pose2(reading.T_odom_base))

    def note_registrations(self, registrations: Mapping[str, ColorRegistration]) -> None:
        """Take down where colour cameras sit that are not registered to depth."""
        self._registrations = registrations

    def add_scan(self, scan: LaserScan) -> None:
        """Match a scan; where the robot has moved on, make it a keyframe and close loops."""
        started = time.perf_counter()
        settings = self._config.scan
        points = extract_points(scan, settings.range_min_m, settings.range_max_m, settings.neighbours)
        self._scan_stamp_s = scan.stamp_s
        self._add_moment(scan.stamp_s, scan, points, started)

    def add_cloud(self, cloud: PointCloud) -> None:
        """A planar scan tells a robot on a floor as much; clouds have their own mapper."""

    def add_frame(self, frame: PreparedFrame) -> None:
        """Track a frame; where no scan has come for a while, the leading camera carries the robot on."""
        started = time.perf_counter()
        self._cameras.add(frame)
        if self._config.sensors.lidar and np.isneginf(self._scan_stamp_s):
            # The lidar is about to begin: without a scan the first keyframe would leave it nothing to match.
            self._scan_stamp_s = frame.stamp_s
        stamp_s = self._cameras.robot_stamp_s(frame)
        silent = stamp_s - self._scan_stamp_s > self._config.sensors.lidar_silent_s
        if silent and self._cameras.leads(frame.frame.sensor, stamp_s):
            self._add_moment(stamp_s, None, None, started)

    def _add_moment(
        self, stamp_s: float, scan: LaserScan | None, points: ScanPoints | None, started: float
    ) -> None:
        """Pose of a moment; where the robot has moved on, a keyframe."""
        marks = self._cameras.marks(stamp_s)
        steps = [step.planar for step in self._cameras.steps(self._marks, marks) if step.planar is not None]
        agreed = agreed_motion(steps)
        tracked = self._tracker.track(points, stamp_s, agreed)
        if scan is not None and tracked.sure:
            self._cameras.note_scan_turn(stamp_s, tracked.pose[2])
        self._marks = marks
        sure = tracked.sure if scan is not None else agreed is not None
        variances = None if tracked.motion is None else np.diag(tracked.motion.covariance)
        self._readings.add_scan(stamp_s, tracked.pose, tracked.wheel_pose, variances=variances, sure=sure)
        if self._moved_on(tracked):
            key = self._add_keyframe(stamp_s, scan, points, tracked)
            for candidate in self._closer.close(key, self._graph.poses(), self._graph.uncertainty):
                self.add_loop(candidate)
            for candidate in self._look_around(key, alone=scan is None):
                self.add_loop(candidate)
            self._graph.update()
        self._record.add(stamp_s, tracked.motion, time.perf_counter() - started)

    def add_loop(self, candidate: LoopCandidate) -> None:
        """Take a loop candidate: into the graph if it was accepted, into the report in any case."""
        self._graph.add_loop(candidate)

    def finish(self) -> MapResult:
        """Optimise everything, give every reading its pose, and draw the grid."""
        clock = [time.perf_counter()]
        self._settle_cameras()
        for source, target, motion in self._cameras.learned_steps():
            self._graph.add_camera_step(source, target, Step(motion.motion, motion.covariance))
        outvoted = self._graph.judge_cameras()
        outcome = self._graph.optimize(self._config.loops.inlier_probability)
        clock.append(time.perf_counter())
        keyframe_poses = self._graph.poses()
        trajectory = self._readings.trajectory(keyframe_poses)
        clock.append(time.perf_counter())
        scans_fused, fused = self._keyframe_scans, None
        if self._fusion is not None:
            scans_fused, fused = self._fusion.repair(self._keyframe_scans)
        clock.append(time.perf_counter())
        grid, warnings = self._build_grid(scans_fused, keyframe_poses)
        clock.append(time.perf_counter())
        scans = self._record.finish()
        stages = ("final optimisation", "full trajectory", "fusion", "occupancy grid")
        return MapResult(
            trajectory=trajectory,
            keyframe_poses=keyframe_poses,
            keyframe_numbers=self._readings.keyframe_scans(),
            measured_scans=list(self._keyframe_scans),
            keyframe_scans=list(scans_fused),
            graph=self._graph.graph,
            edges_kept=outcome.kept,
            loops=self._graph.loops,
            scans=scans,
            grid=grid,
            stage_seconds={
                "scans": float(scans.seconds.sum()),
                **dict(zip(stages, np.diff(clock).tolist(), strict=True)),
            },
            warnings=[*warnings, *self._cameras.warnings()],
            notes=[
                *registration_notes(self._registrations),
                *self._cameras.notes(),
                *([f"{outvoted:,} motions by cameras contradicted match and wheels"] if outvoted else []),
                *([] if fused is None else [fused.note]),
            ],
            dense=self._places.dense(keyframe_poses),
            fused=fused,
            cameras=self._cameras.records(self._registrations),
        )

    def _moved_on(self, tracked: TrackedScan) -> bool:
        """Whether a scan is far enough from the last keyframe to be the next."""
        if self._last_keyframe is None:
            return True
        step = between(self._last_keyframe.pose, tracked.pose)
        limits = self._config.keyframes
        return bool(np.hypot(step[0], step[1]) > limits.distance_m or abs(step[2]) > limits.angle_rad)

    def _add_keyframe(
        self, stamp_s: float, scan: LaserScan | None, points: ScanPoints | None, tracked: TrackedScan
    ) -> int:
        """Grow the local map, the graph and the loop closer by a moment; the keyframe's number."""
        key, cameras = 0, list[Step]()
        if self._last_keyframe is not None:
            step = between(self._last_keyframe.pose, tracked.pose)
            self._travelled_m += float(np.hypot(step[0], step[1]))
            match = None
            if tracked.motion is not None:
                matched = row_from_pose2(tracked.motion.T_reference_base)
                covariance = tracked.motion.covariance + tracked.dispute
                match = Step(between(self._last_keyframe.pose, matched), covariance)
            wheels = self._wheel_step(self._last_keyframe, tracked, stamp_s - self._keyframe_stamps[-1])
            bridge = None
            guessed = self._last_keyframe is not self._matched[1]
            if match is not None and guessed and not (self._guess_steps and agree(self._guess_steps)):
                since_s = stamp_s - self._keyframe_stamps[self._matched[0]]
                match, bridge = self._past_a_guess(match, covariance, tracked, since_s)
            moved = self._cameras.steps(self._keyframe_marks, self._marks)
            cameras = self._camera_steps(moved, self._tracker.camera_doubt, tracked.dispute)
            outvoted, cameras = vote(match, wheels, cameras)
            doubtful = outvoted or self._doubtful(tracked)
            key = self._graph.add_keyframe(step, match, wheels, cameras, match_doubtful=doubtful)
            if bridge is not None:
                self._graph.add_bridge(self._matched[0], bridge, doubtful=doubtful)
            self._cameras.learn(key - 1, key, moved, wheels if doubtful else match)
        if points is not None:
            self._tracker.add_keyframe(points, tracked)
        seen = OrientedPoints.none() if points is None else OrientedPoints.from_scan(points)
        self._closer.add_keyframe(seen, tracked.pose, self._travelled_m)
        self._readings.mark_keyframe()
        self._keyframe_scans.append(scan)
        if self._fusion is not None and scan is not None:
            self._fusion.add(key, scan, self._cameras.pictures(self._marks))
        self._keyframe_stamps.append(stamp_s)
        self._camera_doubts.append((self._tracker.camera_doubt, tracked.dispute))
        self._keyframe_marks = self._marks
        self._last_keyframe = tracked
        if tracked.motion is not None or key == 0:
            self._matched, self._guessed = (key, tracked), 0
        else:
            self._guessed += len(seen) > 0
            self._guess_steps = cameras
        return key

    def _past_a_guess(
        self, match: Step, covariance: FloatArray, tracked: TrackedScan, since_s: float
    ) -> tuple[Step, Step | None]:
        """A match where the last keyframe matched nothing: from there, and from the last that matched.

        The guess was by the wheels, or by cameras that contradict each other. The match was made to keyframes
        of before, and to the last one only as well as that was guessed. Where cameras hold the chain no more
        is needed; where scans of guessed keyframes are most of the local map nobody knows to which.
        """
        matched = self._matched[1]
        assert self._last_keyframe is not None and matched is not None
        unsure = Step(match.motion, match.covariance + self._graph.unmeasured(_GUESS_SHARE))
        if self._guess_steps or self._guessed > _MOST_GUESSED:
            return unsure, None
        now = compose(self._last_keyframe.pose, match.motion)
        bridge = Step(between(matched.pose, now), covariance)
        wheels = self._wheel_step(matched, tracked, since_s)
        return unsure, bridge if wheels is None or agree([bridge, wheels], _WHEELS_AGREE) else None

    def _look_around(self, key: int, *, alone: bool) -> list[LoopCandidate]:
        """Take the cameras' frames for a keyframe; where they are alone, look for the leading one's loops."""
        seen = self._cameras.placed_pictures(self._marks)
        if not seen:
            return []
        return self._places.add(key, seen, self._registrations, self._graph.poses() if alone else None)

    def _camera_steps(self, moved: list[CameraStep], doubt: float, dispute: FloatArray) -> list[Step]:
        """The edges of cameras whose mounting is given; learned ones wait for its last estimate."""
        return [
            Step(step.planar.motion, step.planar.covariance * doubt + dispute, step.camera)
            for step in moved
            if step.planar is not None and not self._cameras.is_learned(step.camera)
        ]

    def _settle_cameras(self) -> None:
        """Say anew how each camera moved: by its clock as the whole run tells it, between frames."""
        self._cameras.settle_clocks()
        for key, names in self._graph.camera_steps().items():
            before, after = (self._cameras.marks(self._keyframe_stamps[n]) for n in (key - 1, key))
            for step in self._camera_steps(self._cameras.steps(before, after), *self._camera_doubts[key]):
                if step.camera in names:
                    self._graph.replace_camera_step(key, step)

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

    def _build_grid(
        self, scans_fused: Sequence[LaserScan | None], keyframe_poses: FloatArray
    ) -> tuple[OccupancyGrid | None, list[str]]:
        """The grid from the optimised keyframes; a map that would not fit in memory is a warning."""
        try:
            return grid_of_keyframes(scans_fused, keyframe_poses, self._config), []
        except ScanweaveError as error:
            return None, [f"No grid was built: {error}"]
