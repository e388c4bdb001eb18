"""Facts of a map beside its tables: height of the floor, georeference, and stamp error."""

from __future__ import annotations

import json
from typing import Any

import gtsam
import numpy as np

from slam.earth import Georeference, TangentPlane
from slam.foreign import from_json
from slam.measurements import Pose, spatial
from slam.storage.map_file import MapFile
from slam.storage.map_soundness import of, require
from slam.storage.map_tables import META

_GROUND, _EARTH, _CLOCK = "ground_m", "georeference", "clock_sigma_s"
_PLANE = ("latitude_deg", "longitude_deg", "altitude_m")


def write_facts(
    file: MapFile,
    ground_m: float | None,
    georeference: Georeference | None,
    first: Pose,
    clock_sigma_s: float,
) -> None:
    """Store the known facts.

    For the earth, that is the pose of the first node, at ``first`` in the map: it stays the same if a map is
    rotated.

    Raises
    ------
    MapFileError
        If the file cannot be written.
    """
    if ground_m is not None:
        file.add_meta(_GROUND, json.dumps(ground_m))
    if clock_sigma_s:
        file.add_meta(_CLOCK, json.dumps(clock_sigma_s))
    if georeference is not None:
        plane = {name: getattr(georeference.plane, name) for name in _PLANE}
        matrix = np.asarray(georeference.T_enu_map.compose(spatial(first)).matrix())[:3].tolist()
        file.add_meta(_EARTH, json.dumps({**plane, "T_enu_first": matrix}))


def ground_of_file(file: MapFile) -> float | None:
    """Return the floor height in the base frame, if the map has it; MapFileError if it is no number."""
    with file.naming_row(META, 0):
        text = file.meta().get(_GROUND)
        return None if text is None else float(of(float, from_json(text)))


def clock_sigma_of_file(file: MapFile) -> float:
    """Return the common stamp error (sigma) of the clouds, 0 if none is stored; MapFileError if invalid."""
    with file.naming_row(META, 0):
        sigma_s = of(float, from_json(file.meta().get(_CLOCK, "0.0")))
        require(0.0 <= sigma_s < np.inf, "its stamp error is not valid")
        return sigma_s


def georeference_of_file(file: MapFile, first: Pose) -> Georeference | None:
    """Return the pose on the earth of a map whose first node is at ``first``; None if it has none.

    Raises
    ------
    MapFileError
        If the stored value is invalid.
    """
    with file.naming_row(META, 0):
        if (text := file.meta().get(_EARTH)) is None:
            return None
        fields = of(dict, from_json(text))
        T_enu_first = pose_of_rows(fields.get("T_enu_first"), "its place on the earth")
        place = np.array([fields.get(name) for name in _PLANE], dtype=np.float64)
        require(np.isfinite(place).all() and abs(place[0]) <= 90.0, "its place on the earth is none")
        return Georeference(TangentPlane(*place.tolist()), T_enu_first.compose(spatial(first).inverse()))


def pose_of_rows(rows: Any, name: str) -> gtsam.Pose3:
    """Return a pose from the (3, 4) rows of its matrix; `MapFileError` if they are invalid."""
    matrix = np.array(rows, dtype=np.float64)
    require(matrix.shape == (3, 4) and np.isfinite(matrix).all(), f"{name} is no pose")
    turn = gtsam.Rot3(matrix[:, :3])
    upright = np.abs(np.asarray(turn.matrix()) @ np.asarray(turn.matrix()).T - np.eye(3)).max()
    require(upright < 1e-6 and np.linalg.det(matrix[:, :3]) > 0.0, f"{name} is no pose")
    return gtsam.Pose3(turn, matrix[:, 3])
