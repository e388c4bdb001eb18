"""Restore a map of several sessions to its first sessions only."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from slam.config import Config
from slam.edits.edited_file import write_entries
from slam.edits.remaking import graph_of, poses_of, with_nodes
from slam.errors import MapFileError
from slam.graph.loop_candidate import judged
from slam.mapper.map_result import drawn
from slam.outputs.finished_map import Map, load_map, made_anew
from slam.sessions.joined_files import write_sessions
from slam.storage.map_clouds import MapClouds
from slam.storage.map_contents import MapContents, SavedFactor
from slam.storage.map_edits import FRAME, AppliedEdits
from slam.storage.map_file import MAP_NAME, MapFile
from slam.storage.map_frames import MapFrames
from slam.storage.map_sessions import MapSession


def roll_back(saved: Map | Path | str, sessions: int, *, out: Path | str | None = None) -> Map:
    """Return the map with only its first sessions; the given map stays open and unchanged.

    Parameters
    ----------
    saved
        The map, or its path.
    sessions
        Number of sessions to keep.
    out
        Folder for the map, possibly that of the given map; None keeps it in a temporary folder.

    Raises
    ------
    ScanweaveError
        If the map does not have more sessions than that, or a file is faulty; the map is then unchanged.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> logs = [write_synthetic_log(f"log{n}", seed=n, duration_s=10.0).log_path for n in (1, 2)]
    >>> house = slam.map_log(logs[0], out="house")
    >>> both = slam.join(house, logs[1], out="both").map
    >>> first = slam.roll_back(both, 1)
    >>> len(first.sessions), bool((first.grid.steps == house.grid.steps).all())
    (1, True)
    """
    saved = saved if isinstance(saved, Map) else load_map(saved)
    before = len(saved.sessions)
    if sessions not in range(1, before):
        if before < 2:
            raise MapFileError(f"{saved.path} has only one session: there is none to remove")
        raise MapFileError(
            f"{saved.path} has {before} sessions; of these 1 to {before - 1} can stay, not {sessions}"
        )
    remaining = made_anew(saved, lambda path: _write_first_sessions(saved, sessions, path), out)
    if out is not None:
        first = 1 if sessions == 1 else sessions + 1
        endings = (".tum", "_covariance.csv")
        stale = [f"trajectory-{number}{end}" for number in range(first, before + 1) for end in endings]
        stale += [f"report-{number}.html" for number in range(sessions + 1, before + 1)]
        for name in stale:
            (Path(out) / name).unlink(missing_ok=True)
    return remaining


def _write_first_sessions(saved: Map, count: int, path: Path) -> list[str]:
    """Write ``map.db`` of only the first sessions of a map; return a line on what is lost or not drawn.

    Raises
    ------
    ScanweaveError
        If a row is damaged, or the file cannot be written.
    """
    parts, sessions, warnings = saved.parts(), saved.sessions[:count], list[str]()
    nodes = sum(session.keyframes for session in sessions)

    def copied(file: MapFile) -> MapContents:
        found = _alone(parts.base, nodes, sessions, parts.before)
        if parts.base.frames is not None:
            parts.base.frames.copy_to(file, most=nodes)
            found = replace(found, frames=MapFrames(file))
        if parts.base.clouds is not None:
            parts.base.clouds.copy_to(file, nodes)
            found = replace(found, clouds=MapClouds(file))
        found, told = drawn(found, parts.before)
        warnings.extend(told)
        return found

    identity = replace(saved.identity, config=parts.before)
    entries = [_of_first(entry, nodes, parts.base) for entry in saved.contents.edits]
    kept = [entry for entry in entries if entry is not None]
    told = saved.notes, saved.warnings
    if not kept:
        write_sessions(path, identity, sessions, told, copied)
    else:
        with tempfile.TemporaryDirectory() as plain:
            write_sessions(Path(plain) / MAP_NAME, identity, sessions, told, copied)
            with load_map(plain) as found:
                warnings += write_entries(found.parts(), kept, path)
    if gone := len(entries) - len(kept):
        warnings.append(f"{gone} of {len(entries)} edits were of later sessions, and are gone with them")
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
    first = replace(
        base,
        node_poses=base.node_poses[:nodes],
        stamps_s=base.stamps_s[:nodes],
        readings=base.readings[:nodes],
        trajectory=base.trajectory[: sum(session.poses for session in sessions)],
        loops=judged([base.loops[n] for n in numbers], edges, kept),
        measured_scans=base.measured_scans[:nodes],
        keyframe_scans=base.keyframe_scans[:nodes],
        edits=(),
    )
    factors = [SavedFactor(edge, keep) for edge, keep in zip(edges, kept, strict=True)]
    return with_nodes(first, poses_of(graph), factors, config, sessions)


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
