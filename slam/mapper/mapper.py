"""The main loop's state: measurements -> front end -> factors -> keyframe graph -> loops -> map."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.errors import DatasetError, GraphError
from slam.estimates import Trajectory
from slam.forked import Begun
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_closure import LoopCandidate
from slam.graph.pose_covariances import pose_covariances
from slam.mapper.anchoring import Way
from slam.mapper.gnss import GnssAnchors
from slam.mapper.map_result import MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.protocol import SENSORS, FrontEnd, Sensor, Tracked
from slam.mapper.scan_record import ScanRecorder
from slam.mapper.tags import PlaceAnchors
from slam.measurements import FloatArray, GnssFix
from slam.storage.map_contents import MapContents, SavedFactor, clock_sigma_s
from slam.trajectory.carried import (
    carried_covariances,
    grown_covariances,
    late_covariances,
    unseen_covariances,
)


class Mapper:
    """State of a run: feed measurements in log order, then finish.

    Parameters
    ----------
    front_end
        What tells where the robot is, and makes the map: `slam.mapper.lidar2d.PlanarRobot`,
        `slam.mapper.lidar3d.CloudLidar` or `slam.mapper.rgbd.FreeCamera`.
    """

    def __init__(self, config: Config, front_end: FrontEnd) -> None:
        self._config, self._front_end = config, front_end
        self._sensors: dict[type, Sensor] = {}
        self._graph: KeyframeGraph | None = None
        self._record, self._gnss = ScanRecorder(), GnssAnchors()
        places = config.sensors.tags
        self._places = None if places is None else PlaceAnchors(places)
        self._keyframes_s = self._beside_s = 0.0

    @property
    def scan_count(self) -> int:
        """Scans, clouds or frames so far that were given a pose."""
        return len(self._record)

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Wall time of what was taken so far, by stage."""
        scans = float(self._record.finish().seconds.sum())
        return {
            "scans": scans - self._keyframes_s,
            "keyframes and loops": self._keyframes_s,
            "what is between the scans": self._beside_s,
        }

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Where cameras sit that the log does not tell, as far as this run has shown."""
        return self._front_end.learned_mountings()

    def add(self, measurement: Any) -> None:
        """Take the next measurement; where the robot has moved on, add a keyframe and close loops."""
        started = time.perf_counter()
        kind = type(measurement)
        if kind in SENSORS:
            if kind not in self._sensors:
                self._sensors[kind] = SENSORS[kind](self._config)
            self._sensors[kind].observe(measurement)
            self._beside_s += time.perf_counter() - started
            return
        if kind is GnssFix:
            self._gnss.observe(measurement)
            return
        tracked = self._front_end.observe(measurement)
        if tracked is None:
            self._beside_s += time.perf_counter() - started
            return
        if tracked.new_keyframe:
            before = time.perf_counter()
            self._add_keyframe(tracked)
            self._keyframes_s += time.perf_counter() - before
        self._record.add(tracked.stamp_s, tracked.motion, time.perf_counter() - started, tracked.match)

    def add_loop(self, candidate: LoopCandidate) -> None:
        """Take a loop candidate: into the graph if it was accepted, into the report in any case."""
        self._keyframes.add_loop(candidate)

    def finish(self) -> MapResult:
        """Optimise everything, give every reading its pose, and make the map.

        Raises
        ------
        DatasetError
            Where nothing could be mapped.
        """
        self._front_end.refuse()
        graph, front_end = self._keyframes, self._front_end
        clock = [time.perf_counter()]
        front_end.settle(graph)
        probability = self._config.loops.inlier_probability
        outcome = graph.optimize(probability)
        scans = replace(self._record.finish(), stamps_s=front_end.readings.scan_stamps_s())
        numbers = front_end.readings.keyframe_scans()
        stamps_s = scans.stamps_s[numbers]

        def way() -> Way:
            poses = graph.poses()
            bases = front_end.bases(poses)
            return Way.of(poses, bases, stamps_s, front_end.readings.trajectory(bases))

        if self._places is not None:
            outcome = self._places.join(front_end.tags, graph, way(), outcome, probability)
        # It ends: nothing is found twice.
        while found := front_end.search_again(graph, outcome.kept):
            for candidate in found:
                graph.add_loop(candidate)
            outcome = graph.optimize(probability)
        bases, edges = front_end.bases(graph.poses()), graph.graph.edges
        trajectory = front_end.readings.trajectory(bases)
        for anchors in (self._gnss.anchor if self._gnss else None, self._places and self._places.survey):
            if anchors:
                outcome = anchors(graph, way(), outcome, probability)
                bases = front_end.bases(graph.poses())
                trajectory = front_end.readings.trajectory(bases)
        clock.append(time.perf_counter())
        told = Begun(lambda: pose_covariances(graph.poses(), bases, edges, outcome.kept, self._config))
        if self._places is not None:
            self._places.check(graph, way(), outcome, self._config)
        factors = zip(edges, outcome.kept.tolist(), strict=True)
        result = MapResult(
            MapContents(
                node_poses=list(graph.poses()),
                stamps_s=stamps_s,
                readings=numbers,
                trajectory=trajectory,
                factors=[SavedFactor(edge, kept) for edge, kept in factors],
                loops=graph.loops,
                georeference=self._gnss.georeference,
                places=None if self._places is None else self._places.found,
            ),
            scans,
            {
                **self.stage_seconds,
                "final optimisation": clock[1] - clock[0],
            },
        )
        front_end.complete(result)
        clock.append(time.perf_counter())
        at = front_end.readings.keyframe_readings()
        covariances = carried_covariances(trajectory, at, *told())
        placed, wheels = front_end.readings.placed(), front_end.readings.wheels()
        covariances += unseen_covariances(trajectory, placed, wheels, covariances.shape[1])
        result.map = replace(result.map, covariances=covariances)
        if sigma_s := clock_sigma_s(result.map):
            # The map holds them.
            covariances += late_covariances(trajectory, int(at[0]), [(len(trajectory), sigma_s)])
        result.stage_seconds["map"] = clock[2] - clock[1] - result.stage_seconds.get("fusion", 0.0)
        result.stage_seconds["full trajectory"] = time.perf_counter() - clock[2]
        result.notes += [note for sensor in self._sensors.values() for note in sensor.notes()]
        result.notes += self._gnss.notes()
        if self._places is not None:
            result.notes += self._places.notes
            result.warnings += self._places.warnings
        if self._gnss.unused:
            result.unused[self._gnss.sensor] = self._gnss.unused
        result.warnings += _apart(graph.pieces(outcome.kept), result.map.stamps_s - scans.stamps_s[0])
        limits = self._config.match.search_half_width_m, self._config.loops.reach_m
        result.warnings += _unseen(trajectory, placed, covariances, *limits)
        return result

    @property
    def _keyframes(self) -> KeyframeGraph:
        """The graph, once there is a keyframe."""
        if self._graph is None:
            raise DatasetError("nothing in the log can be mapped; see 'scanweave inspect' for what it holds")
        return self._graph

    def _add_keyframe(self, tracked: Tracked) -> None:
        """Grow the graph by the newest moment, and close loops."""
        front_end, key = self._front_end, 0
        if self._graph is None:
            self._graph = KeyframeGraph(front_end.origin(), self._config.graph)
            front_end.step(key)
            for edge in self._factors(key, tracked.stamp_s):
                self._graph.add_edge(edge)
        else:
            key = len(self._graph)
            step, edges = front_end.step(key)
            self._graph.add_keyframe(step, [*edges, *self._factors(key, tracked.stamp_s)])
        front_end.readings.mark_keyframe()
        for candidate in front_end.recognise(key, self._graph):
            self._graph.add_loop(candidate)
        self._graph.update()

    def _factors(self, key: int, stamp_s: float) -> list[Edge]:
        """What the sensors beside the front end know of a new keyframe."""
        edges = [edge for sensor in self._sensors.values() for edge in sensor.factors(key, stamp_s)]
        for edge in edges:
            if edge.kind in set(EdgeKind):
                raise GraphError(
                    f"a registered sensor's edge is called '{edge.kind}'; give it a name of its own"
                )
        return edges


def _apart(pieces: NDArray[np.int64], stamps_s: FloatArray) -> list[str]:
    """A warning where nothing but guesses holds parts of the map together; single keyframes are no part.

    Parameters
    ----------
    pieces
        (n,) number of each keyframe's piece.
    stamps_s
        (n,) since the start.
    """
    counts = np.bincount(pieces)
    (parts,) = np.nonzero(counts > 1)
    if len(parts) < 2:
        return []
    begins_s = sorted(float(stamps_s[pieces == part][0]) for part in parts)
    share = counts.max() / len(pieces)
    return [
        f"The map is in {len(parts)} pieces, and how they lie to each other is a guess: the first ends "
        f"before {begins_s[1]:.0f} s, the largest has {share:.0%} of the keyframes. Wheels, more scans or "
        "a place seen again would join them"
    ]


def _unseen(
    trajectory: Trajectory, placed: NDArray[np.int64], covariances: FloatArray, most_m: float, lever_m: float
) -> list[str]:
    """A warning where no scan was placed for a while, and poses became more uncertain than a match mends.

    Parameters
    ----------
    covariances
        (N, d, d) of all poses.
    placed
        (S,) numbers of those that a scan has placed.
    most_m, lever_m
        As uncertain as that may be what lies so far from the robot.
    """
    found = []
    for gap in np.flatnonzero(np.diff(trajectory.stamps_s[placed]) > GAP_S):
        first, last = int(placed[gap]), int(placed[gap + 1])
        grown = np.diagonal(grown_covariances(trajectory, covariances, first, last), axis1=1, axis2=2)
        variances = np.column_stack([grown[:, 0] + grown[:, 1], grown[:, -1]]).clip(0.0)
        off_m2 = variances @ [1.0, lever_m**2]
        at = int(off_m2.argmax())
        if off_m2[at] > most_m**2:
            found.append((float(off_m2[at]), first, last, *np.sqrt(variances[at]).tolist()))
    if not found:
        return []
    _, first, last, position_m, turn_rad = max(found)
    from_s, to_s = trajectory.stamps_s[[first, last]] - trajectory.stamps_s[0]
    others = f", and {len(found) - 1} times more" if len(found) > 1 else ""
    return [
        f"No scan was placed from {from_s:.1f} to {to_s:.1f} s{others}: against what was before, poses are "
        f"uncertain by up to {position_m:.2f} m and {np.degrees(turn_rad):.1f} degrees (one sigma)"
    ]
