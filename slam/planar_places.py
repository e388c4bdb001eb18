"""What a camera saw at the keyframes of a planar graph: places to come back to, pictures for the map."""

from __future__ import annotations

from dataclasses import replace

import gtsam

from slam.config import Config
from slam.graph.loop_closure import LoopCandidate
from slam.graph.visual_loops import VisualLoopCloser
from slam.journal import Journal
from slam.keyframe_store import KeyframeStore
from slam.map_result import DenseKeyframes
from slam.measurements import FloatArray, MotionEstimate, pose2_from_row
from slam.vision.color_registration import ColorRegistration
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.planar_motion import planar_motion
from slam.vision.prepared_frame import PreparedFrame


class PlanarPlaces:
    """Frames of one camera, each belonging to a node of the graph."""

    def __init__(self, config: Config, journal: Journal) -> None:
        cached = config.visual_loops.keyframes_cached
        self._store = KeyframeStore(config.rgbd, cached, journal.spool())
        matcher = FrameMatcher(config.rgbd_odometry)
        self._closer = VisualLoopCloser(config.visual_loops, matcher, self._store, config.seed, journal)
        self._greatest_excess = config.sensors.greatest_excess
        self._nodes: list[int] = []
        self._T_node_camera: list[gtsam.Pose3] = []

    def add(
        self,
        node: int,
        frame: PreparedFrame,
        T_node_camera: gtsam.Pose3,
        registration: ColorRegistration | None,
        poses: FloatArray | None,
    ) -> list[LoopCandidate]:
        """Take the frame of the newest node, and try the places that it may show.

        Parameters
        ----------
        T_node_camera
            Where the camera was when it took the frame, seen from the base at the node.
        poses
            (n, 3) current estimates of all nodes; None to try nothing.

        Returns
        -------
        Every candidate that was tried, its ends being nodes.
        """
        # Seen from the base at the node, so that whoever reads the image needs no other pose than the node's.
        frame = replace(frame, frame=replace(frame.frame, T_base_camera=T_node_camera))
        key = self._store.add(frame, registration, node)
        self._nodes.append(node)
        self._T_node_camera.append(T_node_camera)
        self._closer.add_keyframe(frame)
        tried = [] if poses is None else self._closer.close(key, self._camera_poses(poses))
        return [self._of_nodes(candidate) for candidate in tried]

    def dense(self, poses: FloatArray) -> DenseKeyframes | None:
        """The frames with their optimised poses; None without any."""
        return DenseKeyframes(self._store.images, self._camera_poses(poses)) if self._nodes else None

    def _camera_poses(self, poses: FloatArray) -> list[gtsam.Pose3]:
        """``T_map_camera`` of every frame."""
        return [
            gtsam.Pose3(pose2_from_row(poses[node])).compose(T_node_camera)
            for node, T_node_camera in zip(self._nodes, self._T_node_camera, strict=True)
        ]

    def _of_nodes(self, candidate: LoopCandidate) -> LoopCandidate:
        """A candidate between frames as one between nodes, projected to the plane."""
        place, key = candidate.place, candidate.keyframe
        candidate = replace(candidate, place=self._nodes[place], keyframe=self._nodes[key])
        motion = candidate.motion
        if motion is None or not isinstance(motion.T_reference_base, gtsam.Pose3):
            return candidate
        planar = planar_motion(
            motion.T_reference_base,
            motion.covariance,
            self._T_node_camera[key],
            self._T_node_camera[place],
        )
        measured = MotionEstimate(
            T_reference_base=pose2_from_row(planar.motion),
            covariance=planar.covariance,
            inlier_share=motion.inlier_share,
            fit=motion.fit,
            residual_m=motion.residual_m,
            converged=motion.converged,
            degenerate=False,
            weak_direction=planar.motion * 0.0,
        )
        candidate = replace(candidate, motion=measured)
        if candidate.accepted and planar.excess > self._greatest_excess:
            return candidate.refused("it would lift the robot off the floor")
        return candidate
