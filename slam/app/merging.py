"""Merge several saved maps into one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from fusion.showing import one_line
from slam.app.joining import kind_of
from slam.errors import MapFileError, ScanweaveError, path_of
from slam.evaluation.saved_page import write_saved_page
from slam.outputs.finished_map import Map, load_map
from slam.sessions.connection import connect
from slam.sessions.joined_files import write_joined
from slam.storage.map_file import MAP_NAME
from slam.temporary import TemporaryFolder


@dataclass(frozen=True, slots=True)
class Merged:
    """The result of merging several maps.

    Attributes
    ----------
    map
        The merged map, open.
    refused
        For each map that could not be joined, the reason, by the path of the map.
    written
        The files that were written.
    """

    map: Map
    refused: Mapping[Path, str]
    written: tuple[Path, ...]

    __repr__ = one_line


def merge(maps: Sequence[Map | Path | str], out: Path | str, *, overwrite: bool = False) -> Merged:
    """Join saved maps in any order in which they connect, and write the merged map.

    Parameters
    ----------
    maps
        At least two maps or their paths. The first defines the frame and the settings. None is changed.
    out
        Folder for the merged map.
    overwrite
        Replace another map in ``out``.

    Raises
    ------
    ScanweaveError
        If no other map connects to the first, or a file is faulty; then nothing is written.

    Examples
    --------
    >>> import slam
    >>> from slam.simulation.synthetic_log import write_synthetic_log
    >>> logs = [write_synthetic_log(f"log{n}", seed=n, duration_s=10.0).log_path for n in (1, 2)]
    >>> merged = slam.merge([slam.map_log(log) for log in logs], "house")
    >>> len(merged.map.sessions), dict(merged.refused)
    (2, {})
    """
    if not isinstance(maps, Sequence) or len(maps) < 2:
        raise ScanweaveError("merge needs at least two maps")
    folder = path_of(out, "out")
    if (folder / MAP_NAME).exists() and not overwrite:
        raise MapFileError(f"{folder / MAP_NAME} is a map; --force (overwrite=True) replaces it")
    merged, *waiting = (source if isinstance(source, Map) else load_map(source) for source in maps)
    first, kept_in, refused = merged, TemporaryFolder(), dict[Path, str]()
    tried = -1
    while waiting and tried < len(merged.sessions):
        # What nothing connects to may connect once another has been joined.
        tried = len(merged.sessions)
        for other in list(waiting):
            step = kept_in.path / str(len(merged.sessions))
            why = refused[other.path] = _joined(merged, other, step)
            if why:
                continue
            del refused[other.path]
            waiting.remove(other)
            merged = load_map(step)
    if merged is first:
        reasons = "; ".join(f"{path}: {why}" for path, why in refused.items())
        raise ScanweaveError(f"none of the maps connects to {first.path}: {reasons}")
    written = merged.save(folder, overwrite=overwrite)
    merged.close()
    kept_in.remove()
    saved = load_map(folder)
    return Merged(saved, refused, (*written, write_saved_page(saved)))


def _joined(merged: Map, other: Map, folder: Path) -> str:
    """Join a map to others and write the result into a folder; return why it failed, or an empty text."""
    try:
        kinds = [kind_of(item, str(item.path)) for item in (merged, other)]
        known = {session.log_fingerprint: session.log_name for session in merged.sessions}
        shared = [known[item.log_fingerprint] for item in other.sessions if item.log_fingerprint in known]
        if kinds[0] != kinds[1]:
            return f"it is of {kinds[1]}, the first of {kinds[0]}"
        if shared:
            return f"its log {shared[0]} is already in the others"
        if other.edits:
            return "it has edits, which only the first map may have; give it first, or undo them"
        connection = connect(merged, other)
    except ScanweaveError as error:
        return str(error)
    if connection.joined is None:
        return connection.reason
    write_joined(folder, merged, other, connection)
    return ""
