"""RGB-D cameras beside a 3D lidar: their images at its keyframes, and their fusion with its horizontal ring.

The lidar estimates the path. A camera is placed by its own odometry and clock at each keyframe; if the lidar
loses track, the camera measures the step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam

from slam.config import Config
from slam.graph.keyframe_graph import KeyframeGraph
from slam.mapper.camera_keyframes import CameraKeyframes
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.keyframe_fusion import FusionSummary, KeyframeFusion
from slam.mapper.keyframe_store import registration_notes
from slam.mapper.robot_cameras import CameraPoses, RobotCameras
from slam.mapper.scan_record import CameraRecord
from slam.mapper.tags import TagFinder
from slam.mapping.band_scan import horizon_scan, with_repairs
from slam.measurements import FloatArray, LaserScan
from slam.odometry.camera_odometry import camera_step
from slam.odometry.clock_learner import Turns
from slam.odometry.cloud_tracker import TrackedCloud
from slam.storage.map_frames import MapFrames
from slam.vision.color_registration import ColorRegistration
from slam.vision.prepared_frame import PreparedFrame


class CloudCameras:
    """The cameras of a run with a 3D lidar whose mounting on the robot is in the log."""

    def __init__(
        self,
        config: Config,
        checkpoint: Checkpoint,
        registrations: Mapping[str, ColorRegistration],
        wheel_turns: Turns,
    ) -> None:
        self._config, self._registrations = config, registrations
        self.tags = TagFinder(config.sensors.tags, registrations)
        self._cameras = RobotCameras(config, tags=self.tags, wheel_turns=wheel_turns, result_cache=checkpoint)
        self._keyframes = CameraKeyframes(config, checkpoint, registrations, self._cameras)
        self._fusion = KeyframeFusion(config.fusion) if config.fusion.enabled else None
        self._horizons: list[LaserScan | None] = []
        self._camera_poses: CameraPoses = {}

    def note_cloud(self, stamp_s: float, tracked: TrackedCloud) -> None:
        """Store the heading of a matched cloud, with which the cameras' clocks are compared."""
        if tracked.motion is not None:
            self._cameras.scan_turns.add(stamp_s, tracked.pose.rotation().yaw())

    def add(self, frame: PreparedFrame) -> None:
        """Track a frame of any camera."""
        self._cameras.add(frame)

    def step(self, stamp_s: float) -> tuple[gtsam.Pose3, FloatArray] | None:
        """Return the base motion since the last keyframe, and its (6, 6), by the first camera that has it."""
        now = self._cameras.camera_poses(stamp_s)
        for name, camera in self._cameras.cameras.items():
            found = camera_step(self._camera_poses.get(name), now.get(name))
            if found is None or camera.T_base_camera is None:
                continue
            T_base_camera = camera.T_base_camera
            adjoint = T_base_camera.AdjointMap()
            motion = T_base_camera.compose(found[0]).compose(T_base_camera.inverse())
            return motion, adjoint @ found[1] @ adjoint.T
        return None

    def add_keyframe(self, node: int, stamp_s: float, points: FloatArray, T_base_lidar: gtsam.Pose3) -> None:
        """Store the newest frames with a lidar keyframe, whose points are (N, 3) in the base frame."""
        self._camera_poses = self._cameras.camera_poses(stamp_s)
        self._cameras.look_for_tags()
        placed = self._cameras.placed_pictures(stamp_s)
        self._keyframes.add(node, stamp_s, placed, places=False)
        self._horizons.append(None)
        if placed and self._fusion is not None:
            ring = horizon_scan(points, stamp_s, T_base_lidar, self._config.cloud_map)
            if ring is not None:
                self._horizons[-1] = ring
                self._fusion.add(node, ring, placed)

    def settle(self, graph: KeyframeGraph, stamps_s: FloatArray) -> None:
        """Recompute the frame poses of all keyframes, whose stamps are (K,), with the final clock offsets."""
        self._cameras.settle_clocks()
        self._keyframes.settle(graph, stamps_s)

    def repaired(
        self, scans: Sequence[LaserScan | None], *, in_band: bool
    ) -> tuple[Sequence[LaserScan | None], FusionSummary | None]:
        """Return the 2D scans of all keyframes, with the obstacles that the fusion has found.

        Parameters
        ----------
        in_band
            Whether objects at the height of the lidar are obstacles for the robot.
        """
        if self._fusion is None or not any(self._horizons):
            return scans, None
        mended, summary = self._fusion.repair(self._horizons)
        if not in_band or not scans:
            return scans, summary
        return [
            with_repairs(scan, ring, after) if scan and ring and after is not None else scan
            for scan, ring, after in zip(scans, self._horizons, mended, strict=True)
        ], summary

    @property
    def frames(self) -> MapFrames:
        """The keyframes."""
        return self._keyframes.frames

    def records(self) -> dict[str, CameraRecord]:
        """Return how the frames of every camera were used."""
        return self._cameras.records(self._registrations)

    def notes(self) -> list[str]:
        """Return notes on registrations and clock offsets."""
        return [*registration_notes(self._registrations), *self._cameras.notes()]

    def warnings(self) -> list[str]:
        """Return warnings about cameras that failed or could not be used."""
        lines = [f"{name}: not used; {why}" for name, why in self.unused().items()]
        return [*lines, *self._cameras.warnings()]

    def unused(self) -> dict[str, str]:
        """Return why a camera could not be used, by its name."""
        why = "with a 3D lidar, the log must contain the mounting of a camera"
        return dict.fromkeys(self._cameras.unplaced(), why)
