"""Data of a finished map, in memory and loaded, and its rows in ``map.db``."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.showing import one_line
from slam.config import Config
from slam.earth import Georeference
from slam.errors import MapFileError
from slam.estimates import Trajectory
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import row_of
from slam.graph.loop_candidate import LoopCandidate
from slam.mapping.keyframe_grid import layers_of_grids
from slam.mapping.layered_map import DEPTH, OCCUPANCY, LayeredMap
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import FloatArray, LaserScan, Pose, spatial
from slam.storage.map_clouds import MapClouds
from slam.storage.map_edits import CLOUD, FRAME, AppliedEdits, erased_bits, read_edits
from slam.storage.map_facts import clock_sigma_of_file, georeference_of_file, ground_of_file
from slam.storage.map_file import MapFile
from slam.storage.map_frames import MapFrames
from slam.storage.map_parts import KeptScans, Unpack, read_grids, read_trajectory
from slam.storage.map_places import MapPlaces, places_of_file
from slam.storage.map_sessions import MapSession
from slam.storage.map_soundness import of, require, sound_name, sound_stamp, unsound_covariance
from slam.storage.map_tables import CAMERAS, COVARIANCES, FACTORS, FRAMES, GRIDS, KEYFRAMES, LOOPS, TRAJECTORY
from slam.storage.packing import Unpacker, pack, pack_small, unpack
from slam.storage.tum import of_upper_triangles, upper_triangles
from slam.vision.color_registration import ColorRegistration
from slam.vision.learned_camera import LearnedCamera

_STRETCH = 4096
_KINDS = frozenset(EdgeKind)
_Scans: TypeAlias = tuple[LaserScan | None, LaserScan | None]


@dataclass(frozen=True, slots=True)
class SavedFactor:
    """An edge of the graph, and whether the final optimisation kept it."""

    edge: Edge
    kept: bool


@dataclass(frozen=True)
class MapContents:
    """Data of a finished map, from a run or from a file.

    Attributes
    ----------
    node_poses
        ``T_map_base`` of the K nodes, Pose2 or in 3D Pose3; for a camera alone ``T_map_camera``.
    stamps_s, readings
        (K,) time of each node, and its number among the scans or frames of the log.
    trajectory
        The pose of every reading of the log.
    covariances
        (N, d, d) of the poses of the trajectory, see `Map.covariances`; None in a map of an older version.
    factors, loops
        The edges of the graph, and all loop candidates, accepted and rejected.
    measured_scans, keyframe_scans
        The sweep of each node as measured, and after the repair by the camera; None for a node without a
        sweep, and empty if there are no sweeps at all.
    cameras
        What the run learned about each camera, by name.
    frames, clouds
        Camera keyframes, and the clouds of the nodes; None if there are none. They are written during
        mapping, and read when they are needed.
    ground_m
        Height of the floor in the base frame of a robot in 3D; None for other robots, or if unknown.
    edits
        Edits of the map; they are already applied to all other fields.
    georeference
        Position of the map on the earth; None without a GNSS receiver.
    places
        Tags of the map, and its pose in the surveyor's frame; None if none were requested.
    clock_sigma_s
        Standard deviation of the common stamp error of clouds whose points have no times.
    """

    node_poses: Sequence[Pose]
    stamps_s: FloatArray
    readings: NDArray[np.int64]
    trajectory: Trajectory
    factors: Sequence[SavedFactor] = ()
    loops: Sequence[LoopCandidate] = ()
    measured_scans: Sequence[LaserScan | None] = ()
    keyframe_scans: Sequence[LaserScan | None] = ()
    grids: Mapping[str, OccupancyGrid] = field(default_factory=dict)
    cameras: Mapping[str, LearnedCamera] = field(default_factory=dict)
    frames: MapFrames | None = None
    clouds: MapClouds | None = None
    covariances: FloatArray | None = None
    ground_m: float | None = None
    edits: Sequence[AppliedEdits] = ()
    georeference: Georeference | None = None
    places: MapPlaces | None = None
    clock_sigma_s: float = 0.0

    __repr__ = one_line

    @property
    def planar(self) -> bool:
        """Whether the robot is on a floor. Otherwise the nodes are bases with clouds, or cameras."""
        return all(isinstance(pose, gtsam.Pose2) for pose in self.node_poses[:1])

    @cached_property
    def keyframe_poses(self) -> FloatArray:
        """(K, 3) x, y, yaw of the bases, map frame."""
        poses, T_base_camera = self.node_poses, None
        if self.frames is not None and not self.planar and self.clouds is None:
            T_base_camera = self.frames.head(0).T_base_camera
        if T_base_camera is not None:
            poses = [spatial(pose).compose(T_base_camera.inverse()) for pose in poses]
        return np.array([row_of(pose) for pose in poses])

    @cached_property
    def path_m(self) -> FloatArray:
        """(K,) path length on the floor from the first keyframe to each."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.keyframe_poses[:, :2], axis=0).T))])

    @property
    def grid(self) -> OccupancyGrid | None:
        """The lidar grid; None if there are only cameras, or if it could not be built."""
        return self.grids.get(OCCUPANCY)

    def layers(self, config: Config) -> LayeredMap | None:
        """The navigation map and its layers; None if there is no grid."""
        return layers_of_grids(self.grid, self.grids.get(DEPTH), config)

    def frame_poses(self) -> list[gtsam.Pose3]:
        """``T_map_camera`` of every camera keyframe."""
        return [] if self.frames is None else self.frames.poses(self.node_poses, self.clouds is not None)

    @property
    def T_base_lidar(self) -> gtsam.Pose3:
        """Pose of the origin of the rays in the clouds."""
        assert self.clouds is not None
        return self.clouds.T_base_lidar(len(self.clouds) - 1)

    def read_all(self) -> None:
        """Read all images and clouds.

        Raises
        ------
        MapFileError
            If one is damaged; the message names the first.
        """
        for index in range(len(self.frames or ())):
            assert self.frames
            self.frames.features(index)
            self.frames.frame(index)
        for key in range(len(self.clouds or ())):
            assert self.clouds
            self.clouds.points(key)
            self.clouds.T_base_lidar(key)

    @property
    def registrations(self) -> dict[str, ColorRegistration]:
        """Pose of colour cameras relative to their depth cameras, by name, if the run estimated them."""
        learned = {name: camera.registration for name, camera in self.cameras.items()}
        return {name: registration for name, registration in learned.items() if registration is not None}


