"""A small map with loops, and what the tests of edits ask of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.config.edits import Keyframe
from slam.mapping.occupancy_grid import OCCUPIED
from slam.mapping.polygons import inside
from slam.measurements import FloatArray
from slam.outputs.finished_map import Map

Named = dict[str, int]


def name(saved: Map, row: int) -> Named:
    """A keyframe of a map of one log as a file of edits calls it."""
    return Keyframe(reading=int(saved.contents.readings[row])).model_dump()


def occupied(saved: Map, polygon: FloatArray) -> int:
    """Occupied cells that lie within a polygon to their corners."""
    grid = saved.grid
    assert grid is not None
    cells = np.argwhere(grid.states() == OCCUPIED)[:, ::-1].astype(np.float64)
    whole = np.ones(len(cells), np.bool_)
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        whole &= inside(_at(saved, cells + corner), polygon)
    return int(whole.sum())


def changed_outside(before: Map, after: Map, polygon: FloatArray) -> int:
    """Cells of another content that do not touch a polygon; both grids lie alike."""
    assert before.grid is not None and after.grid is not None
    assert before.grid.T_map_grid.equals(after.grid.T_map_grid, 0.0)
    cells = np.argwhere(before.grid.steps != after.grid.steps)[:, ::-1].astype(np.float64)
    touched = np.zeros(len(cells), np.bool_)
    for x in np.linspace(0.0, 1.0, 9):
        for y in np.linspace(0.0, 1.0, 9):
            touched |= inside(_at(before, cells + np.array([x, y])), polygon)
    return int((~touched).sum())


def content(saved: Map) -> bytes:
    """The bytes of its file."""
    return Path(saved.path).read_bytes()


def box(saved: Map, half_m: float = 0.5) -> FloatArray:
    """A square about a wall in the middle of a map's occupied cells."""
    grid = saved.grid
    assert grid is not None
    cells = np.argwhere(grid.states() == OCCUPIED)[:, ::-1].astype(np.float64)
    x, y = _at(saved, cells[len(cells) // 2])
    square = np.array([[-1, -1.1], [1, -1], [1.1, 1], [-1, 1]])
    return np.array([x, y]) + half_m * square


def _at(saved: Map, cells: FloatArray) -> FloatArray:
    """Columns and rows as points of the map."""
    assert saved.grid is not None
    corner = saved.grid.T_map_grid
    return corner.translation() + cells * saved.grid.resolution_m
