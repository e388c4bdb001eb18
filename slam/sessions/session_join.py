"""The graphs of a map and of a session as one, optimised together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.config import Config
from slam.graph.loop_closure import LoopCandidate, judged
from slam.graph.pose_covariances import pose_covariances
from slam.graph.pose_graph import PoseGraph
from slam.mapping.keyframe_grid import lidar_grids
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, Trajectory, pose2_from_row, row_from_pose2
from slam.outputs.finished_map import Map
from slam.sessions.placing import Placing
from slam.storage.map_contents import MapContents, SavedFactor
from slam.trajectory.carried import carried_covariances
from slam.trajectory.poses import Poses
from slam.trajectory.spread import spread_correction

Indices: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class JoinedMap:
    """A map and a session in one frame, that of the map.

    Attributes
    ----------
    contents
        Nodes, factors, loops and trajectory of the map, then those of the session, then the loops between
        them.
    loops_between
        How many loops between the two were accepted by their matches.
    loops_kept
        How many of them the optimisation has kept.
    moved_m
        How far the map's own keyframes have moved at most.
    """

    contents: MapContents
    loops_between: int
    loops_kept: int
    moved_m: float


def join(
    known_map: Map,
    session_map: Map,
    placing: Placing,
    between_them: Sequence[LoopCandidate],
    config: Config,
) -> JoinedMap:
    """Join two planar maps by loops between them.

    Every edge that may be refused is judged anew: what one session could not decide the other may.

    Parameters
    ----------
    placing
        Where the session lies in the map.
    between_them
        Loop candidates, ``keyframe`` numbered after those of the map.

    Raises
    ------
    ScanweaveError
        Where the grid would have too many cells.
    """
    known, session = known_map.contents, session_map.contents
    nodes = len(known.node_poses)
    factors = [*known.factors, *_renumbered(session, nodes, len(known.loops))]
    loops = [*known.loops, *(_shifted(loop, nodes) for loop in session.loops)]
    own_loops = len(loops)
    for loop in between_them:
        if loop.accepted and loop.motion is not None:
            factors.append(SavedFactor(loop.edge(len(loops)), True))
        loops.append(loop)
    kept, poses = _optimised(known, session, placing, factors, config)
    loops = judged(loops, (factor.edge for factor in factors), kept)
    factors = [replace(factor, kept=bool(keep)) for factor, keep in zip(factors, kept, strict=True)]
    joined = [factor for factor in factors if factor.edge.loop is not None and factor.edge.loop >= own_loops]
    scans = [*known.keyframe_scans, *session.keyframe_scans]
    before, nodes_after = known.keyframe_poses, [pose2_from_row(pose) for pose in poses]
    told = pose_covariances(nodes_after, nodes_after, [factor.edge for factor in factors], kept, config)
    trajectory, covariances = _joined_trajectory((known_map, session_map), poses, *told)
    return JoinedMap(
        MapContents(
            node_poses=nodes_after,
            stamps_s=np.concatenate([known.stamps_s, session.stamps_s]),
            readings=np.concatenate([known.readings, session.readings]),
            measured_scans=[*known.measured_scans, *session.measured_scans],
            keyframe_scans=scans,
            factors=factors,
            loops=loops,
            trajectory=trajectory,
            covariances=covariances,
            grids=lidar_grids(scans, poses, config),
            cameras={**session.cameras, **known.cameras},
        ),
        loops_between=len(joined),
        loops_kept=sum(factor.kept for factor in joined),
        moved_m=float(np.hypot(*(poses[:nodes, :2] - before[:, :2]).T).max()),
    )


def _optimised(
    known: MapContents,
    session: MapContents,
    placing: Placing,
    factors: Sequence[SavedFactor],
    config: Config,
) -> tuple[list[bool], FloatArray]:
    """Which factors hold, and (n, 3) poses of all nodes."""
    graph = PoseGraph(known.node_poses[0])
    for pose in known.node_poses[1:]:
        graph.add_node(pose)
    own = session.keyframe_poses
    T_map_session, _ = placing.nearest(own[len(own) // 2], own)
    for row in own:
        graph.add_node(pose2_from_row(compose(T_map_session, row)))
    for factor in factors:
        graph.add_edge(factor.edge)
    outcome = graph.optimize(config.loops.inlier_probability)
    return outcome.kept.tolist(), np.array([row_from_pose2(graph.pose(n)) for n in range(len(graph))])


def _renumbered(session: MapContents, nodes: int, loops: int) -> list[SavedFactor]:
    """The factors of a session, its nodes and loops numbered after others."""
    return [
        replace(
            factor,
            edge=replace(
                factor.edge,
                source=factor.edge.source + nodes,
                target=factor.edge.target + nodes,
                loop=None if factor.edge.loop is None else factor.edge.loop + loops,
            ),
        )
        for factor in session.factors
    ]


def _shifted(loop: LoopCandidate, nodes: int) -> LoopCandidate:
    """A loop candidate, its nodes numbered after others."""
    return replace(loop, place=loop.place + nodes, keyframe=loop.keyframe + nodes)


def _joined_trajectory(
    maps: Sequence[Map], poses: FloatArray, covariances: FloatArray, steps: FloatArray
) -> tuple[Trajectory, FloatArray]:
    """The trajectories of all sessions and their covariances, each carried along with its keyframes."""
    stamps_s = np.concatenate([one.trajectory.stamps_s for one in maps])
    planar = np.concatenate([one.trajectory.to_planar() for one in maps])
    before = np.concatenate([one.keyframe_poses for one in maps])
    keyframe_stamps_s = np.concatenate([one.contents.stamps_s for one in maps])
    carried, uncertain, first, node = [], [], 0, 0
    # One session at a time: their clocks may overlap.
    for session in (session for one in maps for session in one.sessions):
        part, nodes = slice(first, first + session.poses), slice(node, node + session.keyframes)
        first, node = part.stop, nodes.stop
        readings, kept = _readings_of(keyframe_stamps_s[nodes], stamps_s[part])
        corrections = zip(poses[nodes][kept], before[nodes][kept], planar[part][readings], strict=True)
        corrected = [compose(after, between(old, reading)) for after, old, reading in corrections]
        motion, anchors = Poses.planar(planar[part]), Poses.planar(np.array(corrected))
        trajectory = spread_correction(motion, readings, anchors).trajectory(stamps_s[part])
        # Where a keyframe is passed over, the steps to it and from it are one.
        ways = steps[nodes.start : nodes.stop - 1]
        ways = np.add.reduceat(ways[: kept[-1]], kept[:-1]) if len(kept) > 1 else ways[:0]
        uncertain.append(carried_covariances(trajectory, readings, covariances[nodes][kept], ways))
        carried.append(trajectory.to_planar())
    return Trajectory.from_planar(stamps_s, np.concatenate(carried)), np.concatenate(uncertain)


def _readings_of(keyframes_s: FloatArray, stamps_s: FloatArray) -> tuple[Indices, Indices]:
    """The reading of each keyframe in the order of the log, and which keyframes these are.

    A log whose clock was set back has stamps twice: a keyframe that would go back is passed over.
    """
    order = np.argsort(stamps_s, kind="stable")
    nearest = np.clip(np.searchsorted(stamps_s[order], keyframes_s), 0, len(stamps_s) - 1)
    readings = order[nearest]
    last = np.concatenate([[-1], np.maximum.accumulate(readings)[:-1]])
    kept = np.flatnonzero((stamps_s[readings] == keyframes_s) & (readings > last))
    return readings[kept], kept