def clock_sigma_s(contents: MapContents, nodes: slice = slice(None)) -> float:
    """Return the common stamp error (sigma) of all poses around some nodes.

    Without lidar scans on a floor, the stamps are those of the cameras, corrected by their clock offset to
    the wheels.
    """
    if not contents.planar:
        return contents.clock_sigma_s
    if any(scan is not None for scan in contents.measured_scans[nodes]):
        return 0.0
    # An offset is 0 where it is not known.
    known = [camera.clock_sigma_s for camera in contents.cameras.values() if camera.clock_offset_s]
    return max(known, default=0.0)


def parts_of(contents: MapContents, sessions: Sequence[MapSession]) -> list[tuple[int, int, float]]:
    """Return keyframes, poses and `clock_sigma_s` of the first sessions of a map."""
    ends = itertools.accumulate(session.keyframes for session in sessions)
    return [
        (session.keyframes, session.poses, clock_sigma_s(contents, slice(end - session.keyframes, end)))
        for session, end in zip(sessions, ends, strict=True)
    ]


def write_contents(file: MapFile, contents: MapContents) -> None:
    """Write the data of a finished map, except frames and clouds.

    Raises
    ------
    MapFileError
        If the file cannot be written.
    """
    for table in (KEYFRAMES, FACTORS, LOOPS, TRAJECTORY, COVARIANCES, GRIDS, CAMERAS):
        file.clear(table)  # an interrupt may have come during writing
    for node, pose in enumerate(contents.node_poses):
        scan = contents.keyframe_scans[node] if contents.keyframe_scans else None
        measured = contents.measured_scans[node] if contents.measured_scans else None
        file.append(
            KEYFRAMES,
            float(contents.stamps_s[node]),
            int(contents.readings[node]),
            pack(pose),
            None if measured is None else pack_small(measured),
            None if scan is measured or scan is None else pack_small(scan),
        )
    for factor in contents.factors:
        edge = factor.edge
        ends = (edge.source, edge.target, int(edge.trusted), int(factor.kept), edge.loop)
        file.append(FACTORS, str(edge.kind), *ends, pack(edge.T_source_target), pack(edge.covariance))
    for loop in contents.loops:
        verdict = (loop.place, loop.keyframe, int(loop.accepted))
        file.append(LOOPS, *verdict, float(loop.score), loop.reason, pack(loop))
    trajectory = contents.trajectory
    for first in range(0, len(trajectory), _STRETCH):
        stretch = trajectory[first : first + _STRETCH]
        file.append(TRAJECTORY, len(stretch), pack_small(stretch))
        if contents.covariances is not None:
            triangles = upper_triangles(contents.covariances[first : first + _STRETCH])
            file.append(COVARIANCES, len(stretch), pack_small(triangles))
    for name, grid in contents.grids.items():
        corner, cells = pack(grid.T_map_grid), pack_small(np.ascontiguousarray(grid.steps))
        file.append(GRIDS, name, *grid.shape, grid.resolution_m, corner, cells)
    for name, learned in contents.cameras.items():
        file.append(CAMERAS, name, pack(learned))


