"""Tags of a map, and its pose in the surveyor's frame: stored in the map file, and as YAML for users."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.foreign import from_json
from slam.measurements import FloatArray, Pose, spatial
from slam.storage.files import write_lines
from slam.storage.map_facts import pose_of_rows
from slam.storage.map_file import MapFile
from slam.storage.map_soundness import of, require
from slam.storage.map_tables import META

_TAGS, _SURVEY = "tags", "survey"


@dataclass(frozen=True, slots=True)
class MapTag:
    """A tag of a map.

    Attributes
    ----------
    number, side_m
        Number in its family, and side of its black square.
    node
        The node that saw it best.
    T_node_tag
        Its pose relative to that node: x to the right seen from the front, y up, z out of it.
    sigma_m
        Sigma of its position relative to that node; the root of the largest variance.
    views, fit
        Number of keyframe images with the tag, and of those that agree with its pose.
    """

    number: int
    side_m: float
    node: int
    T_node_tag: gtsam.Pose3
    sigma_m: float
    views: int
    fit: int

    def place_m(self, node_poses: Sequence[Pose]) -> FloatArray:
        """Return (3,) its centre in the map."""
        return np.asarray(spatial(node_poses[self.node]).transformFrom(self.T_node_tag.translation()))


@dataclass(frozen=True, slots=True)
class MapPlaces:
    """Tags and survey of a map.

    Attributes
    ----------
    tags
        By number.
    T_survey_map
        Pose of the map in the surveyor's frame; None if unknown.
    """

    family: str
    tags: tuple[MapTag, ...] = ()
    T_survey_map: gtsam.Pose3 | None = None


def write_places(file: MapFile, places: MapPlaces | None, first: Pose) -> None:
    """Store tags and survey; for the survey, the pose of the first node, at ``first`` in the map.

    Raises
    ------
    MapFileError
        If the file cannot be written.
    """
    if places is None:
        return
    tags = [{**asdict(tag), "T_node_tag": _rows(tag.T_node_tag)} for tag in places.tags]
    file.add_meta(_TAGS, json.dumps({"family": places.family, "tags": tags}))
    if places.T_survey_map is not None:
        file.add_meta(_SURVEY, json.dumps(_rows(places.T_survey_map.compose(spatial(first)))))


def places_of_file(file: MapFile, poses: Sequence[Pose]) -> MapPlaces | None:
    """Read tags and survey of a map with these nodes; None if it has none.

    Raises
    ------
    MapFileError
        If the stored values are invalid.
    """
    with file.naming_row(META, 0):
        meta = file.meta()
        if _TAGS not in meta:
            return None
        fields = of(dict, from_json(meta[_TAGS]))
        tags = tuple(_tag(of(dict, tag), len(poses)) for tag in of(list, fields.get("tags")))
        T_survey_map = None
        if _SURVEY in meta:
            T_survey_map = pose_of_rows(from_json(meta[_SURVEY]), "its survey").compose(
                spatial(poses[0]).inverse()
            )
        return MapPlaces(of(str, fields.get("family")), tags, T_survey_map)


def write_places_yaml(path: Path, places: MapPlaces, node_poses: Sequence[Pose]) -> None:
    """Write the poses of tags in the surveyor's frame, or else in the map, in the format of ``--tags``.

    Raises
    ------
    MapFileError
        If it cannot be written.
    """
    T_survey_map = places.T_survey_map or gtsam.Pose3()
    lines = [f"family: {places.family}"]
    sides = [tag.side_m for tag in places.tags]
    usual = max(set(sides), key=sides.count) if sides else None
    if usual is not None:
        lines.append(f"size_m: {usual:g}")
    if others := [tag for tag in places.tags if tag.side_m != usual]:
        lines += ["sizes_m:", *(f"  {tag.number}: {tag.side_m:g}" for tag in others)]
    lines.append("surveyed:")
    for tag in places.tags:
        place = ", ".join(f"{value:.4f}" for value in T_survey_map.transformFrom(tag.place_m(node_poses)))
        lines.append(f"  - {{tag: {tag.number}, at_m: [{place}], sigma_m: {tag.sigma_m:.4f}}}")
    if places.T_survey_map is not None:
        rows = ", ".join(f"[{', '.join(f'{value:.9f}' for value in row)}]" for row in _rows(T_survey_map))
        lines.append(f"# T_survey_map, row by row: [{rows}]")
    write_lines(path, lines)


def _tag(fields: dict[str, Any], nodes: int) -> MapTag:
    """Parse a tag from its fact."""
    number, node, views, fit = (of(int, fields.get(name)) for name in ("number", "node", "views", "fit"))
    side_m, sigma_m = (float(of(float, fields.get(name))) for name in ("side_m", "sigma_m"))
    require(0 <= node < nodes and number >= 0, "a tag hangs before no node")
    require(0.0 < side_m < np.inf and 0.0 < sigma_m < np.inf, "a tag has no size")
    pose = pose_of_rows(fields.get("T_node_tag"), "a tag's place")
    return MapTag(number, side_m, node, pose, sigma_m, views, fit)


def _rows(pose: gtsam.Pose3) -> list[list[float]]:
    """Return the (3, 4) rows of a pose."""
    rows: list[list[float]] = np.asarray(pose.matrix())[:3].tolist()
    return rows
