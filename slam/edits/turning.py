"""Rotate a map: to align with its walls, by an angle, or along two points."""

from __future__ import annotations

import math

import gtsam
import numpy as np

from slam.config import Config
from slam.errors import MapFileError
from slam.matching.scan_points import points_by
from slam.measurements import FloatArray
from slam.storage.map_contents import MapContents

# How far normals of one wall scatter, fitted to a few beams.
_NORMAL_SIGMA_RAD = math.radians(2.0)


def turned_about(angle_rad: float, origin: FloatArray) -> gtsam.Pose2:
    """``T_new_old`` of a map that is turned by an angle, and in which a point (2,) becomes the origin."""
    turn = gtsam.Pose2(0.0, 0.0, angle_rad)
    at = turn.transformFrom(origin)
    return gtsam.Pose2(-at[0], -at[1], angle_rad)


def to_walls_rad(contents: MapContents, config: Config) -> float:
    """The smallest turn after which most walls lie along x and y.

    The normals of all scans' points vote, mod a quarter turn: the greatest of their density, by a kernel as
    wide as they scatter, and the mean of those about it.

    Raises
    ------
    MapFileError
        If the map has no scans, and so no walls to be seen.
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
