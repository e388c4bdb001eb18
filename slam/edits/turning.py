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

# Scatter of the normals of one wall, fitted to a few beams.
_NORMAL_SIGMA_RAD = math.radians(2.0)


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
