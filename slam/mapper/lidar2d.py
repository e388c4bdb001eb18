"""Front end for a robot on a floor: matches a 2D lidar, with wheel odometry and cameras as support; SE(2)."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from slam.config import Config
from slam.forked import Begun
from slam.graph.edge import Edge
from slam.graph.keyframe_graph import KeyframeGraph, row_of
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.loop_closure import LoopCloser
from slam.graph.place_search import PlaceSearch
from slam.heap import end_stage
from slam.mapper.camera_keyframes import CameraKeyframes
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.keyframe_fusion import FusionSummary, KeyframeFusion
from slam.mapper.keyframe_store import registration_notes
from slam.mapper.lookahead import Ahead
from slam.mapper.map_result import MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.mapper.planar_odometry import Moment, PlanarOdometry, Step, Steps
from slam.mapper.protocol import FrontEnd, Tracked
from slam.mapping.keyframe_grid import lidar_grids
from slam.mapping.moving_things import MovingThings
from slam.matching.local_map import OrientedPoints
from slam.measurements import BoolArray, FloatArray, LaserScan, Pose, pose2_from_row
from slam.odometry import STANDARD, Odometries
from slam.spool import ArraySpool
from slam.vision.color_registration import ColorRegistration


class PlanarRobot(FrontEnd):
    """Front end for scans, wheels and cameras of a robot on a floor; see `slam.mapper.protocol.FrontEnd`.

    Parameters
    ----------
    ahead
        Process that tracks the scans of the same log ahead, see `slam.mapper.lookahead`.
    """

    def __init__(
        self,
        config: Config,
        checkpoint: Checkpoint | None = None,
        registrations: Mapping[str, ColorRegistration] | None = None,
        mountings: Mapping[str, LearnedMounting] | None = None,
        odometries: Odometries = STANDARD,
        ahead: Ahead | None = None,
    ) -> None:
        checkpoint, registrations = checkpoint or Checkpoint(), registrations or {}
        self._config, self._registrations = config, registrations
        self._odometry = PlanarOdometry(config, checkpoint, odometries, registrations, mountings)
        self._steps: Steps = self._odometry if ahead is None else ahead.followed_by(self._odometry)
        self.readings, self._cameras = self._odometry.readings, self._odometry.cameras
        self.tags = self._cameras.tags
        self._closer = LoopCloser(config.loops, config.match, checkpoint)
        self._places = PlaceSearch(self._closer, config.loops, config.match, config.graph, checkpoint)
        self._pictures = CameraKeyframes(config, checkpoint, registrations, self._cameras)
        self._fusion = KeyframeFusion(config.fusion) if config.fusion.enabled else None
        self._moving = MovingThings(config.scan.range_max_m)
        self._newest: Moment | None = None
        self._step: Step | None = None
        self._keyframe_scans: list[LaserScan | None] = []
        self._spool = ArraySpool()
        self._travelled_m = 0.0
        self._fused: FusionSummary | None = None
        # Poses (K, 3) of keyframes that may be final, and the process that draws the grids from them.
        self._grid_task: tuple[FloatArray, Begun | None] = np.zeros((0, 3)), None

    def observe(self, measurement: Any) -> Tracked | None:
        """Process the next measurement; return the tracked pose, if it gives one."""
        moment = self._steps.observe(measurement)
        if moment is None:
            return None
        if moment.motion is None:
            self._moving.lose()
        if moment.scan is not None:
            self._moving.add(moment.scan, moment.pose)
        self._newest = moment
        return Tracked(moment.stamp_s, moment.motion, moment.new_keyframe)

    def origin(self) -> Pose:
        """Return the origin of the map: the first pose of the robot."""
        return gtsam.Pose2()

    def step(self, key: int) -> tuple[Pose, Sequence[Edge]]:
        """Return the motion from the last keyframe to the newest pose, and its edges."""
        step_done = self._step = self._steps.step(key)
        self._travelled_m += float(np.hypot(step_done.step[0], step_done.step[1]))
        return pose2_from_row(step_done.step), step_done.edges

    def recognise(self, key: int, graph: KeyframeGraph) -> list[LoopCandidate]:
        """Store a keyframe, and try to close loops with places it may have returned to."""
        moment, step = self._newest, self._step
        assert moment is not None and step is not None
        surface = OrientedPoints(*map(self._spool.keep, (step.surface.points, step.surface.normals)))
        # The points seen are the first part of the surface: stored once.
        visible = surface.only(slice(step.seen))
        unmeasured = moment.motion is None
        self._closer.submaps.add(visible, moment.pose, self._travelled_m, surface, begun=unmeasured)
        self._keyframe_scans.append(moment.scan)
        self._moving.keep(moment.scan)
        if self._fusion is not None and moment.scan is not None:
            self._fusion.add(key, moment.scan, self._cameras.pictures(moment.stamp_s))
        self._cameras.look_for_tags()
        tried = self._closer.close(key, graph.rows(), graph.uncertainty)
        if pictures := self._cameras.placed_pictures(moment.stamp_s):
            self._pictures.add(key, moment.stamp_s, pictures, places=True)
            if moment.scan is None:
                tried += self._pictures.close(graph.poses())
        return tried

    def refuse(self) -> None:
        """Never raise an error: any scan gives a map."""

    def settle(self, graph: KeyframeGraph) -> None:
        """Recompute the steps of cameras and wheels with the clocks and mountings estimated in the run."""
        self._odometry.settle(graph)
        self._pictures.settle(graph, self.readings.scan_stamps_s()[self.readings.keyframe_scans()])

    def search_again(self, graph: KeyframeGraph, kept: BoolArray) -> list[LoopCandidate]:
        """Search all over the map; usually nothing is found, so that the grids may be drawn meanwhile."""
        rows, grid = graph.rows(), self._config.grid
        # The grids of a large map would take as much memory as everything else at that time.
        small = 64 * np.ptp(rows[:, :2], axis=0).prod() < grid.greatest_cells * grid.resolution_m**2
        if small and not len(self._grid_task[0]) and not self._cameras.cameras:
            poses, scans = np.array([row_of(pose) for pose in graph.poses()]), self._keyframe_scans
            self._grid_task = poses, Begun(lambda: lidar_grids(self._still, poses, self._config, scans))
        stamps_s = self.readings.scan_stamps_s()[self.readings.keyframe_scans()]
        loops = self._places.search(rows, stamps_s, graph.graph.edges, kept, graph.loops)
        if loops:
            self._grid_task = self._grid_task[0], None
        else:
            del self._places, self._closer, self._spool  # it was the last search: their data are large
            end_stage()
        return loops

    def complete(self, result: MapResult) -> None:
        """Add the repaired scans, and the grids drawn from scans and images."""
        started = time.perf_counter()
        result.notes += [*registration_notes(self._registrations), *self._cameras.notes()]
        self._odometry.add_notes(result)
        scans, result.fused = self._still, self._fused
        result.notes += [] if result.fused is None else [result.fused.note]
        result.stage_seconds["fusion"] = time.perf_counter() - started
        result.add_cameras(self._cameras.records(self._registrations), self._pictures.frames)
        result.map = replace(result.map, measured_scans=self._keyframe_scans, keyframe_scans=scans)
        poses, grids = self._grid_task
        result.draw(self._config, grids if np.array_equal(poses, result.map.keyframe_poses) else None)
        del self._grid_task
        result.warnings += self._cameras.warnings()
        result.unused |= dict.fromkeys(
            self._cameras.unplaced(), "its mounting on the robot is unknown; it only repaired scans"
        )

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Return camera mountings that the log lacks and this run estimated."""
        return self._cameras.learned_mountings()

    @cached_property
    def _still(self) -> list[LaserScan | None]:
        """Return the scans of the keyframes, repaired, without moving objects."""
        scans: Sequence[LaserScan | None] = self._keyframe_scans
        if self._fusion is not None:
            scans, self._fused = self._fusion.repair(scans)
        still = self._moving.taken_from(scans)
        del self._moving  # it holds much of a long log, and is not used any more
        return still
