"""Collect the fixes of a GNSS receiver along the path, and align the finished map with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.estimation import FEWEST
from slam.earth import Georeference, TangentPlane
from slam.graph.anchors import Anchor, Anchored
from slam.graph.edge import EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.pose_graph import BatchResult
from slam.mapper.anchoring import Track, anchor
from slam.measurements import GnssFix, spatial

# Default sigmas, horizontal and vertical in metres, as receivers without corrections have them.
_SIGMA_M, _SIGMA_UP_M = 5.0, 10.0
# Ionospheric and multipath errors persist for a while: fixes within this time count as one.
_SHARED_S = 10.0


class GnssAnchors:
    """The fixes of one receiver, and how they were used.

    Attributes
    ----------
    georeference
        Pose of the map on the earth, once it is aligned; else None.
    unused
        Why the fixes could not be used; empty if they were.
    """

    def __init__(self) -> None:
        self.georeference: Georeference | None = None
        self.unused = ""
        self._fixes: list[GnssFix] = []
        self._note = ""

    def __len__(self) -> int:
        return len(self._fixes)

    @property
    def sensor(self) -> str:
        """Return the name of the receiver."""
        return self._fixes[0].sensor if self._fixes else ""

    def observe(self, fix: GnssFix) -> None:
        """Store the next fix; of several receivers, the first that reports one is used."""
        if fix.sensor == (self.sensor or fix.sensor):
            self._fixes.append(fix)

    def notes(self) -> list[str]:
        """Return notes for the user."""
        return [self._note] if self._note else []

    def anchor(
        self, graph: KeyframeGraph, track: Track, outcome: BatchResult, inlier_probability: float
    ) -> BatchResult:
        """Align the map with the earth and solve it again, see `slam.mapper.anchoring.anchor`.

        Returns
        -------
        The new optimisation; the previous one if the fixes do not determine the alignment.
        """
        first = self._fixes[0]
        plane = TangentPlane(first.latitude_deg, first.longitude_deg, first.altitude_m)
        anchors = self._anchors(track, plane)
        if len(anchors) < FEWEST:
            self.unused = f"only {len(anchors)} keyframes have a fix"
            return outcome
        outcome, solution = anchor(graph, anchors, outcome, inlier_probability, EdgeKind.GNSS)
        if solution is None:
            self.unused = "the trajectory is not longer than the uncertainty of its fixes"
            return outcome
        self.georeference = Georeference(plane, solution.T_enu_map)
        self._add_notes(solution, graph, anchors, outcome)
        return outcome

    def _anchors(self, track: Track, plane: TangentPlane) -> list[Anchor]:
        """Return the fix nearest in time to each keyframe, if the motion between them is known."""
        fixes_s, stamps_s = np.array([fix.stamp_s for fix in self._fixes]), track.stamps_s
        best: dict[int, int] = {}
        for number, key in enumerate(track.nearest(fixes_s).tolist()):
            other = best.get(key)
            if other is None or abs(fixes_s[number] - stamps_s[key]) < abs(fixes_s[other] - stamps_s[key]):
                best[key] = number
        anchors = list[Anchor]()
        for key, number in sorted(best.items()):
            T_node_base = track.seen_from(key, float(fixes_s[number]))
            if T_node_base is None:
                continue
            fix = self._fixes[number]
            # The antenna in the node's frame at the time of the fix.
            arm_m = T_node_base.transformFrom(np.zeros(3) if fix.antenna_m is None else fix.antenna_m)
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

    def _add_notes(
        self, fit: Anchored, graph: KeyframeGraph, anchors: Sequence[Anchor], outcome: BatchResult
    ) -> None:
        """Write a line about how well the fixes fit."""
        assert self.georeference is not None
        used = {
            edge.target
            for edge, keep in zip(graph.graph.edges, outcome.kept, strict=True)
            if edge.kind is EdgeKind.GNSS and keep
        }
        poses = graph.poses()
        off_m = [
            np.linalg.norm(
                (fit.T_enu_map.compose(spatial(poses[one.node])).transformFrom(one.arm_m) - one.place_m)[:2]
            )
            for one in anchors
            if one.node in used
        ]
        larger = f", errors {fit.scale:.1f} times their stated sigma" if fit.scale > 1.0 else ""
        rms = f"; those used are {np.sqrt(np.mean(np.square(off_m))):.2f} m off (RMS)" if off_m else ""
        all_ = sum(one.node > 0 for one in anchors)
        self._note = (
            f"GNSS: {len(used)} of {all_} keyframes with a fix georeference the map{larger}{rms}; its x "
            f"axis points {self.georeference.heading_deg:.1f} degrees east of north"
        )
