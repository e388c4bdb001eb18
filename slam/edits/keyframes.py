"""Keyframes by their names for users, and the points that they contribute to the map."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.config.edits import Keyframe
from slam.errors import MapFileError
from slam.measurements import BoolArray, FloatArray, Pose
from slam.storage.map_contents import MapContents
from slam.storage.map_edits import Region
from slam.storage.map_sessions import MapSession


def row_of(keyframe: Keyframe, contents: MapContents, sessions: Sequence[MapSession]) -> int:
    """Return the row of a keyframe.

    Raises
    ------
    MapFileError
        If the map has none of that session and reading.
    """
    if keyframe.session > len(sessions):
        raise MapFileError(f"there is no {keyframe}: the map has {len(sessions)} session(s)")
    first = sum(session.keyframes for session in sessions[: keyframe.session - 1])
    own = contents.readings[first : first + sessions[keyframe.session - 1].keyframes]
    place = int(np.searchsorted(own, keyframe.reading))
    if place == len(own) or own[place] != keyframe.reading:
        nearest = own[np.abs(own - keyframe.reading).argmin()]
        raise MapFileError(f"there is no keyframe of {keyframe}; the nearest is of reading {nearest}")
    return first + place


def held(
    kind: str,
    points: FloatArray,
    poses: FloatArray,
    *,
    name: str = "",
    value: float = 0.0,
    candidates: BoolArray | None = None,
) -> Region:
    """Attach points (n, 2) of the map to keyframes, each to the nearest one.

    Parameters
    ----------
    poses
        (K, 3) poses of all keyframes.
    candidates
        (K,) keyframes that may be used, if there are any; None for all.
    """
    rows: NDArray[np.int64] = np.arange(len(poses))
    if candidates is not None and candidates.any():
        rows = np.flatnonzero(candidates)
    rays = points[:, None] - poses[rows, :2]
    chosen = rows[np.einsum("nkd,nkd->nk", rays, rays).argmin(axis=1)]
    at = poses[chosen]
    cos, sin = np.cos(at[:, 2]), np.sin(at[:, 2])
    x, y = (points - at[:, :2]).T
    offsets = np.column_stack([cos * x + sin * y, cos * y - sin * x])
    return Region(kind, name, value, chosen, offsets)


def bases_of(contents: MapContents, poses: Sequence[Pose]) -> Sequence[Pose]:
    """Return the base poses at the nodes of a map; the nodes of a camera alone are camera poses."""
    if contents.planar or contents.clouds is not None or contents.frames is None:
        return poses
    T_base_camera = contents.frames.head(0).T_base_camera
    if T_base_camera is None:
        return poses
    back = T_base_camera.inverse()
    return [pose.compose(back) for pose in poses if isinstance(pose, gtsam.Pose3)]
