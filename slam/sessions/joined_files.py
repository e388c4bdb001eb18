"""The files of a map with one more session: all are written beside, then take the place of the old ones."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from itertools import chain
from pathlib import Path

from slam.config import Config
from slam.mapper.map_result import depth_grid
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.outputs.finished_map import NOTES, WARNINGS, Map, open_map
from slam.sessions.session_join import JoinedMap
from slam.storage.files import make_folder
from slam.storage.map_contents import DEPTH, write_contents
from slam.storage.map_file import MAP_NAME, MapFile
from slam.storage.map_identity import MapIdentity
from slam.storage.map_sessions import SESSIONS, sessions_to_meta


def write_joined(folder: Path, known: Map, session: Map, joined: JoinedMap) -> list[Path]:
    """Write ``map.db`` of a map and a session, and its exports, into a new folder; what was written.

    Raises
    ------
    ScanweaveError
        Where a file cannot be written.
    """
    make_folder(folder)
    config = known.config
    depth, contents = _depth(known, session, joined, config), joined.contents
    if depth is not None:
        contents = replace(contents, grids={**contents.grids, DEPTH: depth})
    sessions = [*known.sessions, *session.sessions]
    file = MapFile.create(folder / MAP_NAME)
    try:
        for key, value in _identity(known, session).to_meta().items():
            file.add_meta(key, value)
        file.add_meta(SESSIONS, sessions_to_meta(sessions))
        file.add_meta(NOTES, json.dumps([*known.notes, *session.notes]))
        file.add_meta(WARNINGS, json.dumps([*known.warnings, *session.warnings]))
        for part, nodes in ((known.contents, 0), (session.contents, len(known.contents.node_poses))):
            if part.frames is not None:
                part.frames.copy_to(file, nodes)
        write_contents(file, contents)
        file.seal()
    finally:
        file.close()
    saved = open_map(folder)
    try:
        return [folder / MAP_NAME, *saved.write_files(folder)]
    finally:
        saved.close()


def _identity(known: Map, session: Map) -> MapIdentity:
    """What decided the joined map: the settings of the first, the logs of both."""
    sessions = [*known.sessions, *session.sessions]
    digest = hashlib.blake2b(digest_size=16)
    for one in sessions:
        digest.update(one.log_fingerprint.encode() + b"\0")
    names = " + ".join(one.log_name for one in sessions)
    return MapIdentity(known.config, names, digest.hexdigest(), session.identity.versions)


def _depth(known: Map, session: Map, joined: JoinedMap, config: Config) -> OccupancyGrid | None:
    """The depth layer from all images; None without a camera."""
    nodes, first = joined.contents.node_poses, len(known.contents.node_poses)
    parts = ((known.contents.frames, nodes[:first]), (session.contents.frames, nodes[first:]))
    seen = [(frames, frames.poses(poses)) for frames, poses in parts if frames is not None]
    if not seen:
        return None
    frames, poses = (chain.from_iterable(part) for part in zip(*seen, strict=True))
    return depth_grid(frames, list(poses), config)
