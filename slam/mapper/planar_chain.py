"""Edges between consecutive keyframes of a planar robot: which of lidar, wheels and cameras to trust."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from fusion.estimation import FEWEST
from slam.config import Config
from slam.config.stages import GraphConfig
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph, unmeasured
from slam.mapper.robot_cameras import CameraPoses, CameraStep, RobotCameras
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row, row_from_pose2
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import WheelTracker

# The guessed pose of a keyframe without a match is uncertain by this share of an unmeasured step.
_GUESS_SHARE = 0.1


class PlanarChain:
    """The steps between consecutive keyframes, some of which are still to be revised."""

    def __init__(
        self, config: Config, tracker: MotionTracker, wheels: WheelTracker | None, cameras: RobotCameras
    ) -> None:
        self._config, self._tracker, self._wheels, self._cameras = config, tracker, wheels, cameras
        self._last: TrackedScan | None = None
        # The last keyframe that matched, as long as none after it has seen what others may be matched to.
        self._matched: tuple[int, TrackedScan] | None = None
        self._stretch: tuple[int, TrackedScan | None] = (0, None)
        self._camera_poses: CameraPoses = {}
        self._stamps_s: list[float] = []
        # Keyframe and camera of every edge by a camera so far, in their order.
        self._camera_edges: list[tuple[int, str]] = []

    @property
    def last(self) -> TrackedScan | None:
        """The newest keyframe."""
        return self._last

    def add(
        self,
        key: int,
        stamp_s: float,
        tracked: TrackedScan,
        camera_poses: CameraPoses,
        *,
        blind: bool = False,
    ) -> tuple[FloatArray, list[Edge]]:
        """Add the next keyframe.

        Parameters
        ----------
        blind
            Whether its lidar saw too little for other scans to be matched to it.

        Returns
        -------
        (3,) the motion since the last keyframe, and the edges to the new one.
        """
        step, edges = np.zeros(3), list[Edge]()
        if self._last is None:
            self._stretch = key, tracked
        if self._last is not None:
            step, edges = self._step(key, stamp_s, self._last, tracked, camera_poses)
        self._stamps_s.append(stamp_s)
        self._camera_poses, self._last = camera_poses, tracked
        if tracked.motion is not None or key == 0:
            self._matched = key, tracked
        elif not blind:
            self._matched = None
        return step, edges

    def settle(
        self, graph: KeyframeGraph, stamps_s: FloatArray, before: FloatArray, after: FloatArray
    ) -> None:
        """Recompute, at the end, the steps of cameras and wheels with the estimated clocks and mountings.

        Parameters
        ----------
        stamps_s
            (K,) stamps of the keyframes by the clocks as estimated now.
        before, after
            (K, 3) poses of the wheels at the keyframes, as used for their edges, and by these stamps.
        """
        moved = (before != after).any(axis=1)
        for n, edge in enumerate(graph.graph.edges):
            ends = [edge.source, edge.target]
            if edge.kind is EdgeKind.WHEEL and moved[ends].any():
                used, final = (between(*wheels[ends]) for wheels in (before, after))
                row = compose(row_from_pose2(edge.T_source_target), between(used, final))
                graph.graph.edges[n] = replace(edge, T_source_target=pose2_from_row(row))
        reported = [n for n, edge in enumerate(graph.graph.edges) if edge.kind is EdgeKind.RGBD]
        numbers = dict(zip(self._camera_edges, reported, strict=True))
        poses = [self._cameras.camera_poses(stamp_s) for stamp_s in stamps_s.tolist()]
        for key, ended in enumerate(pairwise(poses), 1):
            for name, step in self._camera_steps(self._cameras.steps(*ended)).items():
                edge = _camera_edge(key - 1, key, step)
                if (key, name) in numbers:
                    graph.graph.edges[numbers[key, name]] = edge
                else:  # it began after the lidar, or was not known when the keyframe was made
                    graph.add_edge(edge)
        for source, target, motion in self._cameras.learned_steps():
            graph.add_edge(_camera_edge(source, target, Motion(motion.motion, motion.covariance)))

    def _step(
        self, key: int, stamp_s: float, last: TrackedScan, tracked: TrackedScan, camera_poses: CameraPoses
    ) -> tuple[FloatArray, list[Edge]]:
        """Return the motion from the last keyframe, and the edges."""
        step = between(last.pose, tracked.pose)
        match = None
        if tracked.motion is not None:
            matched = row_from_pose2(tracked.motion.T_reference_base)
            match = Motion(between(last.pose, matched), tracked.motion.covariance + tracked.dispute)
        wheels = self._tracker.wheel_motion(last.wheels, tracked.wheels, stamp_s - self._stamps_s[-1])
        bridge = None
        if match is not None and (self._matched is None or last is not self._matched[1]):
            match, bridge = self._past_a_guess(key, match, last)
        moved = self._cameras.steps(self._camera_poses, camera_poses)
        by_camera = self._camera_steps(moved)
        cameras = list(by_camera.values())
        doubtful = self._doubtful(tracked)
        longer = max(stamp_s - self._stamps_s[-1], 1.0)
        edges = edges_of(
            key,
            step,
            match,
            wheels,
            cameras,
            self._config.graph,
            longer,
            match_doubtful=doubtful,
            match_open=tracked.open,
        )
        edges += self._long_wheels(key, stamp_s, tracked)
        if (turn := self._tracker.gyro_turn(last, tracked.gyro, chained=True)) is not None:
            # It measures no translation.
            unknown = unmeasured(self._config.graph, FEWEST, planar=True)
            unknown[2, 2] = turn[1]
            motion = Motion(np.array([step[0], step[1], turn[0]]), unknown)
            edges.append(_edge(key - 1, key, motion, EdgeKind.IMU, trusted=True))
        if bridge is not None:
            # Loops may reject it.
            edges.append(bridge)
        self._camera_edges += [(key, name) for name in by_camera]
        self._cameras.learn(key - 1, key, moved, wheels if doubtful else match)
        return step, edges

    def _past_a_guess(self, key: int, match: Motion, last: TrackedScan) -> tuple[Motion, Edge | None]:
        """Return edges of a match if the last keyframe matched nothing: from it, and from the last match.

        The unmatched pose was predicted by wheels or cameras, and a match to earlier keyframes adds nothing
        about it. If it saw enough but matched nothing, the robot was somewhere else: then the new scan is
        matched to it, and its relation to earlier keyframes is unknown.
        """
        guess = unmeasured(self._config.graph, _GUESS_SHARE, planar=True)
        uncertain = Motion(match.pose, match.covariance + guess)
        if self._matched is None:
            return uncertain, None
        source, matched = self._matched
        bridge = Motion(between(matched.pose, compose(last.pose, match.pose)), match.covariance)
        return uncertain, _edge(source, key, bridge, EdgeKind.LIDAR, trusted=False)

    def _long_wheels(self, key: int, stamp_s: float, tracked: TrackedScan) -> list[Edge]:
        """Add wheel edges over long stretches from time to time: a single wrong match cannot bend them."""
        begun, anchor = self._stretch
        if key - begun < 2 * self._config.loops.half_keyframes:
            return []
        self._stretch = key, tracked
        if anchor is None:
            return []
        wheels = self._tracker.wheel_motion(anchor.wheels, tracked.wheels, stamp_s - self._stamps_s[begun])
        return [] if wheels is None else [_edge(begun, key, wheels, EdgeKind.WHEEL, trusted=False)]

    def _camera_steps(self, moved: list[CameraStep]) -> dict[str, Motion]:
        """Return the steps of cameras with a given mounting, by name; others wait for the last estimate."""
        return {
            step.camera: Motion(step.planar.motion, step.planar.covariance)
            for step in moved
            if step.planar is not None and not self._cameras.is_learned(step.camera)
        }

    def _doubtful(self, tracked: TrackedScan) -> bool:
        """Return whether a match was contradicted, or has too few inliers."""
        least = self._config.match.confident_inlier_share
        motion, disputed = tracked.motion, np.count_nonzero(tracked.dispute) > 0
        return bool(motion is None or disputed or motion.inlier_share < least)


def edges_of(
    key: int,
    step: FloatArray,
    match: Motion | None,
    wheels: Motion | None,
    cameras: Sequence[Motion],
    config: GraphConfig,
    longer: float = 1.0,
    *,
    match_doubtful: bool = False,
    match_open: bool = False,
) -> list[Edge]:
    """Return the edges from the previous keyframe to a keyframe; at least one is trusted.

    Parameters
    ----------
    step
        (3,) best estimate of the motion.
    match, wheels, cameras
        Measured motions; None if a sensor measured nothing.
    longer
        Factor of the sigmas of an unmeasured step, 1 for one of a second.
    match_doubtful
        Whether the loops may overrule the match.
    match_open
        Whether the match leaves a direction undetermined.
    """
    edges = []
    if match is not None:
        edges.append(_edge(key - 1, key, match, EdgeKind.LIDAR, trusted=not match_doubtful))
    if match is not None and match_doubtful:
        # It may be wrong as a loop may be: a second, loose edge holds the chain where it is refused. Not so
        # for a certain match, or a handful of false loops that agree with each other could break the chain.
        loose = Motion(step, match.covariance + unmeasured(config, longer * config.loose_share, planar=True))
        edges.append(_edge(key - 1, key, loose, EdgeKind.ASSUMED, trusted=True))
    if wheels is not None and match_open:
        # Translation and rotation may be rejected separately: a heading may jump.
        translation = wheels.widened(np.diag([0.0, 0.0, math.pi**2]))
        turn = wheels.widened(np.diag([config.lost_sigma_m**2, config.lost_sigma_m**2, 0.0]))
        edges += [_edge(key - 1, key, part, EdgeKind.WHEEL, trusted=False) for part in (translation, turn)]
    elif wheels is not None:
        edges.append(_edge(key - 1, key, wheels, EdgeKind.WHEEL, trusted=match is None))
    edges += [_camera_edge(key - 1, key, camera) for camera in cameras]
    if match_open or (match is None and wheels is None):
        # A person in front of the camera distorts its motion: if it is rejected, this edge holds.
        share = config.loose_share if cameras else 1.0
        assumed = Motion(step, unmeasured(config, longer * share, planar=True))
        edges.append(_edge(key - 1, key, assumed, EdgeKind.ASSUMED, trusted=True))
    return edges


def _edge(source: int, target: int, step: Motion, kind: EdgeKind, *, trusted: bool) -> Edge:
    """Return a step as an edge."""
    return Edge(source, target, pose2_from_row(step.pose), step.covariance, kind, trusted)


def _camera_edge(source: int, target: int, step: Motion) -> Edge:
    """Return a camera's step as an edge that may be rejected."""
    return _edge(source, target, step, EdgeKind.RGBD, trusted=False)
