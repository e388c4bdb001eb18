"""Compares a navigation map with the true plan of a home by planning and driving on it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slam.comparison.map_score import REACH_M, Cells
from slam.mapping.navigation import FreeSpace, clearance_m, free_space, shortest_path
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateGrid
from slam.measurements import FloatArray
from slam.simulation.rigs import RIGS
from slam.simulation.true_grid import TrueGrid

_PLANS = 200  # per map
_HARD_M = 0.10  # if its centre is closer to an obstacle, the robot has hit it, not only touched it
_EVERY = 5  # every fifth pose of the trajectory may be a start


def robot_radius_m(truth: Path) -> float | None:
    """Radius of the robot of a ground truth folder; None if the folder does not contain it."""
    try:
        return RIGS[json.loads((truth / "faults.json").read_text(encoding="utf-8"))["rig"]].robot_radius_m
    except (OSError, ValueError, KeyError, TypeError):
        return None


def plan_scores(
    grid: StateGrid,
    truth: TrueGrid,
    T_true_map: FloatArray,
    true_xy: FloatArray,
    map_xy: FloatArray,
    radius_m: float,
) -> dict[str, float]:
    """Collisions and reach of a robot that navigates by the map.

    Parameters
    ----------
    T_true_map
        (4, 4) rigid transform from the map to the ground truth.
    true_xy, map_xy
        (N, 2) path of the robot, true and in the map.
    radius_m
        Radius of the robot.

    Returns
    -------
    ``collide``: share of random plans, from the path to cells that are reachable by the map, on which the
    disc of the robot covers a truly occupied cell by more than a cell; ``collide_hard``: its centre comes
    closer than 0.1 m to one; both absent if nothing is reachable. ``reach``: share of the truly reachable
    floor that is reachable by the map; ``reach_near``: the same within 4 m of its path. ``danger``: truly
    occupied cells that are free in the map.
    """
    resolution = truth.resolution_m
    clearance = clearance_m(np.where(truth.occupied, OCCUPIED, FREE).astype(np.int8), resolution)
    region, _ = ndimage.label(clearance >= radius_m)
    path_cells = _cells(true_xy, truth)
    driven = np.zeros(region.shape, dtype=bool)
    driven[tuple(path_cells[_inside(path_cells, region.shape)].T)] = True
    reachable: Cells = np.isin(region, np.setdiff1d(region[driven], 0))
    in_reach = ndimage.distance_transform_edt(~driven) * resolution <= REACH_M

    space = free_space(grid.states, grid.resolution_m, grid.T_map_grid, radius_m)
    starts = np.unique([space.cell_of((x, y)) for x, y in map_xy[::_EVERY]], axis=0)
    starts = starts[_inside(starts, space.allowed.shape)]
    starts = starts[space.allowed[tuple(starts.T)]]
    goals = np.argwhere(np.isin(space.region, space.region[tuple(starts.T)]) & space.allowed)

    def at(values: NDArray[np.generic], cells: NDArray[np.int64]) -> FloatArray:
        """Values of the ground truth at cells of the map, 0 outside: not free, at distance 0."""
        points = space.middle_of(cells) @ T_true_map[:2, :2].T + T_true_map[:2, 3]
        true_cells = _cells(points, truth)
        inside = _inside(true_cells, values.shape)
        sampled = np.zeros(len(cells))
        sampled[inside] = values[tuple(true_cells[inside].T)]
        return sampled

    scores = {
        name: float(at(reference, goals).sum() / max(reference.sum(), 1))
        for name, reference in (("reach", reachable), ("reach_near", reachable & in_reach))
    }
    scores["danger"] = float(at(truth.occupied, np.argwhere(grid.states == FREE)).sum())
    if len(starts):
        least_m = np.array([at(clearance, plan).min() for plan in _plans(space, starts, goals)])
        scores["collide"] = float((least_m < radius_m - resolution - 1e-9).mean())
        scores["collide_hard"] = float((least_m < _HARD_M).mean())
    return scores


def _plans(space: FreeSpace, starts: NDArray[np.int64], goals: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """(N, 2) cells of random plans, each in one region."""
    random, plans = np.random.default_rng(0), []
    for _ in range(_PLANS):
        start = starts[random.integers(len(starts))]
        same = goals[space.region[tuple(goals.T)] == space.region[tuple(start)]]
        ends = space.middle_of(np.array([start, same[random.integers(len(same))]]))
        path = shortest_path(space, tuple(ends[0]), tuple(ends[1]))
        assert path is not None  # both are in one region
        plans.append(np.array([space.cell_of((x, y)) for x, y in path.points_map]))
    return plans


def _cells(xy: FloatArray, truth: TrueGrid) -> NDArray[np.int64]:
    """(N, 2) rows and columns of points in the frame of the ground truth."""
    return np.floor((xy - truth.origin_xy) / truth.resolution_m).astype(np.int64)[:, ::-1]


def _inside(cells: NDArray[np.int64], shape: tuple[int, ...]) -> Cells:
    """(N,) whether cells are inside a grid."""
    return np.asarray(((cells >= 0) & (cells < shape)).all(axis=1))
