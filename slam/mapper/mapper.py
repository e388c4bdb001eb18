"""State of the main loop: measurements -> front end -> factors -> keyframe graph -> loops -> map."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from slam.config import Config
from slam.errors import DatasetError, GraphError
from slam.forked import Begun
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.pose_covariances import pose_covariances
from slam.graph.pose_graph import BatchResult
from slam.heap import end_stage, give_back
from slam.mapper.anchoring import Track
from slam.mapper.gnss import GnssAnchors
from slam.mapper.map_result import MapResult, apart, unseen
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.protocol import SENSORS, FrontEnd, Sensor, Tracked
from slam.mapper.scan_record import ScanRecorder
from slam.mapper.tags import PlaceAnchors
from slam.measurements import FloatArray, GnssFix
from slam.storage.map_contents import MapContents, SavedFactor, clock_sigma_s
from slam.trajectory.carried import (
    bridged_covariances,
    carried_covariances,
    late_covariances,
    unseen_covariances,
)


class Mapper:
    """State of a run: add measurements in log order, then finish.

    Parameters
    ----------
    front_end
        The part that tracks the robot and makes the map: `slam.mapper.lidar2d.PlanarRobot`,
        `slam.mapper.lidar3d.CloudLidar` or `slam.mapper.rgbd.FreeCamera`.
    """

    def __init__(self, config: Config, front_end: FrontEnd) -> None:
        self._config, self._front_end = config, front_end
        self._sensors: dict[type, Sensor] = {}
        self._graph: KeyframeGraph | None = None
        self._last: Tracked | None = None  # the newest image, matched and no keyframe
        self._record, self._gnss = ScanRecorder(), GnssAnchors()
        places = config.sensors.tags
        self._places = None if places is None else PlaceAnchors(places)
        self._keyframes_s = self._beside_s = 0.0

    @property
    def scan_count(self) -> int:
        """Number of scans, clouds or frames so far that have a pose."""
        return len(self._record)

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Wall time so far, by stage."""
        scans = float(self._record.finish().seconds.sum())
        return {
            "scans": scans - self._keyframes_s,
            "keyframes and loops": self._keyframes_s,
            "poses between the scans": self._beside_s,
        }

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Camera mountings that the log lacks and this run estimated."""
        return self._front_end.learned_mountings()

    def add(self, measurement: Any) -> None:
        """Process the next measurement; if the robot has moved far enough, add a keyframe and close loops."""
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
        self._last = None if tracked.new_keyframe or tracked.match is None else tracked
        if tracked.new_keyframe:
            before = time.perf_counter()
            self._add_keyframe(tracked)
            self._keyframes_s += time.perf_counter() - before
        self._record.add(tracked.stamp_s, tracked.motion, time.perf_counter() - started, tracked.match)

    def add_loop(self, candidate: LoopCandidate) -> None:
        """Add a loop candidate: to the graph if accepted, and always to the report."""
        self._keyframes.add_loop(candidate)

    def finish(self) -> MapResult:
        """Optimise everything, compute the pose of every reading, and make the map.

        Raises
        ------
        DatasetError
            If nothing could be mapped.
        """
        self._front_end.refuse()
        if len(self._keyframes) == 1 and self._last is not None:
            # Otherwise, nothing would show how well later scans were matched to it.
            self._add_keyframe(self._last)
        graph, front_end, readings = self._keyframes, self._front_end, self._front_end.readings
        clock = [time.perf_counter()]
        front_end.settle(graph)
        outcome = self._optimised(graph)
        track, edges = self._track(graph), graph.graph.edges
        clock.append(time.perf_counter())
        spread = Begun(lambda: pose_covariances(track.nodes, track.bases, edges, outcome.kept, self._config))
        if self._places is not None:
            self._places.check(graph, track, outcome, self._config)
        factors = zip(edges, outcome.kept.tolist(), strict=True)
        result = MapResult(
            MapContents(
                node_poses=list(track.nodes),
                stamps_s=track.stamps_s,
                readings=readings.keyframe_scans(),
                trajectory=track.readings,
                factors=[SavedFactor(edge, kept) for edge, kept in factors],
                loops=graph.loops,
                georeference=self._gnss.georeference,
                places=None if self._places is None else self._places.found,
            ),
            replace(self._record.finish(), stamps_s=readings.scan_stamps_s()),
            self.stage_seconds,
        )
        result.stage_seconds["final optimisation"] = clock[1] - clock[0]
        front_end.complete(result)
        clock.append(time.perf_counter())
        pieces = graph.pieces(outcome.kept, self._config.loops.reach_m)
        end_stage()
        of_keyframes = spread()
        give_back()
        covariances = self._covariances(result.map, *of_keyframes)
        result.map = replace(result.map, covariances=covariances)
        result.stage_seconds["map"] = clock[2] - clock[1] - result.stage_seconds.get("fusion", 0.0)
        result.stage_seconds["full trajectory"] = time.perf_counter() - clock[2]
        self._add_notes(result)
        result.warnings += apart(pieces, track.stamps_s - result.scans.stamps_s[0])
        known = readings.placed(), readings.fixed(self._config.graph.lost_sigma_m)
        result.warnings += unseen(result.map.trajectory, *known, covariances, self._config)
        return result

    def _optimised(self, graph: KeyframeGraph) -> BatchResult:
        """Optimise until no more loops are found, then align the map with the known positions."""
        probability = self._config.loops.inlier_probability
        outcome = graph.optimize(probability)
        if self._places is not None:
            outcome = self._places.join(self._front_end.tags, graph, self._track(graph), outcome, probability)
        # It terminates: nothing is found twice.
        while found := self._front_end.search_again(graph, outcome.kept):
            for candidate in found:
                graph.add_loop(candidate)
            outcome = graph.optimize(probability)
        if self._gnss:
            outcome = self._gnss.anchor(graph, self._track(graph), outcome, probability)
        if self._places is not None:
            outcome = self._places.survey(graph, self._track(graph), outcome, probability)
        return outcome

    def _track(self, graph: KeyframeGraph) -> Track:
        """Return the trajectory by the current graph."""
        readings, nodes = self._front_end.readings, graph.poses()
        bases = self._front_end.bases(nodes)
        stamps_s = readings.scan_stamps_s()[readings.keyframe_scans()]
        return Track.of(nodes, bases, stamps_s, readings.trajectory(bases))

    def _covariances(self, found: MapContents, *of_keyframes: FloatArray) -> FloatArray:
        """Return the covariance of every pose, from those of the keyframes."""
        readings, trajectory = self._front_end.readings, found.trajectory
        at = readings.keyframe_readings()
        covariances = carried_covariances(trajectory, at, *of_keyframes)
        dimension = covariances.shape[1]
        covariances += unseen_covariances(trajectory, readings.placed(), readings.wheels(), dimension)
        if readings.bridged:
            covariances += bridged_covariances(trajectory, readings.bridged)
        if sigma_s := clock_sigma_s(found):
            covariances += late_covariances(trajectory, int(at[0]), [(len(trajectory), sigma_s)], dimension)
        return covariances

    def _add_notes(self, result: MapResult) -> None:
        """Add notes of the sensors beside the front end for the user."""
        result.notes += [note for sensor in self._sensors.values() for note in sensor.notes()]
        result.notes += self._gnss.notes()
        if self._places is not None:
            result.notes += self._places.notes
            result.warnings += self._places.warnings
        if self._gnss.unused:
            result.unused[self._gnss.sensor] = self._gnss.unused

    @property
    def _keyframes(self) -> KeyframeGraph:
        """Return the graph, once there is a keyframe."""
        if self._graph is None:
            raise DatasetError("nothing in the log can be mapped; 'scanweave inspect' shows what it contains")
        return self._graph

    def _add_keyframe(self, tracked: Tracked) -> None:
        """Add the newest pose to the graph as a keyframe, and close loops."""
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
        """Return the edges that the sensors beside the front end add for a new keyframe."""
        edges = [edge for sensor in self._sensors.values() for edge in sensor.factors(key, stamp_s)]
        for edge in edges:
            if edge.kind in set(EdgeKind):
                raise GraphError(
                    f"a registered sensor's edge is called '{edge.kind}'; give it a name of its own"
                )
        return edges
