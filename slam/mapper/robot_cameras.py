"""RGB-D cameras of a robot on a floor: the pose of each at a given time, and the robot's motion from it."""

from __future__ import annotations

import time
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.mapper.mount_learner import KeyframeStep, LearnedMounting, MountLearner
from slam.mapper.scan_record import CameraRecord, ScanRecorder
from slam.mapper.tags import TagFinder
from slam.matching.motion import Motion
from slam.measurements import FloatArray
from slam.odometry.camera_odometry import CameraOdometry, camera_step
from slam.odometry.camera_track import CameraPose
from slam.odometry.clock_learner import ClockLearner, SensorClock, Turns
from slam.result_cache import COMPUTED, ResultCache
from slam.vision.camera_frame import T_BODY_CAMERA
from slam.vision.color_registration import ColorRegistration
from slam.vision.learned_camera import LearnedCamera
from slam.vision.planar_motion import PlanarMotion, planar_motion
from slam.vision.prepared_frame import PreparedFrame

# Pose of every camera at one time; None if unknown.
CameraPoses = Mapping[str, CameraPose | None]


@dataclass(slots=True)
class RobotCamera:
    """One camera: its odometry, mounting and clock offset, the record of its frames, and rejections."""

    odometry: CameraOdometry
    T_base_camera: gtsam.Pose3 | None
    newest: PreparedFrame | None = None
    learner: MountLearner | None = None
    clocks: ClockLearner = field(default_factory=ClockLearner)
    # Frames that continued the track of the robot: their numbers among the scans, and their stamps.
    led_scans: array[int] = field(default_factory=lambda: array("q"))
    led_s: array[float] = field(default_factory=lambda: array("d"))
    record: ScanRecorder = field(default_factory=ScanRecorder)
    steps: int = 0
    refused_steps: int = 0

    @property
    def clock(self) -> SensorClock:
        """Return the clock offset as estimated so far."""
        return self.clocks.clock

    def at(self, stamp_s: float) -> CameraPose | None:
        """Return the pose of the camera at a stamp of the robot's clock."""
        return self.odometry.track.at(stamp_s + self.clock.offset_s, self.clock.sigma_s)

    def note_turn(self) -> None:
        """Store the rotation rate of the robot by the newest frames."""
        motion = self.odometry.track.newest_motion()
        if motion is None or self.T_base_camera is None:
            return
        begun_s, ended_s, twist = motion
        rate = float(self.T_base_camera.rotation().rotate(twist[:3])[2])
        self.clocks.turns.add_turn(begun_s, ended_s, rate * (ended_s - begun_s))


@dataclass(frozen=True, slots=True)
class CameraStep:
    """Motion of a camera between two times, and of the robot if the mounting is known."""

    camera: str
    motion: gtsam.Pose3
    covariance: FloatArray
    planar: PlanarMotion | None


@dataclass(frozen=True, slots=True)
class Picture:
    """The newest frame of a camera, and its pose relative to the base at some time."""

    frame: PreparedFrame
    T_base_camera: gtsam.Pose3


