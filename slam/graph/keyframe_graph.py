"""The graph of keyframes: what holds neighbours together, which loops join, and where they all lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from slam.config.stages import GraphConfig
from slam.graph.loop_closure import LoopCandidate, judged
from slam.graph.pose_graph import BatchResult, Edge, EdgeKind, PoseGraph
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.graph.wheel_judge import outvoted_cameras
from slam.matching.planar import compose
from slam.measurements import FloatArray, pose2_from_row, row_from_pose2


class Step(NamedTuple):
    """Motion (3,) from one keyframe to the next, its covariance (3, 3), and the camera that measured it."""

    motion: FloatArray
    covariance: FloatArray
    camera: str = ""


class KeyframeGraph:
    """Keyframes 0..n-1 of a planar robot, the first at the origin."""

    def __init__(self, config: GraphConfig) -> None:
        self.graph = PoseGraph(gtsam.Pose2())
        self.uncertainty = UncertaintyGraph()
        self.loops: list[LoopCandidate] = []
        self._config = config
        self._poses = np.zeros((64, 3))
        self._camera_edges: dict[tuple[int, str], int] = {}
        self._loop_waits = False
        self.uncertainty.add_node()

    def __len__(self) -> int:
        return len(self.graph)

    def poses(self) -> FloatArray:
        """(n, 3) current estimates, x, y, yaw in the map."""
        return self._poses[: len(self.graph)]

    def add_keyframe(
        self,
        step: FloatArray,
        match: Step | None,
        wheels: Step | None,
        cameras: Sequence[Step] = (),
        *,
        match_doubtful: bool = False,
    ) -> int:
        """Add the next keyframe and return its number.

        Parameters
        ----------
        step
            (3,) best knowledge of the motion from the last keyframe: the first guess.
        match
            What the lidar measured; None where it matched nothing.
        wheels
            What the wheels measured; None where there are none or they jumped.
        cameras
            What each camera measured.
        match_doubtful
            Whether the loops may overrule the match.
        """
        pose = compose(self.poses()[-1], step)
        key = self.graph.add_node(pose2_from_row(pose))
        self.uncertainty.add_node()
        if key == self._poses.shape[0]:
            self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
        self._poses[key] = pose
        if match is not None:
            self._add_step(key, match, EdgeKind.LIDAR, trusted=not match_doubtful)
        if match is not None and match_doubtful:
            # It may be wrong as a loop may be: a loose twin holds the chain where it is refused. Not so for
            # a sure match, or a handful of false loops that agree with each other could break the chain.
            best = cameras[0].motion if cameras else step
            loose = Step(best, match.covariance + self.unmeasured(self._config.loose_share))
            self._add_step(key, loose, EdgeKind.ASSUMED, trusted=True)
        if wheels is not None:
            self._add_step(key, wheels, EdgeKind.WHEEL, trusted=match is None)
        for camera in cameras:
            self._camera_edges[key, camera.camera] = len(self.graph.edges)
            self._add_step(key, camera, EdgeKind.RGBD, trusted=False)
        if match is None and wheels is None:
            # Someone who walks before the camera takes it along: it may be overruled, and then this holds.
            share = self._config.loose_share if cameras else 1.0
            self._add_step(key, Step(step, self.unmeasured(share)), EdgeKind.ASSUMED, trusted=True)
        return key

    def add_bridge(self, source: int, match: Step, *, doubtful: bool) -> None:
        """A match to the newest keyframe from an older one, past keyframes that matched nothing.

        Where it is not doubtful it holds the chain, which is loose between: false loops may not break it.
        """
        target = len(self.graph) - 1
        motion = pose2_from_row(match.motion)
        self._add_edge(Edge(source, target, motion, match.covariance, EdgeKind.LIDAR, trusted=not doubtful))

    def add_camera_step(self, source: int, target: int, step: Step) -> None:
        """A camera's motion between two keyframes that are there, learned of later."""
        self._add_edge(
            Edge(source, target, pose2_from_row(step.motion), step.covariance, EdgeKind.RGBD, trusted=False)
        )

    def camera_steps(self) -> dict[int, set[str]]:
        """Keyframes, and the cameras that told the step to each when it was new."""
        found: dict[int, set[str]] = {}
        for key, camera in self._camera_edges:
            found.setdefault(key, set()).add(camera)
        return found

    def replace_camera_step(self, key: int, step: Step) -> None:
        """What a camera says now of the step to a keyframe, before the final optimisation."""
        number = self._camera_edges[key, step.camera]
        edge = self.graph.edges[number]
        self.graph.edges[number] = replace(
            edge, T_source_target=pose2_from_row(step.motion), covariance=step.covariance
        )

    def judge_cameras(self) -> int:
        """Let steps of cameras that match and wheels contradict tell little, at the end: how many."""
        outvoted = outvoted_cameras(self.graph.edges)
        for number, edge in outvoted.items():
            self.graph.edges[number] = edge
        return len(outvoted)

    def add_loop(self, candidate: LoopCandidate) -> None:
        """Take a loop candidate: into the graph if it was accepted, into the report in any case."""
        if candidate.accepted and candidate.motion is not None:
            self._loop_waits = True
            self._add_edge(candidate.edge(len(self.loops)))
        self.loops.append(candidate)

    def update(self) -> None:
        """Now and then, and only when a loop waits, let iSAM2 spread the corrections.

        Without a new loop the chain alone, which the estimates already follow, is the answer.
        """
        if self._loop_waits and (len(self) - 1) % self._config.incremental_every == 0:
            self.graph.update()
            self._poses[: len(self)] = self.graph.planar_poses()
            self._loop_waits = False

    def optimize(self, inlier_probability: float) -> BatchResult:
        """Solve everything anew; a loop that disagrees with the others is marked as refused."""
        self.graph.update()
        outcome = self.graph.optimize(inlier_probability)
        self.loops = judged(self.loops, self.graph.edges, outcome.kept)
        self._poses[: len(self)] = self.graph.planar_poses()
        return outcome

    def unmeasured(self, share: float) -> FloatArray:
        """Covariance (3, 3) of a step that nothing measured, its sigmas scaled by a share."""
        config = self._config
        sigmas = share * np.array([config.lost_sigma_m, config.lost_sigma_m, config.lost_sigma_rad])
        return np.diag(sigmas**2)

    def _add_step(self, key: int, step: Step, kind: EdgeKind, *, trusted: bool) -> None:
        """An edge from the keyframe before ``key`` to it."""
        self._add_edge(Edge(key - 1, key, pose2_from_row(step.motion), step.covariance, kind, trusted))

    def _add_edge(self, edge: Edge) -> None:
        """Into the graph, and into the map of relative uncertainties."""
        self.graph.add_edge(edge)
        self.uncertainty.add_edge(
            edge.source, edge.target, row_from_pose2(edge.T_source_target), edge.covariance
        )
