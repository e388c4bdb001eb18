"""Camera images at the keyframes of a lidar: pictures for the map, and places for loop closure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from slam.config import Config
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.visual_loops import VisualLoopCloser
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.keyframe_store import KeyframeStore
from slam.mapper.robot_cameras import Picture, RobotCameras
from slam.matching.planar import between
from slam.measurements import FloatArray, Pose, pose2_from_row, spatial
from slam.odometry.clock_learner import SensorClock
from slam.storage.map_frames import MapFrames
from slam.vision.color_registration import ColorRegistration
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.planar_motion import planar_motion
from slam.vision.prepared_frame import PreparedFrame


class _Places:
    """Keyframes of the leading camera, numbered consecutively."""

    def __init__(self, store: KeyframeStore) -> None:
        self._store = store
        self.keys: list[int] = []

    def keyframe(self, place: int) -> PreparedFrame:
        """See `slam.graph.visual_loops.Keyframes`."""
        return self._store.keyframe(self.keys[place])

    def touch(self, place: int) -> None:
        """See `slam.graph.visual_loops.Keyframes`."""
        self._store.touch(self.keys[place])


class CameraKeyframes:
    """Frames of a robot's cameras at the nodes of the graph; those of the leading camera are places.

    The pose of a frame depends on its camera's clock offset: it is recomputed when the offset is estimated.

    Parameters
    ----------
    registrations
        Poses of colour cameras that are not registered to depth, by name.
    """

    def __init__(
        self,
        config: Config,
        checkpoint: Checkpoint,
        registrations: Mapping[str, ColorRegistration],
        cameras: RobotCameras,
    ) -> None:
        self._cameras = cameras
        self._store = KeyframeStore(config.rgbd, config.match.local_map_keyframes, checkpoint.spool())
        self._places = _Places(self._store)
        self._closer = VisualLoopCloser(config, FrameMatcher(config), self._places, checkpoint)
        self._registrations = registrations
        self._nodes: list[int] = []
        self._stamps_s: list[float] = []
        self._taken: list[tuple[str, float]] = []
        self._T_node_camera: list[gtsam.Pose3] = []
        self._clocks: list[SensorClock] = []
        # Loops as measured between frames, by their nodes.
        self._measured: dict[tuple[int, int], LoopCandidate] = {}

    def add(self, node: int, stamp_s: float, pictures: Sequence[Picture], *, places: bool) -> None:
        """Store the frames of the newest node.

        Parameters
        ----------
        stamp_s
            Stamp of the node, by the robot's clock.
        pictures
            A frame of each camera, the leading one's first, with its pose relative to the node.
        places
            Whether the first frame may be recognised later.
        """
        for rank, picture in enumerate(pictures):
            # Relative to the base at the node, so that readers of the image need only the pose of the node.
            frame, mounting = picture.frame, picture.T_base_camera
            registration = self._registrations.get(frame.frame.sensor)
            self._nodes.append(node)
            self._stamps_s.append(stamp_s)
            self._taken.append((frame.frame.sensor, frame.stamp_s))
            self._T_node_camera.append(mounting)
            found_again = places and rank == 0
            key = self._store.add(frame, registration, node, mounting, matched=found_again)
            if found_again:
                self._places.keys.append(key)
                self._closer.add_keyframe(frame)

    def close(self, poses: Sequence[Pose]) -> list[LoopCandidate]:
        """Try to close loops with places that the newest frame may show, given the current node estimates.

        Returns
        -------
        Every candidate that was tried, between nodes.
        """
        clocks = [camera.clock for camera in self._cameras.cameras.values()]
        if clocks != self._clocks:
            self._clocks = clocks
            self._place_anew()
        keys = self._places.keys
        cameras = [spatial(poses[self._nodes[key]]).compose(self._T_node_camera[key]) for key in keys]
        tried = self._closer.close(len(keys) - 1, cameras)
        return [self._of_nodes(candidate) for candidate in tried]

    @property
    def frames(self) -> MapFrames:
        """Return all frames."""
        return self._store.images

    def settle(self, graph: KeyframeGraph, stamps_s: FloatArray) -> None:
        """At the end, recompute the poses of frames and loops with the final clock offsets and mountings.

        Parameters
        ----------
        stamps_s
            (K,) stamps of the nodes, by the final estimate of the robot's clock.
        """
        self._stamps_s = stamps_s[self._nodes].tolist()
        self._place_anew()
        for key, T_node_camera in enumerate(self._T_node_camera):
            self.frames.place(key, T_node_camera)
        for n, edge in enumerate(graph.graph.edges):
            measured = self._measured.get((edge.source, edge.target))
            if edge.loop is not None and measured is not None:
                moved = replace(graph.loops[edge.loop], motion=self._of_nodes(measured).motion)
                graph.loops[edge.loop], graph.graph.edges[n] = moved, moved.edge(edge.loop)

    def _place_anew(self) -> None:
        """Recompute the poses of frames; a frame with an unknown pose keeps its old one."""
        self._T_node_camera = [
            self._cameras.placed_at(*taken, stamp_s) or before
            for taken, stamp_s, before in zip(self._taken, self._stamps_s, self._T_node_camera, strict=True)
        ]

    def _of_nodes(self, candidate: LoopCandidate) -> LoopCandidate:
        """Convert a candidate between frames to one between nodes, projected onto the plane."""
        frames = [self._places.keys[candidate.place], self._places.keys[candidate.keyframe]]
        place, keyframe = (self._nodes[key] for key in frames)
        of_frames, candidate = candidate, replace(candidate, place=place, keyframe=keyframe)
        motion = candidate.motion
        if motion is None or not isinstance(motion.T_reference_base, gtsam.Pose3):
            return candidate
        self._measured[place, keyframe] = of_frames
        before, after = (self._T_node_camera[key] for key in frames)
        planar = planar_motion(motion.T_reference_base, motion.covariance, after, before)
        covariance = planar.covariance
        late = [self._cameras.placed_at(*self._taken[key], self._stamps_s[key], 1.0) for key in frames]
        if late[0] is not None and late[1] is not None:
            # A clock offset shifts both ends, each by the robot's motion there.
            moved = planar_motion(motion.T_reference_base, motion.covariance, late[1], late[0])
            by_clock = between(planar.motion, moved.motion)
            covariance = covariance + np.outer(by_clock, by_clock)
        measured = replace(
            motion,
            T_reference_base=pose2_from_row(planar.motion),
            covariance=covariance,
            degenerate=False,
            weak_direction=planar.motion * 0.0,
        )
        candidate = replace(candidate, motion=measured)
        if candidate.accepted and planar.leaves_the_floor:
            return candidate.refused("it would lift the robot off the floor")
        return candidate
