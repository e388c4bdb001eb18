"""Reduces a map to a picture in nav2's format, as it is or degraded, without scans.

``half`` has cells of twice the size, ``thick`` has walls that are one cell thicker on each side, ``turned``
is rotated by 30 degrees; ``plan`` contains nothing smaller than a metre, like a floor plan.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import gtsam
import numpy as np
from scipy import ndimage

from slam.mapping.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from slam.matching.planar import transform_points
from slam.measurements import row_from_pose2
from slam.outputs.grid_map import load_grid_map
from slam.storage.map_contents import MapContents
from slam.storage.nav2 import write_nav2_map

DRAWN = ("whole", "half", "thick", "turned", "plan")


def drawn(known_map: MapContents, kind: str) -> MapContents:
    """The picture of a map, written to a file and read again."""
    grid = known_map.grid
    assert grid is not None
    states, side_m, corner = grid.states(), grid.resolution_m, grid.T_map_grid
    wall = states == OCCUPIED
    if kind == "half":
        rows, columns = (2 * (size // 2) for size in states.shape)
        blocks = states[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2)
        states, side_m = blocks.max(axis=(1, 3)), 2.0 * side_m
    if kind == "thick":
        states[ndimage.binary_dilation(wall)] = OCCUPIED
    if kind == "turned":
        turn, span = gtsam.Pose2(0.0, 0.0, np.radians(30.0)), sum(states.shape)
        margin = gtsam.Pose2(-0.5 * span * side_m, -0.5 * span * side_m, 0.0)
        corner = grid.T_map_grid.compose(turn).compose(margin)
        rows, columns = np.indices((2 * span, 2 * span)).reshape(2, -1) + 0.5
        middles = transform_points(np.column_stack([columns, rows]) * side_m, row_from_pose2(corner))
        row, column = (cells := grid.cells_of(middles)).T
        inside = ((cells >= 0) & (cells < states.shape)).all(axis=1)
        turned = np.full(4 * span * span, UNKNOWN, np.int8)
        turned[inside] = states[row[inside], column[inside]]
        states = turned.reshape(2 * span, 2 * span)
    if kind == "plan":
        labels, _ = ndimage.label(wall, np.ones((3, 3)))
        spans = [max(s.stop - s.start for s in piece) for piece in ndimage.find_objects(labels)]
        small = np.concatenate([[False], np.array(spans) * side_m < 1.0])[labels]
        states[wall & small] = FREE
    with tempfile.TemporaryDirectory() as folder:
        yaml, _ = write_nav2_map(Path(folder) / "map", states, side_m, corner, kind)
        return load_grid_map(yaml).contents