def read_contents(file: MapFile) -> MapContents:
    """Read the data of a map; frames and clouds are read later.

    Raises
    ------
    MapFileError
        If a row is damaged, or does not fit the others.
    """
    edits = read_edits(file)
    frames, clouds = (
        MapFrames(file, erased=erased_bits(edits, FRAME)),
        MapClouds(file, erased=erased_bits(edits, CLOUD)),
    )
    small = Unpacker(file.size)
    keyframes = list[tuple[float, int, Pose]]()

    def scans() -> Iterator[_Scans]:
        for stamp_s, reading, pose, pair in file.parsed(KEYFRAMES, lambda row: _keyframe(row, small)):
            keyframes.append((stamp_s, reading, pose))
            yield pair

    # 2D scans of clouds are large: they are read on demand.
    pairs: Sequence[Any] = KeptScans.on_disk(scans()) if len(clouds) else list(scans())
    if not keyframes:
        raise MapFileError(f"{file.path} holds no keyframe; make the map anew")
    poses = [keyframe[2] for keyframe in keyframes]
    planar = isinstance(poses[0], gtsam.Pose2)
    if not all(isinstance(pose, gtsam.Pose2) is planar for pose in poses):
        raise MapFileError(f"{file.path} holds keyframes on a floor and in 3D; make the map anew")
    loops = list(file.parsed(LOOPS, lambda row: _loop(row, len(poses))))
    trajectory, grids = read_trajectory(file, small), read_grids(file, small)
    factors = list(file.parsed(FACTORS, lambda row: _factor(row, poses, len(loops))))
    wrong = unsound_covariance([factor.edge.covariance for factor in factors], 3 if planar else 6)
    with file.naming_row(FACTORS, wrong or 0):
        require(wrong is None, "its covariance is not finite, symmetric and positive definite")
    return MapContents(
        node_poses=poses,
        stamps_s=np.array([keyframe[0] for keyframe in keyframes]),
        readings=np.array([keyframe[1] for keyframe in keyframes], dtype=np.int64),
        measured_scans=_each(pairs, lambda pair: pair[0]),
        keyframe_scans=_each(pairs, lambda pair: pair[0] if pair[1] is None else pair[1]),
        factors=factors,
        loops=loops,
        trajectory=trajectory,
        covariances=_covariances(file, len(trajectory), 3 if planar else 6, small),
        grids=grids,
        cameras=dict(file.parsed(CAMERAS, _camera)),
        frames=frames if len(frames) else None,
        clouds=clouds if len(clouds) else None,
        ground_m=ground_of_file(file),
        edits=edits,
        georeference=georeference_of_file(file, poses[0]),
        places=places_of_file(file, poses),
        clock_sigma_s=clock_sigma_of_file(file),
    )


