"""Finished map of a floor: lidar and depth layers, their Bayesian fusion, and the decision (Li2020)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import gtsam
import numpy as np

from fusion import bayes
from fusion.estimation import TINY
from slam.errors import ScanweaveError
from slam.mapping.evidence_tiles import SIDE, union
from slam.mapping.occupancy_grid import THRESHOLDS, OccupancyGrid, StateArray, StateGrid, Steps, Thresholds
from slam.mapping.ray_tracing import Box
from slam.measurements import BoolArray, FloatArray

# Names of grids in a map: the lidar's static grid, removed objects, and the depth cameras' grid.
OCCUPANCY, PASSED_BY, DEPTH = "occupancy", "passed by", "depth layer"

LayerName: TypeAlias = Literal["lidar", "depth", "fused", "decision"]

LAYERS: tuple[LayerName, ...] = ("lidar", "depth", "fused", "decision")


@dataclass(frozen=True, slots=True)
class DecisionRule:
    """How the layers are combined to the navigation map.

    Attributes
    ----------
    rule
        Rule of `fusion.bayes.decide`; if one sensor has no data, the other decides alone.
    lidar, depth, fused
        Thresholds of Li2020 Eq. (9) for each layer. If a camera supports the decision, those of the lidar are
        symmetric: one hit from afar, which noise spreads over several cells, is not yet a wall.
    """

    rule: bayes.Rule = "cautious"
    lidar: Thresholds = field(default_factory=lambda: Thresholds(1.0 - THRESHOLDS.free_below))
    depth: Thresholds = field(default_factory=Thresholds)
    fused: Thresholds = field(default_factory=Thresholds)


@dataclass(frozen=True, slots=True)
class LayeredMap:
    """The grids of both sensors, with the same cell positions, and their combination.

    Attributes
    ----------
    lidar, depth
        Grid of the sensor, or None if it has no data; at least one is given.
    """

    lidar: OccupancyGrid | None
    depth: OccupancyGrid | None
    rule: DecisionRule = field(default_factory=DecisionRule)

    def __post_init__(self) -> None:
        """Check that the cells of both grids have the same positions.

        Raises
        ------
        ScanweaveError
            If there is no grid, or the cells of one do not cover cells of the other.
        """
        if self.lidar is None and self.depth is None:
            raise ScanweaveError("no reading was given to build a map from; does the log hold any?")
        for grid in self._grids():
            offset = _corner(grid, self.resolution_m) - self._phase
            offset = np.abs(offset - np.round(offset))
            turned = abs(grid.T_map_grid.theta() - self.yaw_rad)
            if grid.resolution_m != self.resolution_m or max(offset.max(), turned) > TINY:
                raise ScanweaveError(
                    f"the grids of lidar and depth have misaligned cells: cells of {grid.resolution_m:g} "
                    f"and {self.resolution_m:g} m, {offset.max():.3f} of a cell apart; make the map anew"
                )

    @property
    def resolution_m(self) -> float:
        """Side of a cell."""
        return self._grids()[0].resolution_m

    @property
    def yaw_rad(self) -> float:
        """Direction of the grids' x axes in the map."""
        return float(self._grids()[0].T_map_grid.theta())

    @property
    def names(self) -> tuple[LayerName, ...]:
        """Names of the layers to show; none if the lidar grid is the map itself."""
        if self.depth is None:
            return ()
        return LAYERS if self.lidar is not None else LAYERS[1:]

    @property
    def box(self) -> Box:
        """First row, first col, rows, cols of the box that contains both grids."""
        boxes = [self._box(grid) for grid in self._grids()]
        return union(boxes[0], boxes[-1])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.box[2:]

    @property
    def T_map_grid(self) -> gtsam.Pose2:
        """Pose of the lower-left corner of cell (0, 0)."""
        row, col = (self.box[:2] + self._phase).tolist()
        corner = gtsam.Pose2(col * self.resolution_m, row * self.resolution_m, 0.0)
        return gtsam.Pose2(0.0, 0.0, self.yaw_rad).compose(corner)

    def grid(self, name: Literal["lidar", "depth", "fused"]) -> OccupancyGrid:
        """Return a probability layer of the map; ``fused`` is Li2020 Eq. (10), the sum of both log-odds."""
        steps = np.empty(self.shape, dtype=np.int16)
        for part in _blocks(self.shape):
            steps[part] = self._steps(name, part)
        return OccupancyGrid(steps, self.resolution_m, self.T_map_grid)

    def states(self, name: LayerName) -> StateArray:
        """Return (rows, cols) of 100, 0 and -1: a layer with its own thresholds, or the combined decision.

        The decision shows what the robot must not hit.
        """
        states = np.empty(self.shape, dtype=np.int8)
        # Without a camera, only the lidar's height and its hits are known.
        rule = self.rule if self.depth is not None else DecisionRule("corrected", Thresholds())
        for part in _blocks(self.shape):
            if name == "decision":
                lidar = rule.lidar.states(self._steps("lidar", part))
                depth = rule.depth.states(self._steps("depth", part))
                states[part] = bayes.decide(lidar, depth, rule.rule)
            else:
                own: Thresholds = getattr(rule, name)
                states[part] = own.states(self._steps(name, part))
        return states

    def decision(self) -> StateGrid:
        """Return the combined decision and where it lies."""
        return StateGrid(self.states("decision"), self.resolution_m, self.T_map_grid)

    def free_at_lidar_height(self) -> BoolArray:
        """Return (rows, cols) cells free for the lidar that no camera saw at all heights of the robot.

        They are unknown in a ``cautious`` decision. Without a camera there are none.
        """
        free = np.zeros(self.shape, dtype=np.bool_)
        if self.lidar is not None and self.depth is not None:
            for part in _blocks(self.shape):
                lidar = self.rule.lidar.states(self._steps("lidar", part))
                depth = self.rule.depth.states(self._steps("depth", part))
                free[part] = (lidar == bayes.FREE) & (depth == bayes.UNKNOWN)
        return free

    def percent(self) -> StateArray:
        """Return (rows, cols) fused probability in percent, -1 if it is one half, which means unknown."""
        percent = np.empty(self.shape, dtype=np.int8)
        for part in _blocks(self.shape):
            steps = self._steps("fused", part)
            odds = np.exp(steps / np.float32(-bayes.STEPS_A_UNIT))
            percent[part] = np.where(steps == 0, bayes.UNKNOWN, np.rint(100.0 / (1.0 + odds)))
        return percent

    def _grids(self) -> list[OccupancyGrid]:
        """Return the existing grids."""
        return [grid for grid in (self.lidar, self.depth) if grid is not None]

    @property
    def _phase(self) -> FloatArray:
        """Return (2,) the offset of the lattice from the map's origin, in cells."""
        corner = _corner(self._grids()[0], self.resolution_m)
        phase = corner - np.round(corner)
        return np.where(np.abs(phase) > TINY, phase, 0.0)

    def _box(self, grid: OccupancyGrid) -> Box:
        """Return first row, first col, rows, cols of a grid on the lattice."""
        corner = _corner(grid, grid.resolution_m) - self._phase
        row, col = np.round(corner).astype(int).tolist()
        return row, col, *grid.shape

    def _steps(self, name: LayerName, part: slice) -> Steps:
        """Return some rows of a layer; a missing sensor is unknown everywhere."""
        chosen = {"lidar": (self.lidar,), "depth": (self.depth,)}.get(name, (self.lidar, self.depth))
        first_row, first_col, _, cols = self.box
        total = np.zeros((part.stop - part.start, cols), dtype=np.int16)
        for grid in chosen:
            if grid is not None:
                row, col, rows, width = self._box(grid)
                top = row - first_row
                low, high = max(part.start, top), min(part.stop, top + rows)
                if low < high:
                    left = col - first_col
                    total[low - part.start : high - part.start, left : left + width] += grid.steps[
                        low - top : high - top
                    ]
        return total


def _corner(grid: OccupancyGrid, resolution_m: float) -> FloatArray:
    """Return (2,) row and column of a grid's corner, in cells from the map's origin."""
    at = gtsam.Pose2(0.0, 0.0, grid.T_map_grid.theta()).between(grid.T_map_grid)
    return np.array([at.y(), at.x()]) / resolution_m


def _blocks(shape: tuple[int, int]) -> Iterator[slice]:
    """Yield blocks of rows that are small compared with the map."""
    most = max(1, SIDE * SIDE // max(shape[1], 1))
    return (slice(first, min(first + most, shape[0])) for first in range(0, shape[0], most))
