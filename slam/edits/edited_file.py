"""``map.db`` of an edited map: separate the original map from the edits, and write it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from slam.config import Config
from slam.config.edits import Edits
from slam.edits.applying import Known, resolved
from slam.edits.remaking import remade, remade_config
from slam.mapping.band_scan import ground_of
from slam.matching.cloud_points import voxel_of
from slam.storage.map_contents import MapContents, read_contents, write_contents
from slam.storage.map_edits import AppliedEdits, UneditedFile, append_edits, copy_rows, copy_unedited
from slam.storage.map_file import SEAL, MapFile
from slam.storage.map_identity import CONFIG, MapIdentity
from slam.storage.map_sessions import MapSession
from slam.storage.map_tables import CLOUDS, FRAMES, IMAGES, META


def known_of(file: MapFile, contents: MapContents, sessions: Sequence[MapSession]) -> Known:
    """Return a map, and how it was before all edits."""
    unedited = UneditedFile(file)
    before = MapIdentity.from_meta(unedited.meta(), file.path).config
    contents = replace(contents, ground_m=_ground_m(contents, before))
    base = replace(read_contents(unedited), ground_m=contents.ground_m) if contents.edits else contents
    return Known(file, contents, base, before, sessions)


def _ground_m(contents: MapContents, config: Config) -> float | None:
    """Return the height of the floor of a robot in 3D, also if an older map does not store it."""
    if contents.clouds is None or contents.ground_m is not None:
        return contents.ground_m
    voxel_m = voxel_of(contents.clouds.points(0, everything=True), config.cloud_odometry)
    thickness_m = config.cloud_odometry.thickness_m
    ground = ground_of(contents.clouds, contents.T_base_lidar, voxel_m, thickness_m)
    return None if ground is None else ground.height_m


def write_with(known: Known, edits: Edits, path: Path) -> list[str]:
    """Write a map with more edits; return one line for each item that cannot be drawn.

    Raises
    ------
    ScanweaveError
        If they do not fit the map, or the file cannot be written.
    """
    entries = [*known.contents.edits]
    if not edits.empty:
        entries.append(resolved(known, edits))
    return write_entries(known, entries, path)


def write_entries(known: Known, entries: Sequence[AppliedEdits], path: Path) -> list[str]:
    """Write a map with some of its edits, or others; returns and raises as `write_with`."""
    contents, warnings = remade(known.base, entries, known.before, known.sessions)
    config = remade_config(known.before, entries)
    _write(path, UneditedFile(known.file), contents, None if config == known.before else config)
    return warnings


def write_undone(known: Known, path: Path) -> list[str]:
    """Write a map without the last of its edits; returns and raises as `write_with`."""
    if entries := known.contents.edits[:-1]:
        return write_entries(known, entries, path)
    copy_unedited(known.file, path)
    return []


def _write(path: Path, source: UneditedFile, contents: MapContents, config: Config | None) -> None:
    """Write an edited map."""
    with closing(MapFile.create(path)) as file:
        for key, value in source.rows(META):
            if key != SEAL:
                replaced = config is not None and key == CONFIG
                file.append(META, key, config.model_dump_json() if replaced and config else value)
        for table in (FRAMES, IMAGES, CLOUDS):
            copy_rows(source, file, table)
        write_contents(file, contents)
        if contents.edits:  # otherwise the result of this version is the new map
            append_edits(file, source, contents.edits)
        file.seal()
