"""A map to drive by against the true plan of a home, as a robot would judge it: by driving over it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from slam.comparison.map_score import REACH_M, map_scores, read_true_grid
from slam.comparison.product import StateGrid
from slam.evaluation.trajectory_error import absolute_error
from slam.mapping.navigation import FreeSpace, clearance_m, free_space, shortest_path
from slam.mapping.occupancy_grid import FREE, OCCUPIED
from slam.measurements import FloatArray, Trajectory
from slam.storage.tum import read_tum

Bools = NDArray[np.bool_]
_HARD_M = 0.10  # nearer to an obstacle than this with its middle the robot has not brushed it but hit it
_EVERY = 5  # poses of the trajectory of which one may be a start


class PlanScorer:
    """The truth of one drive, and plans over maps of it.

    Parameters
    ----------
    drive
        Folder of a simulated drive.
    radius_m
        Of the robot.
    plans
        So many random plans a map, from the robot's way to anywhere that the map says it can reach.
    """

    def __init__(self, drive: Path, radius_m: float = 0.25, plans: int = 200) -> None:
        self._truth = read_true_grid(drive / "truth" / "grid_robot.npz")
        self._way = read_tum(drive / "groundtruth.txt")
        self._radius_m, self._plans = radius_m, plans
        resolution = self._truth.resolution_m
        states = np.where(self._truth.occupied, OCCUPIED, FREE).astype(np.int8)
        self._clearance = clearance_m(states, resolution)
        region, _ = ndimage.label(self._clearance >= radius_m)
        way = self._cells(self._way.positions_m[:, :2])
        on = np.unique(region[way[:, 0], way[:, 1]])
        self._reachable: Bools = np.isin(region, on[on > 0])
        driven = np.zeros(region.shape, dtype=bool)
        driven[way[:, 0], way[:, 1]] = True
        self._near = ndimage.distance_transform_edt(~driven) * resolution <= REACH_M

    def score(self, found: StateGrid, trajectory: Trajectory) -> dict[str, float]:
        """What a robot meets, and finds.

        Returns
        -------
        ``collide``: share of the plans on which the robot's disc covers a truly occupied cell by more than a
        cell. ``collide_hard``: its middle comes nearer than 0.1 m to one. ``reach``: of the floor where it
        can truly go, what the map says that it can reach; ``reach_near``: of that, within 4 m of its way.
        ``danger``: truly occupied cells that the map calls free. And `map_scores`.
        """
        T_true_map = absolute_error(trajectory, self._way).T_reference_map
        scores = map_scores(found, self._truth, T_true_map, self._way.positions_m[:, :2])
        space = free_space(found.states, found.resolution_m, found.T_map_grid, self._radius_m)
        free = self._laid(space, np.argwhere(found.states == FREE), T_true_map)
        scores["danger"] = float(self._at(self._truth.occupied, free).sum())
        starts = np.array([space.cell_of((x, y)) for x, y in trajectory.positions_m[::_EVERY, :2]])
        starts = np.unique(starts[((starts >= 0) & (starts < space.allowed.shape)).all(axis=1)], axis=0)
        starts = starts[space.allowed[starts[:, 0], starts[:, 1]]]
        regions = np.unique(space.region[starts[:, 0], starts[:, 1]])
        goals = np.argwhere(np.isin(space.region, regions) & space.allowed)
        self._score_reach(self._laid(space, goals, T_true_map), scores)
        self._score_plans(space, starts, goals, T_true_map, scores)
        return scores

    def _score_reach(self, laid: NDArray[np.int64], scores: dict[str, float]) -> None:
        """Share of the true free space."""
        for name, wanted in (("reach", self._reachable), ("reach_near", self._reachable & self._near)):
            scores[name] = float(self._at(wanted, laid).sum() / max(wanted.sum(), 1))

    def _score_plans(
        self,
        space: FreeSpace,
        starts: NDArray[np.int64],
        goals: NDArray[np.int64],
        T_true_map: FloatArray,
        scores: dict[str, float],
    ) -> None:
        """Drive random plans over the truth; ``nan`` where the map leads nowhere."""
        random = np.random.default_rng(0)
        nearest = []
        for _ in range(self._plans if len(starts) else 0):
            start = starts[random.integers(len(starts))]
            same = goals[space.region[goals[:, 0], goals[:, 1]] == space.region[start[0], start[1]]]
            ends = space.middle_of(np.array([start, same[random.integers(len(same))]]))
            path = shortest_path(space, tuple(ends[0]), tuple(ends[1]), np.zeros(space.allowed.shape))
            assert path is not None  # both are of one region
            points = np.column_stack([path.points_map, np.zeros(len(path.points_map))])
            laid = self._cells((points @ T_true_map[:3, :3].T + T_true_map[:3, 3])[:, :2], keep=True)
            nearest.append(float(self._at(self._clearance, laid).min()))
        away = np.array(nearest) if nearest else np.array([np.nan])
        brushed = self._radius_m - self._truth.resolution_m - 1e-9
        for name, limit in (("collide", brushed), ("collide_hard", _HARD_M)):
            scores[name] = float(np.where(np.isnan(away), np.nan, away < limit).mean())

    def _laid(self, space: FreeSpace, cells: NDArray[np.int64], T_true_map: FloatArray) -> NDArray[np.int64]:
        """Cells of a map in the truth's lattice; what falls outside it is beyond its walls."""
        points = space.middle_of(cells)
        points = np.column_stack([points, np.zeros(len(points))]) @ T_true_map[:3, :3].T + T_true_map[:3, 3]
        return self._cells(points[:, :2], keep=True)

    def _cells(self, xy: FloatArray, *, keep: bool = False) -> NDArray[np.int64]:
        """(N, 2) rows and columns of points; those outside are left out, or kept as they are."""
        cells = np.floor((xy - self._truth.origin_xy) / self._truth.resolution_m).astype(np.int64)[:, ::-1]
        if keep:
            return cells
        return cells[((cells >= 0) & (cells < self._truth.occupied.shape)).all(axis=1)]

    def _at(self, values: NDArray[np.generic], cells: NDArray[np.int64]) -> FloatArray:
        """Values at cells, 0 outside: neither free nor far from anything."""
        inside = ((cells >= 0) & (cells < values.shape)).all(axis=1)
        found = np.zeros(len(cells))
        found[inside] = values[cells[inside, 0], cells[inside, 1]]
        return found
