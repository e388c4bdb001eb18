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

# Where every camera was at one moment; None for one that did not know.
CameraPoses = Mapping[str, CameraPose | None]


@dataclass(slots=True)
class RobotCamera:
    """One camera: its odometry, its mounting and clock, what became of its frames, and its refusals."""

    odometry: CameraOdometry
    T_base_camera: gtsam.Pose3 | None
    newest: PreparedFrame | None = None
    learner: MountLearner | None = None
    clocks: ClockLearner = field(default_factory=ClockLearner)
    # Of the frames that carried the robot on: their numbers among the scans, and their own stamps.
    led_scans: array[int] = field(default_factory=lambda: array("q"))
    led_s: array[float] = field(default_factory=lambda: array("d"))
    record: ScanRecorder = field(default_factory=ScanRecorder)
    steps: int = 0
    refused_steps: int = 0

    @property
    def clock(self) -> SensorClock:
        """The clock as far as it is known."""
        return self.clocks.clock

    def at(self, stamp_s: float) -> CameraPose | None:
        """Where the camera was when the robot's clock showed a stamp."""
        return self.odometry.track.at(stamp_s + self.clock.offset_s, self.clock.sigma_s)

    def note_turn(self) -> None:
        """Take down how fast the newest frames say that the robot turned."""
        motion = self.odometry.track.newest_motion()
        if motion is None or self.T_base_camera is None:
            return
        begun_s, ended_s, twist = motion
        rate = float(self.T_base_camera.rotation().rotate(twist[:3])[2])
        self.clocks.turns.add_turn(begun_s, ended_s, rate * (ended_s - begun_s))


@dataclass(frozen=True, slots=True)
class CameraStep:
    """Motion of a camera between two moments: as measured, and of the robot where the mounting is known."""

    camera: str
    motion: gtsam.Pose3
    covariance: FloatArray
    planar: PlanarMotion | None


