"""Compares a map with the true plan of a home, cell by cell, with a tolerance of one cell."""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slam.errors import EvaluationError
from slam.mapping.occupancy_grid import OCCUPIED, StateGrid
from slam.measurements import FloatArray
from slam.simulation.true_grid import TrueGrid

Cells: TypeAlias = NDArray[np.bool_]
# A map cannot contain walls behind a door that the robot never passed.
REACH_M = 4.0
_AROUND = np.ones((3, 3), dtype=bool)


def read_true_grid(path: Path) -> TrueGrid:
    """Read a ground truth grid written by the simulator.

    Raises
    ------
    EvaluationError
        If it cannot be read.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            corner = file["origin_xy"]
            return TrueGrid(
                file["occupied"].astype(bool),
                float(file["resolution_m"]),
                (float(corner[0]), float(corner[1])),
                file["obstacle_id"],
            )
    except (OSError, ValueError, KeyError, BadZipFile) as error:
        raise EvaluationError(f"cannot read the true grid {path}: {error}") from error


def map_scores(
    grid: StateGrid, truth: TrueGrid, T_true_map: FloatArray, true_xy: FloatArray
) -> dict[str, float]:
    """Completeness, share of false cells, and F1 of the occupied cells.

    Completeness: share of the true cells next to the floor connected to the robot's path, at most `REACH_M`
    from the path, that are within one cell of a mapped one. False: share of the mapped cells that are farther
    than one cell from any true one. F1: harmonic mean of completeness and the share that is not false.

    Parameters
    ----------
    T_true_map
        (4, 4) rigid transform from the map to the ground truth, from the alignment of the trajectories.
    true_xy
        (N, 2) true path of the robot.
    """
    inside, outside = on_truth(grid, truth, T_true_map)
    visible = to_be_seen(truth, true_xy)
    near_true = ndimage.binary_dilation(truth.occupied, _AROUND)
    near_found = ndimage.binary_dilation(inside, _AROUND)
    count = int(inside.sum()) + outside
    right = int((inside & near_true).sum())
    completeness = float((visible & near_found).sum() / max(visible.sum(), 1))
    precision = right / max(count, 1)
    f1 = 2.0 * precision * completeness / max(precision + completeness, 1e-9)
    return {"completeness": completeness, "false_occupied": 1.0 - precision if count else 0.0, "f1": f1}


def on_truth(grid: StateGrid, truth: TrueGrid, T_true_map: FloatArray) -> tuple[Cells, int]:
    """Bring the occupied cells of a map, by their centres, onto the truth's lattice; count those outside."""
    rows, cols = np.nonzero(grid.states == OCCUPIED)
    corner = grid.T_map_grid
    c, s = np.cos(corner.theta()), np.sin(corner.theta())
    x, y = (cols + 0.5) * grid.resolution_m, (rows + 0.5) * grid.resolution_m
    points = np.column_stack([corner.x() + c * x - s * y, corner.y() + s * x + c * y, np.zeros(x.size)])
    points = points @ T_true_map[:3, :3].T + T_true_map[:3, 3]
    return _laid(truth, points[:, :2])


def _laid(truth: TrueGrid, points_xy: FloatArray) -> tuple[Cells, int]:
    """The cells of the truth's lattice that hold points (N, 2), and how many points lie outside it."""
    cells = np.floor((points_xy - truth.origin_xy) / truth.resolution_m).astype(int)
    within = ((cells >= 0) & (cells < truth.occupied.shape[::-1])).all(axis=1)
    inside = np.zeros(truth.occupied.shape, dtype=bool)
    inside[cells[within, 1], cells[within, 0]] = True
    return inside, int(np.count_nonzero(~within))


def to_be_seen(truth: TrueGrid, true_xy: FloatArray) -> Cells:
    """True cells next to the floor that is connected to the robot's path, and close enough to the path.

    No sensor sees the inside of a wardrobe, so a map can only contain its faces.
    """
    labels, _ = ndimage.label(~truth.occupied)
    passed, _ = _laid(truth, true_xy)
    driven = np.unique(labels[passed])
    floor = np.isin(labels, driven[driven > 0])
    if not passed.any():
        return np.zeros_like(passed)
    in_reach = ndimage.distance_transform_edt(~passed) * truth.resolution_m <= REACH_M
    return np.asarray(truth.occupied & ndimage.binary_dilation(floor, _AROUND) & in_reach)
