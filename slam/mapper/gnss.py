"""Fixes of a satellite receiver, gathered along the way and laid on the map when it is done."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from fusion.time_alignment import GAP_S
from slam.earth import Georeference, TangentPlane
from slam.estimates import Trajectory
from slam.graph.anchors import Anchor, Anchored, anchored
from slam.graph.edge import EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.pose_graph import BatchResult
from slam.measurements import FloatArray, GnssFix, Pose, spatial

# Of a receiver that tells none: metres across and up, as receivers without corrections have them.
_SIGMA_M, _SIGMA_UP_M = 5.0, 10.0
# Clouds of the sky and mirrored signals stay for a while: what comes within it is one witness.
_SHARED_S = 10.0
# More of them than are mirrored as a rule.
_MIRRORED_SHARE = 0.1


class GnssAnchors:
    """The fixes of one receiver, and what became of them.

    Attributes
    ----------
    georeference
        Where the map lies on the earth, once it was laid there; else None.
    unused
        Why the fixes could not be used; empty where they are.
    """

    def __init__(self) -> None:
        self.georeference: Georeference | None = None
        self.unused = ""
        self._fixes: list[GnssFix] = []
        self._told = ""

    def __len__(self) -> int:
        return len(self._fixes)

    @property
    def sensor(self) -> str:
        """The name of the receiver."""
        return self._fixes[0].sensor if self._fixes else ""

    def observe(self, fix: GnssFix) -> None:
        """Take the next fix; of several receivers the first to tell one is asked."""
        if fix.sensor == (self.sensor or fix.sensor):
            self._fixes.append(fix)

    def notes(self) -> list[str]:
        """What was found, for people."""
        return [self._told] if self._told else []

    def anchor(
        self,
        graph: KeyframeGraph,
        bases: Sequence[Pose],
        stamps_s: FloatArray,
        trajectory: Trajectory,
        outcome: BatchResult,
        inlier_probability: float,
    ) -> BatchResult:
        """Lay the map on the earth and solve it anew.

        Parameters
        ----------
        bases, stamps_s
            (K,) ``T_map_base`` of the keyframes, optimised, and when they were.
        trajectory
            A pose for every reading, by these.
        outcome
            Of the optimisation so far.
        inlier_probability
            See `slam.graph.pose_graph.PoseGraph.optimize`.

        Returns
        -------
        Of the new one; the old one where the fixes tell nothing.
        """
        first = self._fixes[0]
        plane = TangentPlane(first.latitude_deg, first.longitude_deg, first.altitude_m)
        anchors = self._anchors(graph.poses(), bases, stamps_s, trajectory, plane)
        if len(anchors) < FEWEST:
            self.unused = f"only {len(anchors)} keyframes have a fix"
            return outcome
        edges = graph.graph.edges
        held = [edge for edge, keep in zip(edges, outcome.kept, strict=True) if keep]
        found, kept = anchored(graph.poses(), held, anchors), outcome.kept
        if found is None:
            self.unused = "the way is no longer than its fixes are uncertain"
            return outcome
        if found.misfits > _MIRRORED_SHARE:
            # A false loop outweighs any fix. Where far more fit without loops, those begin refused.
            chain = [edge for edge in held if edge.loop is None]
            other = anchored(graph.poses(), chain, anchors)
            if other is not None and other.misfits < 0.5 * found.misfits:
                found, kept = other, kept & np.array([edge.loop is None for edge in edges])
        for edge in found.edges:
            graph.graph.add_edge(edge)
        graph.graph.begin_with([*kept, *[True] * len(found.edges)])
        outcome = graph.optimize(inlier_probability)
        self.georeference = Georeference(plane, found.T_enu_map)
        self._tell(found, graph, anchors, outcome)
        return outcome

    def _anchors(
        self,
        nodes: Sequence[Pose],
        bases: Sequence[Pose],
        stamps_s: FloatArray,
        trajectory: Trajectory,
        plane: TangentPlane,
    ) -> list[Anchor]:
        """The fix nearest in time to each keyframe, where the way between them is known."""
        order = np.argsort(trajectory.stamps_s, kind="stable")
        ways = trajectory[order]
        fixes_s = np.array([fix.stamp_s for fix in self._fixes])
        in_time = np.argsort(stamps_s, kind="stable")
        middles_s = 0.5 * (stamps_s[in_time][1:] + stamps_s[in_time][:-1])
        nearest = in_time[np.searchsorted(middles_s, fixes_s)]
        best: dict[int, int] = {}
        for number, key in enumerate(nearest.tolist()):
            other = best.get(key)
            if other is None or abs(fixes_s[number] - stamps_s[key]) < abs(fixes_s[other] - stamps_s[key]):
                best[key] = number
        anchors = list[Anchor]()
        for key, number in sorted(best.items()):
            at = _pose_at(ways, float(fixes_s[number]))
            if at is None:
                continue
            fix, node = self._fixes[number], spatial(nodes[key])
            # The antenna in the node's frame, when the fix was taken.
            moved = spatial(bases[key]).between(at)
            arm = np.zeros(3) if fix.antenna_m is None else fix.antenna_m
            arm_m = node.between(spatial(bases[key])).compose(moved).transformFrom(arm)
            place_m = plane.enu_m(fix.latitude_deg, fix.longitude_deg, fix.altitude_m)
            covariance = fix.covariance_m2
            if covariance is None:
                covariance = np.diag([_SIGMA_M, _SIGMA_M, _SIGMA_UP_M]) ** 2
            anchors.append(Anchor(key, place_m, covariance, np.asarray(arm_m)))
        at_s = np.array([self._fixes[best[one.node]].stamp_s for one in anchors])
        sorted_s, half_s = np.sort(at_s), 0.5 * _SHARED_S
        ends = np.searchsorted(sorted_s, at_s + half_s, "right"), np.searchsorted(sorted_s, at_s - half_s)
        together = ends[0] - ends[1]
        return [
            replace(one, together=float(count)) for one, count in zip(anchors, together.tolist(), strict=True)
        ]

    def _tell(
        self, found: Anchored, graph: KeyframeGraph, anchors: Sequence[Anchor], outcome: BatchResult
    ) -> None:
        """A line on how well the fixes fit."""
        assert self.georeference is not None
        used = {
            edge.target
            for edge, keep in zip(graph.graph.edges, outcome.kept, strict=True)
            if edge.kind is EdgeKind.GNSS and keep
        }
        poses = graph.poses()
        off_m = [
            np.linalg.norm(
                (found.T_enu_map.compose(spatial(poses[one.node])).transformFrom(one.arm_m) - one.place_m)[:2]
            )
            for one in anchors
            if one.node in used
        ]
        larger = f", errors {found.scale:.1f} times what they claim" if found.scale > 1.0 else ""
        rms = f"; those used are {np.sqrt(np.mean(np.square(off_m))):.2f} m off (RMS)" if off_m else ""
        all_ = sum(one.node > 0 for one in anchors)
        self._told = (
            f"GNSS: {len(used)} of {all_} keyframes with a fix hold the map on the earth{larger}{rms}; its x "
            f"axis looks {self.georeference.heading_deg:.1f} degrees east of north"
        )


def _pose_at(ways: Trajectory, stamp_s: float) -> gtsam.Pose3 | None:
    """Between two poses of a trajectory in the order of time; None where it is not known."""
    after = int(np.searchsorted(ways.stamps_s, stamp_s))
    pair = ways[max(after - 1, 0) : after + 1]
    ends = pair.poses()
    if np.abs(pair.stamps_s - stamp_s).min() > GAP_S:
        return None
    if len(ends) < 2 or pair.stamps_s[1] <= pair.stamps_s[0]:
        return ends[0]
    share = (stamp_s - pair.stamps_s[0]) / (pair.stamps_s[1] - pair.stamps_s[0])
    return ends[0].slerp(float(np.clip(share, 0.0, 1.0)), ends[1])
