"""Contents of a saved map, for ``scanweave info``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import numpy as np

from slam.config import Config, leaves
from slam.errors import MapFileError, UnfinishedMapError
from slam.estimates import Trajectory
from slam.foreign import plain
from slam.mapping.layered_map import DEPTH, OCCUPANCY
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.storage.map_file import MapFile, map_path
from slam.storage.map_identity import MapIdentity
from slam.storage.map_parts import read_grids, read_trajectory
from slam.storage.map_sessions import MapSession, sessions_of
from slam.storage.map_tables import CLOUDS, EDITS, FACTORS, FRAMES, GRIDS, KEYFRAMES, LOOPS
from slam.storage.packing import Unpacker, is_in_plane, last_text


def map_info(path: Path) -> dict[str, Any]:
    """Return the facts about a map as plain values; of an unfinished one, those available.

    Raises
    ------
    MapFileError
        If there is no map, it is damaged, or a run is writing it.
    """
    try:
        file = MapFile.read(path)
    except UnfinishedMapError:
        return _begun(map_path(path))
    with closing(file):
        return _finished(file)


def _finished(file: MapFile) -> dict[str, Any]:
    """Return the content of a finished map: by counting if possible, since a map is large."""
    meta, small = file.meta(), Unpacker(file.size)
    identity, trajectory = MapIdentity.from_meta(meta, file.path), read_trajectory(file, small)
    sessions = sessions_of(meta, file.count(KEYFRAMES), len(trajectory))
    factors = file.tally(FACTORS, "kept", "kind").items()
    edits = file.tally(EDITS, "source")[EDITS.name,]
    return {
        "map": str(file.path),
        "size_mb": round(file.size / 1e6, 3),
        "finished": True,
        "log": identity.log_name,
        "sessions": len(sessions),
        "motion": "planar" if _is_planar(file) else "spatial",
        "sensors": _sensors(file, small),
        "keyframes": file.count(KEYFRAMES),
        **({"clouds": file.count(CLOUDS)} if file.count(CLOUDS) else {}),
        "poses": len(trajectory),
        **extent_of(trajectory, sessions),
        "factors": {str(kind): count for (kept, kind), count in factors if kept},
        "factors_refused": {str(kind): count for (kept, kind), count in factors if not kept},
        "loops": file.count(LOOPS),
        "loops_accepted": file.tally(LOOPS, "accepted")[1,],
        "grids": _grids(file, small, identity.config),
        **({"edits": edits} if edits else {}),
        **_origin(identity),
        "digest": file.content_digest(),
    }


def _is_planar(file: MapFile) -> bool:
    """Return whether the robot stays on a floor."""
    with file.naming_row(KEYFRAMES, 0):
        return is_in_plane(cast(bytes, file.row(KEYFRAMES, 0)[2]))


def extent_of(trajectory: Trajectory, sessions: Sequence[MapSession]) -> dict[str, float]:
    """Return path length and duration of all sessions."""
    ends = np.cumsum([session.poses for session in sessions])[:-1]
    tracks, times = np.split(trajectory.positions_m, ends), np.split(trajectory.stamps_s, ends)
    return {
        "path_length_m": round(
            sum(float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum()) for track in tracks), 3
        ),
        "duration_s": round(sum(float(np.ptp(stamps_s)) for stamps_s in times if stamps_s.size), 3),
    }


def _begun(path: Path) -> dict[str, Any]:
    """Return the content of an interrupted run."""
    file = MapFile.resume(path)
    if file is None:
        raise MapFileError(f"{path} was interrupted before it began; map again")
    with closing(file):
        identity = MapIdentity.from_meta(file.meta(), path)
        return {
            "map": str(path),
            "size_mb": round(path.stat().st_size / 1e6, 3),
            "finished": file.finished,
            "log": identity.log_name,
            "images": file.count(FRAMES),
            **({"clouds": file.count(CLOUDS)} if file.count(CLOUDS) else {}),
            **_origin(identity),
        }


def _origin(identity: MapIdentity) -> dict[str, Any]:
    """Return seed, settings other than the defaults, and versions."""
    settings = identity.config.model_dump(mode="json", exclude_defaults=True)
    return {
        "seed": identity.config.seed,
        "settings": dict(leaves(settings)),
        "versions": dict(identity.versions),
    }


def render_info(facts: Mapping[str, Any]) -> str:
    """Format the facts for the user, one per line."""
    lines = []
    for name, value in facts.items():
        if isinstance(value, Mapping):
            value = ", ".join(f"{key} {_text(part)}" for key, part in value.items()) or "none"
        lines.append(f"{name.replace('_', ' ') + ':':17} {_text(value)}")
    return "\n".join(lines)


def _text(value: Any) -> str:
    """Format a plain value as text."""
    if isinstance(value, Mapping):
        return " ".join(f"{key}={part}" for key, part in value.items())
    return plain(value)


def _sensors(file: MapFile, small: Unpacker) -> dict[str, int]:
    """Return the number of keyframes of each sensor."""
    scans = Counter(
        file.parsed(
            KEYFRAMES, lambda row: str(small(scan, last_text)) if (scan := row[-1] or row[-2]) else ""
        )
    )
    images = Counter({str(sensor): count for (sensor,), count in file.tally(FRAMES, "sensor").items()})
    return {sensor: count for sensor, count in sorted((scans + images).items()) if sensor}


def _grids(file: MapFile, small: Unpacker, config: Config) -> dict[str, Any]:
    """Return every grid, and the decision if there are two."""
    has_depth = (DEPTH,) in file.tally(GRIDS, "name")
    grids = read_grids(file, small, placed=has_depth)
    shares = {name: _grid(grid.states(), grid.resolution_m) for name, grid in grids.items()}
    if not has_depth:
        return shares
    from slam.mapping.keyframe_grid import layers_of_grids

    layers = layers_of_grids(grids.get(OCCUPANCY), grids[DEPTH], config)
    if layers is not None:
        shares["decision"] = _grid(layers.states("decision"), layers.resolution_m)
    return shares


def _grid(states: StateArray, resolution_m: float) -> dict[str, Any]:
    """Return size and content of a grid."""
    rows, cols = states.shape
    cell_m2 = resolution_m**2
    return {
        "size_m": [round(cols * resolution_m, 2), round(rows * resolution_m, 2)],
        "resolution_m": resolution_m,
        "free_m2": round(float((states == FREE).sum()) * cell_m2, 1),
        "occupied_m2": round(float((states == OCCUPIED).sum()) * cell_m2, 1),
    }
