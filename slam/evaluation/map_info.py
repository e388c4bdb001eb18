"""What is in a saved map, for ``scanweave info``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slam.config import Config
from slam.errors import MapFileError, UnfinishedMapError
from slam.foreign import plain
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.outputs.finished_map import Map, open_map
from slam.storage.map_file import MapFile, map_path
from slam.storage.map_identity import MapIdentity
from slam.storage.map_tables import CLOUDS, FRAMES


def map_info(path: Path) -> dict[str, Any]:
    """The facts about a map, as plain values; of one that is not finished, those that it has.

    Raises
    ------
    MapFileError
        Where there is none, it is damaged, or a run is writing it.
    """
    try:
        saved = open_map(path)
    except UnfinishedMapError:
        return _begun(map_path(path))
    trajectory, identity = saved.trajectory, saved.identity
    kinds = Counter(str(factor.edge.kind) for factor in saved.factors if factor.kept)
    refused = Counter(str(factor.edge.kind) for factor in saved.factors if not factor.kept)
    return {
        "map": str(saved.path),
        "size_mb": round(saved.path.stat().st_size / 1e6, 3),
        "finished": True,
        "log": identity.log_name,
        "sessions": len(saved.sessions),
        "motion": "planar" if saved.planar else "spatial",
        "sensors": _sensors(saved),
        "keyframes": len(saved.keyframe_poses),
        **({"clouds": len(saved.contents.clouds)} if saved.contents.clouds else {}),
        "poses": len(trajectory),
        **_extent(saved),
        "factors": dict(sorted(kinds.items())),
        "factors_refused": dict(sorted(refused.items())),
        "loops": len(saved.loops),
        "loops_accepted": sum(loop.accepted for loop in saved.loops),
        "grids": _grids(saved),
        **({"edits": len(saved.edits)} if saved.edits else {}),
        **_origin(identity),
        "digest": saved.digest,
    }


def _extent(saved: Map) -> dict[str, float]:
    """Way and time of all sessions."""
    ends = np.cumsum([session.poses for session in saved.sessions])[:-1]
    tracks = np.split(saved.trajectory.positions_m, ends)
    times = np.split(saved.trajectory.stamps_s, ends)
    return {
        "path_length_m": round(
            sum(float(np.linalg.norm(np.diff(track, axis=0), axis=1).sum()) for track in tracks), 3
        ),
        "duration_s": round(sum(float(np.ptp(stamps_s)) for stamps_s in times), 3),
    }


def _begun(path: Path) -> dict[str, Any]:
    """What an interrupted run has left."""
    file = MapFile.resume(path)
    if file is None:
        raise MapFileError(f"{path} was interrupted before it began; map again")
    try:
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
    finally:
        file.close()


def _origin(identity: MapIdentity) -> dict[str, Any]:
    """Seed, settings that are not the defaults, versions."""
    settings, defaults = (config.model_dump(mode="json") for config in (identity.config, Config()))
    return {
        "seed": identity.config.seed,
        "settings": dict(_differences(settings, defaults)),
        "versions": dict(identity.versions),
    }


def render_info(found: Mapping[str, Any]) -> str:
    """The same for people: a line a fact."""
    lines = []
    for name, value in found.items():
        if isinstance(value, Mapping):
            value = ", ".join(f"{key} {_text(part)}" for key, part in value.items()) or "none"
        lines.append(f"{name.replace('_', ' ') + ':':17} {_text(value)}")
    return "\n".join(lines)


def _text(value: Any) -> str:
    """A plain value in words."""
    if isinstance(value, Mapping):
        return " ".join(f"{key}={part}" for key, part in value.items())
    return plain(value)


def _sensors(saved: Map) -> dict[str, int]:
    """How many keyframes each sensor gave."""
    scans = Counter(scan.sensor for scan in saved.keyframe_scans if scan is not None)
    frames = saved.contents.frames
    images = Counter(frames.head(index).sensor for index in range(len(frames))) if frames else Counter()
    return dict(sorted((scans + images).items()))


def _grids(saved: Map) -> dict[str, Any]:
    """Every grid, and what they decide where there are two."""
    found = {name: _grid(grid.states(), grid.resolution_m) for name, grid in saved.contents.grids.items()}
    layers = saved.layers
    if layers is not None and layers.names:
        found["decision"] = _grid(layers.states("decision"), layers.resolution_m)
    return found


def _grid(states: StateArray, resolution_m: float) -> dict[str, Any]:
    """Size and content of a grid."""
    rows, cols = states.shape
    cell_m2 = resolution_m**2
    return {
        "size_m": [round(cols * resolution_m, 2), round(rows * resolution_m, 2)],
        "resolution_m": resolution_m,
        "free_m2": round(float((states == FREE).sum()) * cell_m2, 1),
        "occupied_m2": round(float((states == OCCUPIED).sum()) * cell_m2, 1),
    }


def _differences(tree: Any, default: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of every setting that is not the default."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _differences(value, default[name], f"{prefix}{name}.")
        elif value != default[name]:
            yield prefix + name, value
