"""Restore a map of several sessions to its first sessions only."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from slam.config import Config
from slam.edits.edited_file import write_entries
from slam.edits.keyframes import bases_of
from slam.edits.remaking import graph_of, poses_of
from slam.graph.loop_candidate import judged
from slam.graph.pose_covariances import pose_covariances
from slam.mapper.map_result import drawn
from slam.outputs.finished_map import Map, load_map
from slam.sessions.joined_files import write_sessions
from slam.storage.map_clouds import MapClouds
from slam.storage.map_contents import MapContents, SavedFactor, parts_of
from slam.storage.map_edits import FRAME, AppliedEdits
from slam.storage.map_file import MAP_NAME, MapFile
from slam.storage.map_frames import MapFrames
from slam.storage.map_sessions import MapSession
from slam.trajectory.poses import Poses
from slam.trajectory.resettled import resettled


def write_first_sessions(saved: Map, count: int, path: Path) -> list[str]:
    """Write ``map.db`` of only the first sessions of a map; return a line on what is lost or not drawn.

    Raises
    ------
    ScanweaveError
        If a row is damaged, or the file cannot be written.
    """
    parts, sessions, warnings = saved.parts(), saved.sessions[:count], list[str]()
    nodes = sum(session.keyframes for session in sessions)

    def copied(file: MapFile) -> MapContents:
        contents = _alone(parts.base, nodes, sessions, parts.before)
        if parts.base.frames is not None:
            parts.base.frames.copy_to(file, most=nodes)
            contents = replace(contents, frames=MapFrames(file))
        if parts.base.clouds is not None:
            parts.base.clouds.copy_to(file, nodes)
            contents = replace(contents, clouds=MapClouds(file))
        contents, remarks = drawn(contents, parts.before)
        warnings.extend(remarks)
        return contents

    identity = replace(saved.identity, config=parts.before)
    entries = [_of_first(entry, nodes, parts.base) for entry in saved.contents.edits]
    kept = [entry for entry in entries if entry is not None]
    remarks = saved.notes, saved.warnings
    if not kept:
        write_sessions(path, identity, sessions, remarks, copied)
    else:
        with tempfile.TemporaryDirectory() as plain:
            write_sessions(Path(plain) / MAP_NAME, identity, sessions, remarks, copied)
            with load_map(plain) as contents:
                warnings += write_entries(contents.parts(), kept, path)
    if dropped := len(entries) - len(kept):
        warnings.append(f"{dropped} of {len(entries)} edits were of later sessions, and are gone with them")
    return warnings


def _alone(base: MapContents, nodes: int, sessions: Sequence[MapSession], config: Config) -> MapContents:
    """Return the first keyframes of a map, with their edges decided and solved again; nothing is drawn."""
    numbers = [n for n, loop in enumerate(base.loops) if max(loop.place, loop.keyframe) < nodes]
    renumbered = {before: now for now, before in enumerate(numbers)}
    edges = [
        replace(edge, loop=None if edge.loop is None else renumbered[edge.loop])
        for edge in (factor.edge for factor in base.factors)
        if max(edge.source, edge.target) < nodes
    ]
    graph = graph_of(base.node_poses[:nodes], edges)
    kept = graph.optimize(config.loops.inlier_probability).kept.tolist()
    poses = poses_of(graph)
    bases = bases_of(base, poses)
    path = base.trajectory[: sum(session.poses for session in sessions)]
    trajectory, covariances = resettled(
        path,
        base.stamps_s[:nodes],
        Poses.of(bases_of(base, base.node_poses[:nodes])),
        Poses.of(bases),
        parts_of(base, sessions),
        pose_covariances(poses, bases, edges, kept, config),
    )
    return replace(
        base,
        node_poses=poses,
        stamps_s=base.stamps_s[:nodes],
        readings=base.readings[:nodes],
        trajectory=trajectory,
        covariances=covariances,
        factors=[SavedFactor(edge, keep) for edge, keep in zip(edges, kept, strict=True)],
        loops=judged([base.loops[n] for n in numbers], edges, kept),
        measured_scans=base.measured_scans[:nodes],
        keyframe_scans=base.keyframe_scans[:nodes],
        edits=(),
    )


def _of_first(entry: AppliedEdits, nodes: int, base: MapContents) -> AppliedEdits | None:
    """Return an edit without its effect on later keyframes; None if it refers to such keyframes."""
    pairs = [*entry.forbidden, *entry.forced, *((loop.place, loop.keyframe) for loop in entry.added)]
    rows = [row for pair in pairs for row in pair]
    rows += [int(row) for region in entry.regions for row in region.keyframes]
    if any(row >= nodes for row in rows):
        return None

    def node(kind: str, number: int) -> int:
        return base.frames.head(number).node if kind == FRAME and base.frames else number

    erased = {(kind, n): bits for (kind, n), bits in entry.erased.items() if node(kind, n) < nodes}
    return replace(entry, erased=erased)