@dataclass(frozen=True, slots=True)
class Picture:
    """A camera's newest frame, and where it was taken, seen from the base at some moment."""

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
        """The turns by the robot's own clock: the lidar's where there is one, else the wheels'."""
        return self.scan_turns if len(self.scan_turns) else self.wheel_turns

    def settle_clocks(self) -> None:
        """Estimate every clock from the whole run."""
        for camera in self.cameras.values():
            camera.clocks.learn(self._turns(), final=True)
        self.tags.clocks = {name: camera.clock for name, camera in self.cameras.items()}

    def look_for_tags(self) -> None:
        """In the newest frame of every camera of which it is known where it sits."""
        for camera in self.cameras.values():
            if camera.newest is not None and camera.T_base_camera is not None:
                self.tags.look(camera.newest.frame, camera.T_base_camera)

    def robot_stamp_s(self, frame: PreparedFrame) -> float:
        """What the robot's clock showed when a frame was taken."""
        camera = self.cameras.get(frame.frame.sensor)
        return frame.stamp_s if camera is None else frame.stamp_s - camera.clock.offset_s

    def camera_poses(self, stamp_s: float) -> CameraPoses:
        """Where every camera was at a stamp of the robot's clock."""
        return {name: camera.at(stamp_s) for name, camera in self.cameras.items()}

    def leads(self, name: str, stamp_s: float) -> bool:
        """Whether a camera is the first that knows where it is; the first of all where none does."""
        knowing = [
            other
            for other, camera in self.cameras.items()
            if camera.T_base_camera is not None and camera.at(stamp_s) is not None
        ]
        return name == (knowing or list(self.cameras))[0]

    def led(self) -> tuple[NDArray[np.int64], FloatArray]:
        """(M,) scans that were a camera's frames, and (M,) what the robot's clock showed then."""
        cameras = self.cameras.values()
        scans = [np.array(camera.led_scans, dtype=np.int64) for camera in cameras]
        stamps_s = [np.array(camera.led_s) - camera.clock.offset_s for camera in cameras]
        return np.concatenate([np.zeros(0, np.int64), *scans]), np.concatenate([np.zeros(0), *stamps_s])

    def placed_pictures(self, stamp_s: float) -> list[Picture]:
        """The newest frame of every camera with a known mounting, the first such camera's first.

        One that is lost is left out; where the first is, all are.
        """
        known = [camera.newest for camera in self.cameras.values() if camera.newest and camera.T_base_camera]
        found = [(frame, self.placed_at(frame.frame.sensor, frame.stamp_s, stamp_s)) for frame in known]
        return [Picture(frame, pose) for frame, pose in found if pose] if found and found[0][1] else []

    def placed_at(self, name: str, taken_s: float, stamp_s: float, sigmas: float = 0.0) -> gtsam.Pose3 | None:
        """Where a camera took a frame, seen from the base at a stamp of the robot's clock; None if not known.

        By clock and mounting as they are known by now; so many standard deviations of the clock beside.
        """
        camera = self.cameras[name]
        there = camera.odometry.track.at(taken_s, 0.0)
        base = camera.at(stamp_s + sigmas * camera.clock.sigma_s)
        if camera.T_base_camera is None or there is None or base is None or there.segment != base.segment:
            return None
        return camera.T_base_camera.compose(base.pose.between(there.pose))

    def pictures(self, stamp_s: float) -> list[Picture]:
        """The newest frame of every camera; one that is lost or not yet placed is taken as it stands."""
        found = []
        for name, camera in sorted(self.cameras.items()):
            if (newest := camera.newest) is not None:
                placed = self.placed_at(name, newest.stamp_s, stamp_s)
                found.append(Picture(newest, placed or camera.T_base_camera or T_BODY_CAMERA))
        return found

    def steps(self, before: CameraPoses, after: CameraPoses) -> list[CameraStep]:
        """Motion between two moments by every camera that knows it and stays in the plane."""
        found = []
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
            found.append(CameraStep(name, *step, planar))
        return found

    def is_learned(self, name: str) -> bool:
        """Whether a camera's mounting is not given but learned."""
        return self.cameras[name].learner is not None

    def learn(self, source: int, target: int, steps: list[CameraStep], base: Motion | None) -> None:
        """Take motions between two keyframes of cameras whose mounting is not given."""
        for step in steps:
            camera = self.cameras[step.camera]
            if camera.learner is not None:
                camera.learner.add(KeyframeStep(source, target, step.motion, step.covariance), base)
                camera.T_base_camera = camera.learner.T_base_camera

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """The mountings that all motions together have told."""
        found = {}
        for name, camera in self.cameras.items():
            if camera.learner is None:
                continue
            camera.learner.estimate()
            if camera.learner.T_base_camera is not None:
                found[name] = LearnedMounting(camera.learner.T_base_camera, camera.learner.note(name))
        return found

    def learned_steps(self) -> list[tuple[int, int, PlanarMotion]]:
        """All motions between keyframes of cameras whose mounting was learned, by its last estimate."""
        found = []
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
                    found.append((step.source, step.target, planar))
        return found

    def records(self, registrations: Mapping[str, ColorRegistration]) -> dict[str, CameraRecord]:
        """What became of every camera's frames, for the report."""
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
        """The mountings and the clocks that were learned."""
        cameras = self.cameras.items()
        learning = [camera.learner.note(name) for name, camera in cameras if camera.learner is not None]
        clocks = [
            camera.clock.note(name, "lidar" if len(self.scan_turns) else "wheels")
            for name, camera in cameras
            if camera.clock.known
        ]
        return [mounting.note for mounting in self.mountings.values()] + learning + clocks

    def unplaced(self) -> list[str]:
        """Cameras of which it is not known where they sit."""
        return [name for name, camera in self.cameras.items() if camera.T_base_camera is None]

    def warnings(self) -> list[str]:
        """What a person should know of cameras that failed often: a line for all of them, by what failed."""
        lost, refused = list[str](), list[str]()
        for name, camera in self.cameras.items():
            tracked = camera.odometry
            for lines, failed, count in (
                (lost, tracked.lost_frames, tracked.frames),
                (refused, camera.refused_steps, camera.steps),
            ):
                lines += [f"{failed:,} of {count:,} of {name}"] if failed > 0.01 * count else []
        told = [f"Frames that matched nothing: {', '.join(lost)}"] if lost else []
        return told + ([f"Rejected motions off the floor: {', '.join(refused)}"] if refused else [])