@dataclass(slots=True)
class RobotCameras:
    """All cameras by name."""

    config: Config
    mountings: Mapping[str, LearnedMounting] = field(default_factory=dict)
    cameras: dict[str, RobotCamera] = field(default_factory=dict)
    tags: TagFinder = field(default_factory=TagFinder)
    scan_turns: Turns = field(default_factory=Turns)
    wheel_turns: Turns = field(default_factory=Turns)
    result_cache: ResultCache = COMPUTED

    def add(self, frame: PreparedFrame) -> None:
        """Track a frame of any camera."""
        started = time.perf_counter()
        name = frame.frame.sensor
        if name not in self.cameras:
            mounting = frame.frame.T_base_camera
            learn = mounting is None or self.config.sensors.mounting == "estimate"
            if name in self.mountings:
                mounting, learn = self.mountings[name].T_base_camera, False
            self.cameras[name] = RobotCamera(
                CameraOdometry(self.config, self.result_cache),
                None if learn else mounting,
                learner=MountLearner(mounting) if learn else None,
            )
        camera = self.cameras[name]
        tracked = camera.odometry.add(frame)
        camera.newest = frame
        camera.note_turn()
        camera.clocks.learn(self._turns())
        motion = None if tracked.match is None else tracked.match.motion
        camera.record.add(frame.stamp_s, motion, time.perf_counter() - started, tracked.match)

    def _turns(self) -> Turns:
        """Return the rotations by the robot's own clock: from the lidar if there is one, else the wheels."""
        return self.scan_turns if len(self.scan_turns) else self.wheel_turns

    def settle_clocks(self) -> None:
        """Estimate every clock offset from the whole run."""
        for camera in self.cameras.values():
            camera.clocks.learn(self._turns(), final=True)
        self.tags.clocks = {name: camera.clock for name, camera in self.cameras.items()}

    def look_for_tags(self) -> None:
        """Detect tags in the newest frame of every camera with a known mounting."""
        for camera in self.cameras.values():
            if camera.newest is not None and camera.T_base_camera is not None:
                self.tags.look(camera.newest.frame, camera.T_base_camera)

    def robot_stamp_s(self, frame: PreparedFrame) -> float:
        """Return the stamp of a frame by the robot's clock."""
        camera = self.cameras.get(frame.frame.sensor)
        return frame.stamp_s if camera is None else frame.stamp_s - camera.clock.offset_s

    def camera_poses(self, stamp_s: float) -> CameraPoses:
        """Return the pose of every camera at a stamp of the robot's clock."""
        return {name: camera.at(stamp_s) for name, camera in self.cameras.items()}

    def leads(self, name: str, stamp_s: float) -> bool:
        """Return whether a camera is the first that is tracked, or, if none is, the first of all."""
        knowing = [
            other
            for other, camera in self.cameras.items()
            if camera.T_base_camera is not None and camera.at(stamp_s) is not None
        ]
        return name == (knowing or list(self.cameras))[0]

    def led(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Return (M,) scans that were frames of a camera, and (M,) their stamps by the robot's clock."""
        cameras = self.cameras.values()
        scans = [np.array(camera.led_scans, dtype=np.int64) for camera in cameras]
        stamps_s = [np.array(camera.led_s) - camera.clock.offset_s for camera in cameras]
        return np.concatenate([np.zeros(0, np.int64), *scans]), np.concatenate([np.zeros(0), *stamps_s])

    def placed_pictures(self, stamp_s: float) -> list[Picture]:
        """Return the newest frame of every camera with a known mounting, that of the first one first.

        A lost camera is left out; if the first is lost, all are.
        """
        known = [camera.newest for camera in self.cameras.values() if camera.newest and camera.T_base_camera]
        placed = [(frame, self.placed_at(frame.frame.sensor, frame.stamp_s, stamp_s)) for frame in known]
        return [Picture(frame, pose) for frame, pose in placed if pose] if placed and placed[0][1] else []

    def placed_at(self, name: str, taken_s: float, stamp_s: float, sigmas: float = 0.0) -> gtsam.Pose3 | None:
        """Return the pose of a frame relative to the base at a stamp of the robot's clock; None if unknown.

        It uses the current clock offset, shifted by some of its standard deviations, and mounting.
        """
        camera = self.cameras[name]
        there = camera.odometry.track.at(taken_s, 0.0)
        base = camera.at(stamp_s + sigmas * camera.clock.sigma_s)
        if camera.T_base_camera is None or there is None or base is None or there.segment != base.segment:
            return None
        return camera.T_base_camera.compose(base.pose.between(there.pose))

    def pictures(self, stamp_s: float) -> list[Picture]:
        """Return the newest frame of every camera; an untracked one has the pose of its mounting."""
        pictures = []
        for name, camera in sorted(self.cameras.items()):
            if (newest := camera.newest) is not None:
                placed = self.placed_at(name, newest.stamp_s, stamp_s)
                pictures.append(Picture(newest, placed or camera.T_base_camera or T_BODY_CAMERA))
        return pictures

    def steps(self, before: CameraPoses, after: CameraPoses) -> list[CameraStep]:
        """Return the motion between two times by every camera that measured it and stays in the plane."""
        steps = []
        for name, camera in self.cameras.items():
            step = camera_step(before.get(name), after.get(name))
            if step is None:
                continue
            planar = None
            if camera.T_base_camera is not None:
                planar = planar_motion(*step, camera.T_base_camera)
                camera.steps += 1
                if planar.leaves_the_floor:
                    camera.refused_steps += 1
                    continue
            steps.append(CameraStep(name, *step, planar))
        return steps

    def is_learned(self, name: str) -> bool:
        """Return whether the mounting of a camera is estimated, not given."""
        return self.cameras[name].learner is not None

    def learn(self, source: int, target: int, steps: list[CameraStep], base: Motion | None) -> None:
        """Add motions between two keyframes of cameras without a given mounting."""
        for step in steps:
            camera = self.cameras[step.camera]
            if camera.learner is not None:
                camera.learner.add(KeyframeStep(source, target, step.motion, step.covariance), base)
                camera.T_base_camera = camera.learner.T_base_camera

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Return the mountings estimated from all motions."""
        mountings = {}
        for name, camera in self.cameras.items():
            if camera.learner is None:
                continue
            camera.learner.estimate()
            if camera.learner.T_base_camera is not None:
                mountings[name] = LearnedMounting(camera.learner.T_base_camera, camera.learner.note(name))
        return mountings

    def learned_steps(self) -> list[tuple[int, int, PlanarMotion]]:
        """Return all motions between keyframes of cameras with an estimated mounting, by the latest."""
        steps = []
        for camera in self.cameras.values():
            if camera.learner is None:
                continue
            camera.learner.estimate()
            camera.T_base_camera = camera.learner.T_base_camera
            if camera.T_base_camera is None:
                continue
            for step in camera.learner.steps:
                planar = planar_motion(step.motion, step.covariance, camera.T_base_camera)
                if not planar.leaves_the_floor:
                    steps.append((step.source, step.target, planar))
        return steps

    def records(self, registrations: Mapping[str, ColorRegistration]) -> dict[str, CameraRecord]:
        """Return how the frames of every camera were used, for the report."""
        return {
            name: CameraRecord(
                camera.record.finish(),
                camera.steps,
                camera.refused_steps,
                LearnedCamera(
                    registrations.get(name),
                    camera.T_base_camera,
                    camera.learner is not None or name in self.mountings,
                    camera.clock.offset_s,
                    camera.clock.sigma_s,
                ),
            )
            for name, camera in self.cameras.items()
        }

    def notes(self) -> list[str]:
        """Return notes on the estimated mountings and clock offsets."""
        cameras = self.cameras.items()
        learning = [camera.learner.note(name) for name, camera in cameras if camera.learner is not None]
        clocks = [
            camera.clock.note(name, "lidar" if len(self.scan_turns) else "wheels")
            for name, camera in cameras
            if camera.clock.known
        ]
        return [mounting.note for mounting in self.mountings.values()] + learning + clocks

    def unplaced(self) -> list[str]:
        """Return the cameras with an unknown mounting."""
        return [name for name, camera in self.cameras.items() if camera.T_base_camera is None]

    def warnings(self) -> list[str]:
        """Return warnings on cameras that failed often: one line for each kind of failure."""
        lost, refused = list[str](), list[str]()
        for name, camera in self.cameras.items():
            tracked = camera.odometry
            for lines, failed, count in (
                (lost, tracked.lost_frames, tracked.frames),
                (refused, camera.refused_steps, camera.steps),
            ):
                lines += [f"{failed:,} of {count:,} of {name}"] if failed > 0.01 * count else []
        lines_lost = [f"Frames that matched nothing: {', '.join(lost)}"] if lost else []
        return lines_lost + ([f"Rejected motions off the floor: {', '.join(refused)}"] if refused else [])