def refuse_misfits(file: MapFile, contents: MapContents) -> None:
    """Check that frames and clouds fit the nodes; raises `MapFileError` as `read_contents`."""
    frames, clouds, nodes = contents.frames, contents.clouds, contents.node_poses
    in_space = sum(isinstance(pose, gtsam.Pose3) for pose in nodes)
    if clouds is not None and not len(clouds) == len(nodes) == in_space:
        counts = f"{len(clouds)} clouds for {len(nodes)} nodes, {in_space} of them in space"
        raise MapFileError(f"{file.path} holds {counts}; make the map anew")
    for index in range(len(frames) if frames else 0):
        assert frames
        with file.naming_row(FRAMES, index):
            head = frames.head(index)
            if not 0 <= head.node < len(nodes):
                raise MapFileError("it belongs to no node")
            if clouds is not None and head.T_base_camera is None:
                raise MapFileError("it has no pose of the camera on the robot")


def _each(pairs: Sequence[Any], of_pair: Callable[[_Scans], LaserScan | None]) -> Sequence[LaserScan | None]:
    """Return one scan of each pair, read on demand like the pairs."""
    if isinstance(pairs, KeptScans):
        return KeptScans(len(pairs), lambda key: of_pair(pairs[key]))
    return [of_pair(pair) for pair in pairs]


def _keyframe(row: tuple[Any, ...], small: Unpack) -> tuple[float, int, Pose, _Scans]:
    """Parse stamp, reading, pose, scan as measured and, if repaired, as repaired."""
    stamp_s, reading, pose, *scans = row
    node_pose = unpack(pose)
    node_pose = node_pose if isinstance(node_pose, gtsam.Pose2) else of(gtsam.Pose3, node_pose)
    measured, repaired = (None if scan is None else of(LaserScan, small(scan)) for scan in scans)
    return sound_stamp(stamp_s), reading, node_pose, (measured, repaired)


def _loop(row: tuple[Any, ...], nodes: int) -> LoopCandidate:
    """Parse a row of the loop candidates."""
    loop = of(LoopCandidate, unpack(row[5]))
    require(loop.place < nodes and loop.keyframe < nodes, "its ends are no nodes")
    require(row[:3] == (loop.place, loop.keyframe, int(loop.accepted)), "its columns contradict it")
    require(loop.motion is not None or not loop.accepted, "it was accepted without a match")
    return loop


def _factor(row: tuple[Any, ...], poses: Sequence[Pose], loops: int) -> SavedFactor:
    """Parse a row of the factors."""
    kind, source, target, trusted, kept, loop, motion, covariance = row
    require(0 <= source < len(poses) and 0 <= target < len(poses), "its ends are no nodes")
    require(loop is None or 0 <= loop < loops, "its loop is none")
    measured = of(type(poses[0]), unpack(motion))
    spread = of(np.ndarray, unpack(covariance))
    return SavedFactor(Edge(source, target, measured, spread, _kind(kind), bool(trusted), loop), bool(kept))


def _kind(name: str) -> str:
    """Parse the kind of an edge."""
    require(name, "its kind is no name")
    sound_name(name)
    return EdgeKind(name) if name in _KINDS else name


def _covariances(file: MapFile, poses: int, dimension: int, small: Unpack) -> FloatArray | None:
    """Read the covariances of the trajectory; None if the map has none."""
    rows = list(file.parsed(COVARIANCES, lambda row: _triangles(row, dimension, small)))
    if not rows:
        return None
    triangles = np.concatenate(rows)
    if len(triangles) != poses:
        raise MapFileError(f"{file.path} holds {len(triangles)} covariances for {poses} poses; make it anew")
    return of_upper_triangles(triangles)


def _triangles(row: tuple[Any, ...], dimension: int, small: Unpack) -> FloatArray:
    """Parse a row of the covariances, (n, 6) or (n, 21) upper triangles."""
    triangles = of(np.ndarray, small(row[1]))
    shape = (row[0], dimension * (dimension + 1) // 2)
    require(triangles.shape == shape and triangles.dtype == np.float64, "its triangles have another size")
    wrong = unsound_covariance(list(of_upper_triangles(triangles)), dimension)
    require(wrong is None, f"covariance {wrong} is not finite, symmetric and positive definite")
    return triangles


def _camera(row: tuple[Any, ...]) -> tuple[str, LearnedCamera]:
    """Parse a row of estimated camera data, with the camera's name."""
    name, learned = row
    camera = of(LearnedCamera, unpack(learned))
    return sound_name(name), camera
