"""Apply a file of edits to a map: keyframes of names, the evidence inside polygons, and the rotation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slam.config import Config
from slam.config.edits import Edits, Pair, dump_edits
from slam.edits.evidence import Cut, taken
from slam.edits.keyframes import held, row_of
from slam.edits.loops import edited_loops, matched_loops, refuse_unknown
from slam.edits.remaking import remade_config, settled
from slam.errors import ConfigError, MapFileError
from slam.matching.scan_points import points_by
from slam.measurements import FloatArray
from slam.storage.map_contents import MapContents
from slam.storage.map_edits import AppliedEdits, Evidence, Region
from slam.storage.map_edits import Pair as Rows
from slam.storage.map_file import MapFile
from slam.storage.map_sessions import MapSession

# Scatter of the normals of one wall, fitted to a few beams.
_NORMAL_SIGMA_RAD = math.radians(2.0)


@dataclass(frozen=True, slots=True)
class Known:
    """A map that is being edited.

    Attributes
    ----------
    contents
        The map with the edits so far, as the user sees it.
    base, before
        The map without edits, and its settings.
    """

    file: MapFile
    contents: MapContents
    base: MapContents
    before: Config
    sessions: Sequence[MapSession]


def resolved(known: Known, edits: Edits) -> AppliedEdits:
    """Resolve edits in a map.

    Raises
    ------
    ScanweaveError
        If a keyframe or a loop does not exist, two keyframes do not match, or a setting needs the log.
    """
    entries = known.contents.edits
    settings = tuple(_override(name, value) for name, value in edits.settings.items())
    entry = AppliedEdits(dump_edits(edits), settings=settings)
    config = remade_config(known.before, [*entries, entry])
    entry = _with_loops(entry, known, edits, config)
    erased, regions = _with_regions(known, edits, config)
    entry = replace(entry, erased=erased, regions=tuple(regions))
    if edits.turn is None and edits.origin is None:
        return entry
    return _turned(entry, known, edits, config)


def _override(name: str, value: object) -> str:
    """A setting in the form of ``--set``."""
    if isinstance(value, dict):
        raise ConfigError(f"settings: '{name}' holds a mapping; write settings by their dotted names")
    return f"{name}={'true' if value is True else 'false' if value is False else value}"


def _rows(pair: Pair, known: Known) -> tuple[int, int, str]:
    """The rows of two keyframes, and a name for the pair."""
    first, second = pair
    ends = f"{first} and {second}"
    rows = row_of(first, known.base, known.sessions), row_of(second, known.base, known.sessions)
    if rows[0] == rows[1]:
        raise ConfigError(f"a loop joins two keyframes, not {first} with itself")
    return *rows, ends


def _with_loops(entry: AppliedEdits, known: Known, edits: Edits, config: Config) -> AppliedEdits:
    """Add the forbidden, forced and new loops to the entry."""
    requested = []
    for added in edits.loops.add:
        first, second, ends = _rows(added.pair, known)
        requested.append((first, second, None if added.guess is None else np.array(added.guess), ends))
    entry = replace(entry, added=tuple(matched_loops(known.contents, known.sessions, requested, config)))
    loops = edited_loops(known.base, [*known.contents.edits, entry], known.before, config)[1]
    chosen: dict[str, list[Rows]] = {"forbidden": [], "forced": []}
    for kind, pairs in (("forbidden", edits.loops.forbid), ("forced", edits.loops.force)):
        for pair in pairs:
            first, second, ends = _rows(pair, known)
            rows = min(first, second), max(first, second)
            refuse_unknown(loops, rows, ends, matched=kind == "forced")
            chosen[kind].append(rows)
    return replace(entry, forbidden=tuple(chosen["forbidden"]), forced=tuple(chosen["forced"]))


def _with_regions(known: Known, edits: Edits, config: Config) -> tuple[dict[Evidence, bytes], list[Region]]:
    """The erased evidence, and the regions that keyframes hold in place."""
    poses, regions = known.contents.keyframe_poses, list[Region]()
    cuts = [Cut(np.array(area.polygon)) for area in edits.erase]
    cuts += [] if edits.crop is None else [Cut(np.array(edits.crop), outside=True)]
    erased = taken(known.contents, cuts, config)
    has_evidence = np.zeros(len(poses), np.bool_)
    frames = known.contents.frames
    has_evidence[[frames.head(at).node if kind == "frame" and frames else at for kind, at in erased]] = True
    for area, cut in zip(edits.erase, cuts, strict=False):
        name, later = area.name or "", float(area.later)
        regions.append(held("erase", cut.polygon, poses, name=name, value=later, candidates=has_evidence))
    if edits.crop is not None:
        regions.append(held("crop", np.array(edits.crop), poses, value=1.0))
    regions += [held("keep_out", np.array(zone.polygon), poses, name=zone.name) for zone in edits.keep_out]
    regions += [
        held("slow", np.array(zone.polygon), poses, name=zone.name, value=zone.percent) for zone in edits.slow
    ]
    for place in edits.places:
        region = held("place", np.array([place.position]), poses, name=place.name)
        yaw = math.radians(place.yaw_deg) - float(poses[region.keyframes[0], 2])
        regions.append(replace(region, value=math.remainder(yaw, 2.0 * math.pi)))
    return erased, regions


def later_evidence(
    contents: MapContents, entries: Sequence[AppliedEdits], first: int, config: Config
) -> list[AppliedEdits]:
    """Extend the edits of a map after a session has joined: permanent erasures also apply to its readings.

    Parameters
    ----------
    contents
        The joined map with the edits.
    first
        The first keyframe of the session.
    """
    updated = []
    for entry in entries:
        cuts = [
            Cut(region.points(contents.keyframe_poses), outside=region.kind == "crop")
            for region in entry.regions
            if region.kind in ("erase", "crop") and region.value
        ]
        updated.append(replace(entry, erased={**entry.erased, **taken(contents, cuts, config, first)}))
    return updated


def _turned(entry: AppliedEdits, known: Known, edits: Edits, config: Config) -> AppliedEdits:
    """The entry with the rotation of the map, from the keyframe poses after all other edits."""
    entries = [*known.contents.edits, entry]
    contents = settled(known.base, entries, known.before, config, known.sessions)
    before, after = known.contents.keyframe_poses, contents.keyframe_poses

    def now(*points: tuple[float, float]) -> FloatArray:
        return held("place", np.array(points), before).points(after)

    angle, turn = 0.0, edits.turn
    if turn is not None and turn.to_walls:
        angle = to_walls_rad(contents, config)
    elif turn is not None and turn.degrees is not None:
        angle = math.radians(turn.degrees)
    elif turn is not None and turn.along_x is not None:
        x, y = np.diff(now(*turn.along_x), axis=0)[0]
        angle = -math.atan2(y, x)
    origin = np.zeros(2) if edits.origin is None else now(edits.origin)[0]
    return replace(entry, turned=turned_about(angle, origin))


def turned_about(angle_rad: float, origin: FloatArray) -> gtsam.Pose2:
    """Return ``T_new_old`` of a map that is rotated by an angle, with a point (2,) as its new origin."""
    turn = gtsam.Pose2(0.0, 0.0, angle_rad)
    at = turn.transformFrom(origin)
    return gtsam.Pose2(-at[0], -at[1], angle_rad)


def to_walls_rad(contents: MapContents, config: Config) -> float:
    """Return the smallest rotation after which most walls are along x and y.

    The normals of all scan points vote, modulo 90 degrees: the result is the maximum of their density, with a
    kernel as wide as their scatter, refined by the mean of those around it.

    Raises
    ------
    MapFileError
        If the map has no scans, and so no walls.
    """
    angles = []
    for scan, pose in zip(contents.keyframe_scans, contents.keyframe_poses, strict=False):
        if scan is not None:
            points = points_by(config.scan, scan)
            normals = points.normals_base[np.any(points.normals_base != 0.0, axis=1)]
            angles.append(np.arctan2(normals[:, 1], normals[:, 0]) + pose[2])
    fourfold = 4.0 * np.concatenate(angles).astype(np.float64) if angles else np.zeros(0)
    if not len(fourfold):
        raise MapFileError("no scan of the map shows a wall to turn it to; give degrees or along_x instead")
    concentration = 1.0 / (4.0 * _NORMAL_SIGMA_RAD) ** 2
    edges = np.linspace(-np.pi, np.pi, 1 + math.ceil(2.0 * np.pi / (2.0 * _NORMAL_SIGMA_RAD)))
    middles = 0.5 * (edges[1:] + edges[:-1])
    counts = np.histogram((fourfold + np.pi) % (2.0 * np.pi) - np.pi, edges)[0]
    density = np.exp(concentration * (np.cos(middles[:, None] - middles) - 1.0)) @ counts
    at = float(middles[density.argmax()])
    for _ in range(config.match.iterations):
        weights = np.exp(concentration * (np.cos(fourfold - at) - 1.0))
        at = math.atan2(float(weights @ np.sin(fourfold)), float(weights @ np.cos(fourfold)))
    return -0.25 * at
