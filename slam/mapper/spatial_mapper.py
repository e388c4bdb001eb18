"""Mapping with an RGB-D camera alone that moves freely: frames -> keyframes -> graph -> loops, in SE(3)."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping

import gtsam
import numpy as np

from slam.config import Config
from slam.graph.spatial_graph import SpatialGraph
from slam.graph.visual_loops import VisualLoopCloser
from slam.mapper.journal import Journal
from slam.mapper.keyframe_store import KeyframeStore, registration_notes
from slam.mapper.map_result import DenseKeyframes, MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.scan_record import CameraRecord, ScanRecorder
from slam.measurements import LaserScan, PointCloud, WheelOdometry
from slam.odometry import STANDARD, Odometries
from slam.odometry.rgbd_tracker import RgbdTracker, TrackedFrame
from slam.trajectory.frame_poses import FramePoses
from slam.vision.camera_frame import T_BODY_CAMERA
from slam.vision.color_registration import ColorRegistration
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.learned_camera import LearnedCamera
from slam.vision.prepared_frame import PreparedFrame


class SpatialMapper:
    """State of a run: feed prepared frames in log order, then finish.

    The map frame is that of the first base pose; without a known mounting the base is the camera itself, and
    the map frame its body: x along the first view, z up in the first image.
    """

    def __init__(
        self, config: Config, journal: Journal | None = None, odometries: Odometries = STANDARD
    ) -> None:
        journal = journal or Journal()
        self._config = config
        matcher = FrameMatcher(config.rgbd_odometry)
        self._tracker = RgbdTracker(odometries.rgbd(config), config.rgbd_odometry, journal)
        cached = config.visual_loops.keyframes_cached
        self._store = KeyframeStore(config.rgbd, cached, journal.spool())
        self._closer = VisualLoopCloser(config.visual_loops, matcher, self._store, config.seed, journal)
        self._graph: SpatialGraph | None = None
        self._frames = FramePoses()
        self._record = ScanRecorder()
        self._last_keyframe: gtsam.Pose3 | None = None
        self._T_base_camera: gtsam.Pose3 | None = None
        self._camera: str | None = None
        self._unused: Counter[str] = Counter()
        self._registrations: Mapping[str, ColorRegistration] = {}

    @property
    def scan_count(self) -> int:
        """Frames so far."""
        return len(self._frames)

    def note_registrations(self, registrations: Mapping[str, ColorRegistration]) -> None:
        """Take down where colour cameras sit that are not registered to depth."""
        self._registrations = registrations

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """None: a camera alone is its own base."""
        return {}

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Wheels do not tell how a camera moves in space."""

    def add_scan(self, scan: LaserScan) -> None:
        """Nor does a planar scan."""

    def add_cloud(self, cloud: PointCloud) -> None:
        """A run with a 3D lidar has its own mapper."""

    def add_frame(self, frame: PreparedFrame) -> None:
        """Match a frame; where the camera has moved on, make it a keyframe and close loops."""
        if frame.frame.sensor != (self._camera or frame.frame.sensor):
            self._unused[frame.frame.sensor] += 1
            return
        self._camera = frame.frame.sensor
        started = time.perf_counter()
        tracked = self._tracker.track(frame)
        self._frames.add(frame.stamp_s, tracked.pose)
        if tracked.new_keyframe:
            graph, key = self._add_keyframe(frame, tracked)
            for candidate in self._closer.close(key, graph.poses()):
                graph.add_loop(candidate)
            graph.update()
        motion = None if tracked.match is None else tracked.match.motion
        self._record.add(frame.stamp_s, motion, time.perf_counter() - started, tracked.match)

    def finish(self) -> MapResult:
        """Optimise everything and give every frame its pose."""
        assert self._graph is not None and self._camera is not None
        clock = [time.perf_counter()]
        outcome = self._graph.optimize(self._config.loops.inlier_probability)
        clock.append(time.perf_counter())
        cameras = self._graph.poses()
        T_camera_base = gtsam.Pose3() if self._T_base_camera is None else self._T_base_camera.inverse()
        trajectory = self._frames.trajectory(cameras, T_camera_base)
        clock.append(time.perf_counter())
        scans = self._record.finish()
        return MapResult(
            trajectory=trajectory,
            keyframe_poses=np.array([_planar(pose.compose(T_camera_base)) for pose in cameras]),
            keyframe_numbers=self._frames.keyframes(),
            keyframe_scans=[],
            graph=self._graph.graph,
            edges_kept=outcome.kept,
            loops=self._graph.loops,
            scans=scans,
            grid=None,
            stage_seconds={
                "frames": float(scans.seconds.sum()),
                "final optimisation": clock[1] - clock[0],
                "full trajectory": clock[2] - clock[1],
            },
            warnings=[
                f"{name}: {count:,} frames were not used; in space only the first camera, {self._camera}, is"
                for name, count in self._unused.items()
            ],
            notes=registration_notes(self._registrations),
            dense=DenseKeyframes(self._store.images, cameras),
            cameras={
                self._camera: CameraRecord(
                    scans,
                    learned=LearnedCamera(self._registrations.get(self._camera), self._T_base_camera),
                ),
            },
        )

    def _add_keyframe(self, frame: PreparedFrame, tracked: TrackedFrame) -> tuple[SpatialGraph, int]:
        """Grow the local map, the graph and the loop closer by a frame; the graph and the number."""
        if self._graph is None or self._last_keyframe is None:
            self._T_base_camera = frame.frame.T_base_camera
            origin = T_BODY_CAMERA if self._T_base_camera is None else self._T_base_camera
            self._graph = SpatialGraph(origin, self._config.graph)
        else:
            covariance = None if tracked.match is None else tracked.match.motion.covariance
            self._graph.add_keyframe(self._last_keyframe.between(tracked.pose), covariance)
        self._tracker.add_keyframe(frame, tracked)
        self._frames.mark_keyframe()
        self._closer.add_keyframe(frame, adrift=tracked.restarted)
        self._last_keyframe = tracked.pose
        return self._graph, self._store.add(frame, self._registrations.get(frame.frame.sensor))


def _planar(pose: gtsam.Pose3) -> list[float]:
    """x, y, yaw of a pose."""
    return [pose.x(), pose.y(), pose.rotation().yaw()]
