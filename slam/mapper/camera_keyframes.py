"""What cameras saw at the keyframes of a lidar: pictures for the map, places to come back to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam

from slam.config import Config
from slam.estimates import MotionEstimate
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.visual_loops import VisualLoopCloser
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.keyframe_store import KeyframeStore
from slam.mapper.robot_cameras import Picture
from slam.measurements import Pose, pose2_from_row, spatial
from slam.storage.map_frames import MapFrames
from slam.vision.color_registration import ColorRegistration
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.planar_motion import planar_motion
from slam.vision.prepared_frame import PreparedFrame


class _Places:
    """The frames of the leading camera, by their order among themselves."""

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
    """Frames of a robot's cameras, each belonging to a node of the graph; the leading camera's are places.

    Parameters
    ----------
    registrations
        Where colour cameras sit that are not registered to depth, by name.
    """

    def __init__(
        self, config: Config, checkpoint: Checkpoint, registrations: Mapping[str, ColorRegistration]
    ) -> None:
        self._store = KeyframeStore(config.rgbd, config.match.local_map_keyframes, checkpoint.spool())
        self._places = _Places(self._store)
        self._closer = VisualLoopCloser(config, FrameMatcher(config), self._places, checkpoint)
        self._registrations = registrations
        self._nodes: list[int] = []
        self._T_node_camera: list[gtsam.Pose3] = []

    def add(self, node: int, pictures: Sequence[Picture], *, places: bool) -> None:
        """Take the frames of the newest node.

        Parameters
        ----------
        pictures
            A frame of each camera, the leading one's first, and where they were taken, seen from the node.
        places
            Whether the first of them may be recognised later.
        """
        for rank, picture in enumerate(pictures):
            # Seen from the base at the node, so that who reads the image needs no other pose than the node's.
            image = replace(picture.frame.frame, T_base_camera=picture.T_base_camera)
            frame = replace(picture.frame, frame=image)
            registration = self._registrations.get(image.sensor)
            self._nodes.append(node)
            self._T_node_camera.append(picture.T_base_camera)
            if places and rank == 0:
                self._places.keys.append(self._store.add(frame, registration, node))
                self._closer.add_keyframe(frame)
            else:
                self._store.add_picture(frame, registration, node)

    def close(self, poses: Sequence[Pose]) -> list[LoopCandidate]:
        """Try the places that the newest frame may show, by the current estimates of all nodes.

        Returns
        -------
        Every candidate that was tried, its ends being nodes.
        """
        keys = self._places.keys
        cameras = [spatial(poses[self._nodes[key]]).compose(self._T_node_camera[key]) for key in keys]
        tried = self._closer.close(len(keys) - 1, cameras)
        return [self._of_nodes(candidate) for candidate in tried]

    @property
    def frames(self) -> MapFrames:
        """All of them."""
        return self._store.images

    def _of_nodes(self, candidate: LoopCandidate) -> LoopCandidate:
        """A candidate between frames as one between nodes, projected to the plane."""
        place, key = self._places.keys[candidate.place], self._places.keys[candidate.keyframe]
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
        if candidate.accepted and planar.leaves_the_floor:
            return candidate.refused("it would lift the robot off the floor")
        return candidate
