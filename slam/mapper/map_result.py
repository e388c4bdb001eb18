"""What a run hands on when it is done."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.graph.loop_closure import LoopCandidate
from slam.graph.pose_graph import PoseGraph
from slam.mapper.keyframe_fusion import FusionSummary
from slam.mapper.scan_record import CameraRecord, ScanRecord
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import BoolArray, FloatArray, LaserScan, RgbdFrame, Trajectory


@dataclass(frozen=True, slots=True)
class DenseKeyframes:
    """Camera keyframes, which can be iterated again and again, and their optimised ``T_map_camera``."""

    frames: Iterable[RgbdFrame]
    poses: Sequence[gtsam.Pose3]


@dataclass(frozen=True, slots=True)
class MappedClouds:
    """Points of the keyframes of a 3D lidar, base frame, which can be iterated again and again.

    Attributes
    ----------
    clouds
        (N, 3) each.
    poses
        Their optimised ``T_map_base``.
    T_base_lidar
        Where their rays begin.
    ground_m
        Height of the floor in the base frame.
    """

    clouds: Iterable[FloatArray]
    poses: Sequence[gtsam.Pose3]
    T_base_lidar: gtsam.Pose3
    ground_m: float = 0.0


@dataclass(frozen=True, slots=True)
class MapResult:
    """A finished map.

    Attributes
    ----------
    trajectory
        A pose for every reading of the log.
    keyframe_poses
        (K, 3) optimised x, y, yaw, map frame.
    keyframe_scans
        The sweep of each keyframe, repaired where the fusion could; None where a camera carried the robot on.
    measured_scans
        The same as they were measured; empty where a camera alone made the map.
    graph
        All edges with their provenance.
    loops
        Every loop candidate with its verdict.
    scans
        Scores and timings of every scan, or of every frame where a camera alone made the map.
    keyframe_numbers
        (K,) scan number of each keyframe.
    edges_kept
        (E,) False where the final optimisation refused an edge of the graph.
    grid
        The occupancy grid; None where it could not be built, ``warnings`` then says why.
    stage_seconds
        Wall time by stage.
    warnings
        One line each, for people.
    notes
        What was found out on the way, one line each: mountings, registrations, the fusion.
    fused
        What scans and depth images repaired of each other; None where there were not both.
    dense
        Camera keyframes for a coloured map; None where there is no camera.
    cameras
        What became of every camera's frames, by its name.
    clouds
        Keyframes of a 3D lidar; None where there is none.
    """

    trajectory: Trajectory
    keyframe_poses: FloatArray
    keyframe_numbers: NDArray[np.int64]
    keyframe_scans: list[LaserScan | None]
    graph: PoseGraph
    edges_kept: BoolArray
    loops: list[LoopCandidate]
    scans: ScanRecord
    grid: OccupancyGrid | None
    stage_seconds: dict[str, float]
    warnings: list[str]
    notes: list[str] = field(default_factory=list)
    dense: DenseKeyframes | None = None
    fused: FusionSummary | None = None
    cameras: Mapping[str, CameraRecord] = field(default_factory=dict)
    measured_scans: list[LaserScan | None] = field(default_factory=list)
    clouds: MappedClouds | None = None
