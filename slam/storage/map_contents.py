"""What a finished map consists of besides its camera keyframes, and its rows in ``map.db``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from slam.errors import MapFileError
from slam.graph.loop_closure import LoopCandidate
from slam.graph.pose_graph import Edge, EdgeKind
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import FloatArray, LaserScan, Pose, Trajectory
from slam.storage.map_file import MapFile
from slam.storage.map_tables import FACTORS, GRIDS, KEYFRAMES, LOOPS, TRAJECTORY
from slam.storage.packing import pack, pack_small, unpack, unpack_small

# The grid of the lidar; others are layers.
OCCUPANCY = "occupancy"
_STRETCH = 4096


@dataclass(frozen=True, slots=True)
class SavedFactor:
    """An edge of the graph, whether the final optimisation kept it, and the number of its loop candidate."""

    edge: Edge
    kept: bool
    loop: int | None = None


@dataclass(frozen=True, slots=True)
class MapContents:
    """What is written when a map is finished; camera keyframes are written while it is made.

    Attributes
    ----------
    node_poses
        ``T_map_base`` of the K nodes, Pose2; in space ``T_map_camera``, Pose3.
    stamps_s, readings
        (K,) time of each, and its number among the scans or frames of the log.
    measured_scans, scans
        The sweep of each as measured, and as the camera has repaired it; None where there is none.
    factors, loops
        The graph's edges, and every loop candidate with its verdict.
    trajectory
        A pose for every reading of the log.
    grids
        By name.
    """

    node_poses: Sequence[Pose]
    stamps_s: FloatArray
    readings: NDArray[np.int64]
    measured_scans: Sequence[LaserScan | None]
    scans: Sequence[LaserScan | None]
    factors: Sequence[SavedFactor]
    loops: Sequence[LoopCandidate]
    trajectory: Trajectory
    grids: Mapping[str, OccupancyGrid]


def write_contents(file: MapFile, contents: MapContents) -> None:
    """Write what is known when a map is finished.

    Raises
    ------
    MapFileError
        Where the file cannot be written.
    """
    for node, pose in enumerate(contents.node_poses):
        scan = contents.scans[node] if contents.scans else None
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
        ends = (edge.source, edge.target, int(edge.trusted), int(factor.kept), factor.loop)
        file.append(FACTORS, edge.kind.value, *ends, pack(edge.T_source_target), pack(edge.covariance))
    for loop in contents.loops:
        verdict = (loop.place, loop.keyframe, int(loop.accepted))
        file.append(LOOPS, *verdict, float(loop.score), loop.reason, pack(loop))
    for first in range(0, len(contents.trajectory), _STRETCH):
        part = slice(first, first + _STRETCH)
        whole = contents.trajectory
        stretch = Trajectory(whole.stamps_s[part], whole.positions_m[part], whole.quaternions_xyzw[part])
        file.append(TRAJECTORY, len(stretch), pack_small(stretch))
    for name, grid in contents.grids.items():
        rows, cols = grid.log_odds.shape
        corner, cells = pack(grid.T_map_grid), pack_small(np.ascontiguousarray(grid.log_odds))
        file.append(GRIDS, name, rows, cols, grid.resolution_m, corner, cells)


def read_contents(file: MapFile) -> MapContents:
    """Everything but the camera keyframes.

    Raises
    ------
    MapFileError
        Where a row is damaged.
    """
    keyframes = [_read_keyframe(file, row, number) for number, row in enumerate(file.rows(KEYFRAMES))]
    if not keyframes:
        raise MapFileError(f"{file.path} holds no keyframe; make the map anew")
    loops = []
    for number, row in enumerate(file.rows(LOOPS)):
        with file.blaming(LOOPS, number):
            loops.append(unpack(cast(bytes, row[5])))
    factors = []
    for number, row in enumerate(file.rows(FACTORS)):
        with file.blaming(FACTORS, number):
            factors.append(_factor(row))
    stretches = []
    for number, row in enumerate(file.rows(TRAJECTORY)):
        with file.blaming(TRAJECTORY, number):
            stretches.append(unpack_small(cast(bytes, row[1])))
    grids = {}
    for number, row in enumerate(file.rows(GRIDS)):
        with file.blaming(GRIDS, number):
            corner, cells = unpack(cast(bytes, row[4])), unpack_small(cast(bytes, row[5]))
            grids[str(row[0])] = OccupancyGrid(cells, float(cast(float, row[3])), corner)
    return MapContents(
        node_poses=[keyframe[2] for keyframe in keyframes],
        stamps_s=np.array([keyframe[0] for keyframe in keyframes]),
        readings=np.array([keyframe[1] for keyframe in keyframes], dtype=np.int64),
        measured_scans=[keyframe[3] for keyframe in keyframes],
        scans=[keyframe[4] for keyframe in keyframes],
        factors=factors,
        loops=loops,
        trajectory=Trajectory(
            np.concatenate([part.stamps_s for part in stretches]),
            np.concatenate([part.positions_m for part in stretches]),
            np.concatenate([part.quaternions_xyzw for part in stretches]),
        ),
        grids=grids,
    )


def _read_keyframe(
    file: MapFile, row: tuple[object, ...], number: int
) -> tuple[float, int, Pose, LaserScan | None, LaserScan | None]:
    """Stamp, reading, pose, scan as measured and as repaired."""
    stamp_s, reading, pose, measured, repaired = row
    with file.blaming(KEYFRAMES, number):
        scan = None if measured is None else unpack_small(cast(bytes, measured))
        mended = scan if repaired is None else unpack_small(cast(bytes, repaired))
        return cast(float, stamp_s), cast(int, reading), unpack(cast(bytes, pose)), scan, mended


def _factor(row: tuple[object, ...]) -> SavedFactor:
    """A row of the factors."""
    kind, source, target, trusted, kept, loop, motion, covariance = row
    edge = Edge(
        cast(int, source),
        cast(int, target),
        unpack(cast(bytes, motion)),
        unpack(cast(bytes, covariance)),
        EdgeKind(str(kind)),
        bool(trusted),
    )
    return SavedFactor(edge, bool(kept), cast("int | None", loop))
