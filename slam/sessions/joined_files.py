"""Files of a map with one more session: all are written next to the old ones, then replace them."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path

from slam.config import Config
from slam.edits.applying import later_evidence
from slam.edits.edited_file import write_entries
from slam.edits.keyframes import bases_of
from slam.edits.remaking import remade
from slam.localization.poses import separation
from slam.mapper.map_result import depth_grid
from slam.mapping.layered_map import DEPTH
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.measurements import composed
from slam.outputs.finished_map import Map, load_map
from slam.sessions.connection import Connection
from slam.sessions.session_join import JoinedMap, join
from slam.storage.files import make_folder
from slam.storage.map_contents import MapContents, write_contents
from slam.storage.map_facts import write_facts
from slam.storage.map_file import MAP_NAME, MapFile
from slam.storage.map_identity import NOTES, WARNINGS, MapIdentity
from slam.storage.map_places import write_places
from slam.storage.map_sessions import SESSIONS, MapSession


def write_joined(folder: Path, known: Map, session: Map, connection: Connection) -> Path:
    """Write ``map.db`` of a map and a session into a new folder; return its path.

    If the map has edits, both are joined again without the edits, which are then applied: so the edits of the
    joined map can be undone like those of the first.

    Raises
    ------
    ScanweaveError
        If a file cannot be written.
    """
    assert connection.joined is not None
    make_folder(folder)
    if not known.contents.edits:
        _write(folder / MAP_NAME, known, session, connection.joined)
    else:
        with tempfile.TemporaryDirectory() as plain:
            _write(Path(plain) / MAP_NAME, *_unedited(known, session, connection))
            _edit(Path(plain), known, folder / MAP_NAME)
    return folder / MAP_NAME


def _unedited(known: Map, session: Map, connection: Connection) -> tuple[Map, Map, JoinedMap]:
    """Return a map without its edits, a session, and the two joined by the same loops."""
    parts = known.parts()
    identity = replace(known.identity, config=parts.before)
    before = replace(known, contents=parts.base, identity=identity)
    poses, base = (bases_of(source.contents, source.contents.node_poses) for source in (known, before))
    anchors = []
    for anchor in connection.placing.anchors:
        nearest = min(range(len(poses)), key=lambda key: separation(poses[key], anchor.pose)[0])
        T_base_map = composed(base[nearest], poses[nearest].inverse())
        T_base_session = composed(T_base_map, anchor.T_map_session)
        anchors.append(replace(anchor, pose=composed(T_base_map, anchor.pose), T_map_session=T_base_session))
    placing = replace(connection.placing, anchors=anchors)
    return before, session, join(before, session, placing, connection.loops, before.config)


def _edit(folder: Path, known: Map, path: Path) -> None:
    """Apply the edits of a map to it and a session joined without them."""
    entries = known.contents.edits
    with load_map(folder) as joined:
        first, parts = len(known.contents.node_poses), joined.parts()
        contents, _ = remade(parts.base, entries, parts.before, parts.sessions)
        entries = later_evidence(contents, entries, first, known.config)
        write_entries(parts, entries, path)


def _write(path: Path, known: Map, session: Map, joined: JoinedMap) -> None:
    """Write ``map.db`` of the joined map."""
    config = known.config
    depth, contents = _depth(known, session, joined, config), joined.contents
    if depth is not None:
        contents = replace(contents, grids={**contents.grids, DEPTH: depth})

    def copied(file: MapFile) -> MapContents:
        for part, nodes in ((known.contents, 0), (session.contents, len(known.contents.node_poses))):
            if part.frames is not None:
                part.frames.copy_to(file, nodes)
            if part.clouds is not None:
                part.clouds.copy_to(file)
        return replace(contents, georeference=known.contents.georeference, places=known.contents.places)

    remarks = [*known.notes, *session.notes], [*known.warnings, *session.warnings]
    identity = MapIdentity(config, "", "", session.identity.versions)
    write_sessions(path, identity, [*known.sessions, *session.sessions], remarks, copied)


def write_sessions(
    path: Path,
    identity: MapIdentity,
    sessions: Sequence[MapSession],
    remarks: tuple[Sequence[str], Sequence[str]],
    copied: Callable[[MapFile], MapContents],
) -> None:
    """Write ``map.db`` of several sessions.

    Parameters
    ----------
    identity
        Settings and versions; the logs are those of the sessions.
    copied
        Function that copies frames and clouds into the file, and returns the rest.
    """
    if len(sessions) > 1:
        digest = hashlib.blake2b(digest_size=16)
        for session in sessions:
            digest.update(session.log_fingerprint.encode() + b"\0")
        name, fingerprint = " + ".join(session.log_name for session in sessions), digest.hexdigest()
    else:
        name, fingerprint = sessions[0].log_name, sessions[0].log_fingerprint
    with closing(MapFile.create(path)) as file:
        identity = replace(identity, log_name=name, log_fingerprint=fingerprint)
        for key, value in identity.to_meta().items():
            file.add_meta(key, value)
        if len(sessions) > 1:
            file.add_meta(SESSIONS, json.dumps([asdict(session) for session in sessions]))
        for key, lines in zip((NOTES, WARNINGS), remarks, strict=True):
            file.add_meta(key, json.dumps(lines))
        found = copied(file)
        write_contents(file, found)
        write_facts(file, found.ground_m, found.georeference, found.node_poses[0], found.clock_sigma_s)
        write_places(file, found.places, found.node_poses[0])
        file.seal()


def _depth(known: Map, session: Map, joined: JoinedMap, config: Config) -> OccupancyGrid | None:
    """Draw the depth layer from all images; None without a camera or a plan."""
    joint, first = joined.contents, len(known.contents.node_poses)
    nodes, bases = joint.node_poses, known.contents.clouds is not None
    if not (known.planar or joint.grids):
        return None
    parts = ((known.contents.frames, nodes[:first]), (session.contents.frames, nodes[first:]))
    posed = [(frames, frames.poses(poses, bases)) for frames, poses in parts if frames is not None]
    if not posed:
        return None
    frames, poses = (chain.from_iterable(part) for part in zip(*posed, strict=True))
    return depth_grid(frames, list(poses), config, joint.ground_m)
