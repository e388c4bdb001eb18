"""Front end for a freely moving RGB-D camera alone: frames give pose, loops and map; SE(3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from fusion.estimation import gate
from slam.config import Config
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.visual_loops import VisualLoopCloser
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.keyframe_store import KeyframeStore, registration_notes
from slam.mapper.map_result import MapResult
from slam.mapper.protocol import FrontEnd, Tracked
from slam.mapper.scan_record import CameraRecord
from slam.mapper.tags import TagFinder
from slam.matching.upright import Gravity
from slam.measurements import ImuReading, Pose, spatial
from slam.odometry import STANDARD, Odometries
from slam.odometry.imu_tracker import ImuTracker, UnfitImuError, alike, apart_in_time
from slam.odometry.rgbd_tracker import RgbdTracker, TrackedFrame
from slam.trajectory.readings import Readings
from slam.vision.camera_frame import T_BODY_CAMERA
from slam.vision.color_registration import ColorRegistration
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.learned_camera import LearnedCamera
from slam.vision.prepared_frame import PreparedFrame


class FreeCamera(FrontEnd):
    """Front end for the frames of one camera; see `slam.mapper.protocol.FrontEnd`.

    The nodes are camera poses. The map frame is that of the first base pose; without a known mounting the
    base is the camera itself, and the map frame its body: x along the first view, z up in the first image.
    An IMU beside the camera levels the map.
    """

    def __init__(
        self,
        config: Config,
        checkpoint: Checkpoint,
        registrations: Mapping[str, ColorRegistration],
        odometries: Odometries = STANDARD,
    ) -> None:
        self.readings = Readings()
        self._registrations = registrations
        self.tags = TagFinder(config.sensors.tags, registrations)
        self._tracker = RgbdTracker(odometries.rgbd(config), config, checkpoint)
        self._store = KeyframeStore(config.rgbd, config.match.local_map_keyframes, checkpoint.spool())
        self._closer = VisualLoopCloser(config, FrameMatcher(config), self._store, checkpoint)
        self._last: gtsam.Pose3 | None = None
        # ``T_odom_camera`` as matched, as used, and whether the IMU has predicted it since the keyframe.
        self._seen, self._placed, self._bridged = gtsam.Pose3(), gtsam.Pose3(), False
        self._newest: tuple[PreparedFrame, TrackedFrame] | None = None
        self._T_base_camera: gtsam.Pose3 | None = None
        self._T_camera_base = gtsam.Pose3()
        self._camera: str | None = None
        self._imu = ImuTracker() if config.sensors.imu else None
        self._down: dict[int, Gravity] = {}

    def observe(self, measurement: Any) -> Tracked | None:
        """Process the next measurement; return the tracked pose of the camera, if it gives one."""
        if isinstance(measurement, ImuReading):
            self._feel(measurement)
        if not isinstance(measurement, PreparedFrame):
            return None
        frame = measurement.frame
        if self._camera is None:
            self._camera, self._T_base_camera = frame.sensor, frame.T_base_camera
            if self._T_base_camera is not None:
                self._T_camera_base = self._T_base_camera.inverse()
        if frame.sensor != self._camera:
            return None
        tracked = self._tracker.track(measurement)
        self._newest = measurement, tracked
        self._place(measurement.stamp_s, tracked)
        motion = None if tracked.match is None else tracked.match.motion
        self.readings.add_scan(
            measurement.stamp_s,
            self._placed.compose(self._T_camera_base),
            covariance=None if motion is None else motion.covariance,
            trusted=motion is not None or self._bridged,
        )
        return Tracked(measurement.stamp_s, motion, tracked.new_keyframe, tracked.match)

    def origin(self) -> Pose:
        """Return the first pose of the camera."""
        return T_BODY_CAMERA if self._T_base_camera is None else self._T_base_camera

    def step(self, key: int) -> tuple[Pose, Sequence[Edge]]:
        """Return the motion from the last keyframe to the newest frame, and its edge."""
        assert self._newest is not None
        tracked = self._newest[1]
        step = gtsam.Pose3() if self._last is None else self._last.between(self._placed)
        self._last, bridged, self._bridged = self._placed, self._bridged, False
        if bridged and self._imu is not None and (spread := self._imu.spread()) is not None:
            return step, [Edge(key - 1, key, step, spread, EdgeKind.IMU, trusted=True)]
        if tracked.match is None or key == 0:
            return step, []
        covariance = tracked.match.motion.covariance
        return step, [Edge(key - 1, key, step, covariance, EdgeKind.RGBD, trusted=True)]

    def recognise(self, key: int, graph: KeyframeGraph) -> list[LoopCandidate]:
        """Store a keyframe, and try to close loops with places it may have returned to."""
        assert self._newest is not None
        frame, tracked = self._newest
        if self._imu is not None and (gravity := self._imu.gravity()) is not None:
            self._down[key] = gravity
        self._tracker.add_keyframe(frame, tracked)
        self._closer.add_keyframe(frame, adrift=tracked.restarted)
        self.tags.look(frame.frame, self._T_camera_base.inverse())
        self._store.add(frame, self._registrations.get(frame.frame.sensor))
        return self._closer.close(key, [spatial(pose) for pose in graph.poses()])

    def refuse(self) -> None:
        """Never raise an error: any frame gives a map."""

    def settle(self, graph: KeyframeGraph) -> None:
        """Level the map if gravity is known; all steps are final already."""
        if self._down:
            graph.graph.level(apart_in_time(self._down))

    def bases(self, poses: Sequence[Pose]) -> Sequence[Pose]:
        """Return the bases of the camera poses."""
        return [spatial(pose).compose(self._T_camera_base) for pose in poses]

    def complete(self, result: MapResult) -> None:
        """Add the images of the keyframes."""
        assert self._camera is not None
        learned = LearnedCamera(self._registrations.get(self._camera), self._T_base_camera)
        result.add_cameras({self._camera: CameraRecord(result.scans, learned=learned)}, self._store.images)
        result.notes += registration_notes(self._registrations)
        if self._imu is not None:
            result.add_imu_notes(*self._imu.outcome())

    def _place(self, stamp_s: float, tracked: TrackedFrame) -> None:
        """Find the pose of the camera: as matched, unless its rotation contradicts the IMU."""
        motion = None if tracked.match is None else tracked.match.motion
        before, step = self._placed, self._seen.between(tracked.pose)
        self._seen, self._placed = tracked.pose, before.compose(step)
        if self._imu is None:
            return
        covariance = None if motion is None or tracked.restarted else motion.covariance
        by_imu, spread = self._imu.predicted(stamp_s), self._imu.spread()
        if by_imu is not None and spread is not None:
            turn = gtsam.Rot3.Logmap(by_imu.rotation().between(self._placed.rotation()))
            turn_covariance = spread[:3, :3] + (0.0 if covariance is None else covariance[:3, :3])
            agrees = covariance is not None and turn @ np.linalg.solve(turn_covariance, turn) <= gate(3)
            # A match may be grossly wrong, with a large covariance.
            if not (agrees and alike(step, before.between(by_imu))):
                self._placed, covariance, self._bridged = by_imu, None, True
        self._imu.took(stamp_s, self._placed, covariance)

    def _feel(self, reading: ImuReading) -> None:
        """Process a reading of an IMU with known mounting, transformed to the camera."""
        if self._imu is None or self._camera is None:
            return
        if reading.T_base_imu is None or not reading.specific_force_m_s2.any():
            lacks = "its pose relative to the camera, or its acceleration, is unknown"
            raise UnfitImuError(reading.sensor, lacks, {"use": False})
        self._imu.add(replace(reading, T_base_imu=self._T_camera_base.compose(reading.T_base_imu)))
