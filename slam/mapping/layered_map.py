"""Finished map of a floor: lidar and depth layers, their Bayesian fusion, and the decision (Li2020)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import gtsam
import numpy as np

from fusion import bayes
from fusion.estimation import TINY
from slam.errors import ConfigError, ScanweaveError
from slam.mapping.evidence_tiles import SIDE, union
from slam.mapping.occupancy_grid import THRESHOLDS, OccupancyGrid, StateArray, Steps, Thresholds
from slam.mapping.ray_tracing import Box
from slam.measurements import BoolArray, FloatArray

# Names of grids in a map: the lidar's of what stays, what has gone, the depth cameras'.
OCCUPANCY, PASSED_BY, DEPTH = "occupancy", "passed by", "depth layer"

LayerName: TypeAlias = Literal["lidar", "depth", "fused", "decision"]

LAYERS: tuple[LayerName, ...] = ("lidar", "depth", "fused", "decision")


@dataclass(frozen=True, slots=True)
class DecisionRule:
    """How the layers become the map to drive by.

    Attributes
    ----------
    rule
        Of `fusion.bayes.decide`; where one sensor gave nothing, the other decides alone.
    lidar, depth, fused
        Li2020 Eq. (9) for each layer. Where a camera helps to decide, the lidar's is as certain of obstacles
        as of free space: what one beam met from afar, where noise spreads it over cells, is no wall yet.
    """

    rule: bayes.Rule = "cautious"
    lidar: Thresholds = field(default_factory=lambda: Thresholds(1.0 - THRESHOLDS.free_below))
    depth: Thresholds = field(default_factory=Thresholds)
    fused: Thresholds = field(default_factory=Thresholds)

    def __post_init__(self) -> None:
        if self.rule not in bayes.RULES:
            raise ConfigError(f"rule is {self.rule!r}; it must be {', '.join(bayes.RULES)}")


@dataclass(frozen=True, slots=True)
class LayeredMap:
    """The grids of both sensors, which lie on one lattice, and what they make together.

    Attributes
    ----------
    lidar, depth
        None where the sensor gave nothing; not both.
    rule
        How they are read.
    """

    lidar: OccupancyGrid | None
    depth: OccupancyGrid | None
    rule: DecisionRule = field(default_factory=DecisionRule)

    def __post_init__(self) -> None:
        """Refuse grids that do not lie on one lattice.

        Raises
        ------
        ScanweaveError
            Where there is no grid, or cells of one do not cover cells of the other.
        """
        if self.lidar is None and self.depth is None:
            raise ScanweaveError("no reading was given to build a map from; does the log hold any?")
        for grid in self._grids():
            apart = _corner(grid, self.resolution_m) - self._phase
            apart = np.abs(apart - np.round(apart))
            turned = abs(grid.T_map_grid.theta() - self.yaw_rad)
            if grid.resolution_m != self.resolution_m or max(apart.max(), turned) > TINY:
                raise ScanweaveError(
                    f"the grids of lidar and depth do not lie on one lattice: cells of {grid.resolution_m:g} "
                    f"and {self.resolution_m:g} m, {apart.max():.3f} of a cell apart; make the map anew"
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
        """The layers that are worth a look; none where the lidar's grid is the map itself."""
        if self.depth is None:
            return ()
        return LAYERS if self.lidar is not None else LAYERS[1:]

    @property
    def box(self) -> Box:
        """First row, first col, rows, cols of what holds both grids, on their lattice."""
        boxes = [self._box(grid) for grid in self._grids()]
        return union(boxes[0], boxes[-1])

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.box[2:]

    @property
    def T_map_grid(self) -> gtsam.Pose2:
        """The lower-left corner of cell (0, 0)."""
        row, col = (self.box[:2] + self._phase).tolist()
        corner = gtsam.Pose2(col * self.resolution_m, row * self.resolution_m, 0.0)
        return gtsam.Pose2(0.0, 0.0, self.yaw_rad).compose(corner)

    def grid(self, name: Literal["lidar", "depth", "fused"]) -> OccupancyGrid:
        """A probability layer over the whole map; ``fused`` is Li2020 Eq. (10), the sum of both log-odds."""
        steps = np.empty(self.shape, dtype=np.int16)
        for part in _blocks(self.shape):
            steps[part] = self._steps(name, part)
        return OccupancyGrid(steps, self.resolution_m, self.T_map_grid)

    def states(self, name: LayerName) -> StateArray:
        """(rows, cols) of 100, 0 and -1: a layer by its own thresholds, or what they decide together.

        The decision is what the robot must not hit.
        """
        states = np.empty(self.shape, dtype=np.int8)
        # Where no camera helped, the lidar's height and its every hit are all that there is.
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

    def free_at_lidar_height(self) -> BoolArray:
        """(rows, cols) cells that the lidar calls free and no camera saw at all heights of the robot.

        Unknown in a ``cautious`` decision. Nothing where no camera helped.
        """
        free = np.zeros(self.shape, dtype=np.bool_)
        if self.lidar is not None and self.depth is not None:
            for part in _blocks(self.shape):
                lidar = self.rule.lidar.states(self._steps("lidar", part))
                depth = self.rule.depth.states(self._steps("depth", part))
                free[part] = (lidar == bayes.FREE) & (depth == bayes.UNKNOWN)
        return free

    def percent(self) -> StateArray:
        """(rows, cols) fused probability in percent, -1 where it is one half, which is unknown."""
        percent = np.empty(self.shape, dtype=np.int8)
        for part in _blocks(self.shape):
            steps = self._steps("fused", part)
            odds = np.exp(steps / np.float32(-bayes.STEPS_A_UNIT))
            percent[part] = np.where(steps == 0, bayes.UNKNOWN, np.rint(100.0 / (1.0 + odds)))
        return percent

    def _grids(self) -> list[OccupancyGrid]:
        """Those that there are."""
        return [grid for grid in (self.lidar, self.depth) if grid is not None]

    @property
    def _phase(self) -> FloatArray:
        """(2,) part of a cell by which the lattice misses the map's origin: a map of another program may."""
        corner = _corner(self._grids()[0], self.resolution_m)
        apart = corner - np.round(corner)
        return np.where(np.abs(apart) > TINY, apart, 0.0)

    def _box(self, grid: OccupancyGrid) -> Box:
        """First row, first col, rows, cols of a grid on the lattice."""
        corner = _corner(grid, grid.resolution_m) - self._phase
        row, col = np.round(corner).astype(int).tolist()
        return row, col, *grid.shape

    def _steps(self, name: LayerName, part: slice) -> Steps:
        """Some rows of a layer; a missing sensor is unknown everywhere."""
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
    """(2,) row and column of a grid's corner, in cells from the map's origin."""
    at = gtsam.Pose2(0.0, 0.0, grid.T_map_grid.theta()).between(grid.T_map_grid)
    return np.array([at.y(), at.x()]) / resolution_m


def _blocks(shape: tuple[int, int]) -> Iterator[slice]:
    """Rows in pieces that are small against the map."""
    most = max(1, SIDE * SIDE // max(shape[1], 1))
    return (slice(first, min(first + most, shape[0])) for first in range(0, shape[0], most))
