"""Join the graphs of a map and of a session, and optimise them together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.config import Config
from slam.edits.keyframes import bases_of
from slam.edits.remaking import graph_of, poses_of
from slam.estimates import one_after_another
from slam.graph.keyframe_graph import row_of
from slam.graph.loop_candidate import LoopCandidate, judged
from slam.graph.pose_covariances import pose_covariances
from slam.localization.poses import separation
from slam.mapping.keyframe_grid import lidar_grids
from slam.measurements import Pose, composed
from slam.outputs.finished_map import Map
from slam.sessions.placing import Placing
from slam.storage.map_contents import MapContents, SavedFactor, parts_of
from slam.trajectory.poses import Poses
from slam.trajectory.resettled import resettled


@dataclass(frozen=True, slots=True)
class JoinedMap:
    """A map and a session in one frame, that of the map.

    Attributes
    ----------
    contents
        Nodes, factors, loops and trajectory of the map, then those of the session, then the loops between
        them.
    loops_between
        Number of loops between the two that their matches accepted.
    loops_kept
        Number of these loops that the optimisation kept.
    moved_m
        Largest movement of the map's own keyframes.
    """

    contents: MapContents
    loops_between: int
    loops_kept: int
    moved_m: float


def join(
    known_map: Map, session_map: Map, placing: Placing, between_them: Sequence[LoopCandidate], config: Config
) -> JoinedMap:
    """Join two maps of the same kind by loops between them.

    All untrusted edges are decided again: one session may decide what the other could not.

    Parameters
    ----------
    placing
        Pose of the session in the map.
    between_them
        Loop candidates, ``keyframe`` numbered after those of the map.

    Raises
    ------
    ScanweaveError
        If the grid would have too many cells.
    """
    known, session = known_map.contents, session_map.contents
    nodes = len(known.node_poses)
    factors = [*known.factors, *_renumbered(session, nodes, len(known.loops))]
    numbered = (replace(one, place=one.place + nodes, keyframe=one.keyframe + nodes) for one in session.loops)
    loops = [*known.loops, *numbered]
    own_loops = len(loops)
    for loop in between_them:
        if loop.accepted and loop.motion is not None:
            factors.append(SavedFactor(loop.edge(len(loops)), True))
        loops.append(loop)
    kept, after = _optimised(known, session, placing, factors, config)
    loops = judged(loops, (factor.edge for factor in factors), kept)
    factors = [replace(factor, kept=bool(keep)) for factor, keep in zip(factors, kept, strict=True)]
    joined = [factor for factor in factors if factor.edge.loop is not None and factor.edge.loop >= own_loops]
    scans = [*known.keyframe_scans, *session.keyframe_scans]
    measured = [*known.measured_scans, *session.measured_scans]
    before = [base for one in (known, session) for base in bases_of(one, one.node_poses)]
    bases = [*bases_of(known, after[:nodes]), *bases_of(session, after[nodes:])]
    node_covariances = pose_covariances(after, bases, [factor.edge for factor in factors], kept, config)
    maps = (known_map, session_map)
    trajectory, covariances = resettled(
        one_after_another([one.trajectory for one in maps]),
        np.concatenate([one.contents.stamps_s for one in maps]),
        Poses.of(before),
        Poses.of(bases),
        [part for one in maps for part in parts_of(one.contents, one.sessions)],
        node_covariances,
    )
    return JoinedMap(
        MapContents(
            node_poses=after,
            stamps_s=np.concatenate([known.stamps_s, session.stamps_s]),
            readings=np.concatenate([known.readings, session.readings]),
            measured_scans=measured,
            keyframe_scans=scans,
            factors=factors,
            loops=loops,
            trajectory=trajectory,
            covariances=covariances,
            grids=lidar_grids(scans, np.array([row_of(base) for base in bases]), config, measured),
            cameras={**session.cameras, **known.cameras},
            ground_m=known.ground_m,
            clock_sigma_s=max(known.clock_sigma_s, session.clock_sigma_s),
        ),
        loops_between=len(joined),
        loops_kept=sum(factor.kept for factor in joined),
        moved_m=max(separation(one, other)[0] for one, other in zip(before[:nodes], bases, strict=False)),
    )


def _optimised(
    known: MapContents, session: MapContents, placing: Placing, factors: Sequence[SavedFactor], config: Config
) -> tuple[list[bool], list[Pose]]:
    """Return which factors are kept, and the poses of all nodes."""
    own = bases_of(session, session.node_poses)
    T_map_session, _ = placing.nearest(own[len(own) // 2], own)
    placed = [composed(T_map_session, pose) for pose in session.node_poses]
    graph = graph_of([*known.node_poses, *placed], [factor.edge for factor in factors])
    outcome = graph.optimize(config.loops.inlier_probability)
    return outcome.kept.tolist(), poses_of(graph)


def _renumbered(session: MapContents, nodes: int, loops: int) -> list[SavedFactor]:
    """Return the factors of a session, with its nodes and loops numbered after others."""
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
