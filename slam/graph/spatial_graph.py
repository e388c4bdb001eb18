"""The graph of keyframes in space: a chain, loops, and where they all lie."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.config.stages import GraphConfig
from slam.graph.anchored_steps import Bridge
from slam.graph.loop_closure import LoopCandidate, judged
from slam.graph.pose_graph import BatchResult, Edge, EdgeKind, PoseGraph
from slam.measurements import FloatArray


class SpatialGraph:
    """Keyframes 0..n-1 of a sensor that moves freely."""

    def __init__(self, origin: gtsam.Pose3, config: GraphConfig) -> None:
        self.graph = PoseGraph(origin)
        self.loops: list[LoopCandidate] = []
        self._config = config
        self._poses = [origin]
        self._loop_waits = False

    def __len__(self) -> int:
        return len(self.graph)

    def poses(self) -> list[gtsam.Pose3]:
        """Current estimates, ``T_map_keyframe``."""
        return self._poses

    def add_keyframe(
        self, step: gtsam.Pose3, covariance: FloatArray | None, kind: EdgeKind = EdgeKind.RGBD
    ) -> int:
        """Add the next keyframe and return its number.

        Parameters
        ----------
        step
            Motion from the last keyframe.
        covariance
            (6, 6), GTSAM's order; None where nothing measured the step.
        kind
            What measured it.
        """
        key = self.graph.add_node(self._poses[-1].compose(step))
        self._poses.append(self._poses[-1].compose(step))
        config = self._config
        if covariance is None:
            kind = EdgeKind.ASSUMED
            covariance = np.diag([config.lost_sigma_rad**2] * 3 + [config.lost_sigma_m**2] * 3)
        self.graph.add_edge(Edge(key - 1, key, step, covariance, kind, trusted=True))
        return key

    def add_bridge(self, bridge: Bridge) -> None:
        """Join the newest keyframe to an older one, past keyframes that were not surely placed."""
        motion, covariance = bridge.T_source_target, bridge.covariance
        self.graph.add_edge(
            Edge(bridge.source, len(self) - 1, motion, covariance, EdgeKind.LIDAR, trusted=True)
        )

    def add_loop(self, candidate: LoopCandidate) -> None:
        """Take a loop candidate: into the graph if it was accepted, into the report in any case."""
        if candidate.accepted and candidate.motion is not None:
            self._loop_waits = True
            self.graph.add_edge(candidate.edge(len(self.loops)))
        self.loops.append(candidate)

    def update(self) -> None:
        """Let iSAM2 spread what loops have corrected, if one waits."""
        if self._loop_waits:
            self.graph.update()
            self._read_poses()
            self._loop_waits = False

    def optimize(self, inlier_probability: float) -> BatchResult:
        """Solve everything anew; a loop that disagrees with the others is marked as refused."""
        self.graph.update()
        outcome = self.graph.optimize(inlier_probability)
        self.loops = judged(self.loops, self.graph.edges, outcome.kept)
        self._read_poses()
        return outcome

    def _read_poses(self) -> None:
        self._poses = [self.graph.spatial_pose(key) for key in range(len(self.graph))]
