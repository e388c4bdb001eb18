"""The occupancy grid, Li2020 Eq. (7)-(9): log-odds of every cell in integer steps."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.bayes import FREE, OCCUPIED, STEPS_A_UNIT, UNKNOWN, log_odds
from fusion.showing import shrunk, with_pictures
from slam.errors import ConfigError
from slam.measurements import BoolArray, Float32Array, FloatArray, numbers_of, one_line

__all__ = ["FREE", "OCCUPIED", "UNKNOWN"]

StateArray: TypeAlias = NDArray[np.int8]
Steps: TypeAlias = NDArray[np.int16]
_Cell = TypeVar("_Cell", bound=np.generic)


@dataclass(frozen=True, slots=True)
class StateGrid:
    """A grid of (rows, cols) states, row 0 at the lowest y, and the lower-left corner of cell (0, 0)."""

    states: StateArray
    resolution_m: float
    T_map_grid: gtsam.Pose2


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Thresholds of Li2020 Eq. (9): cells between them are uncertain. Each sensor has its own."""

    occupied_above: float = 0.5
    free_below: float = 0.4

    def __post_init__(self) -> None:
        if not 0.0 < self.free_below <= self.occupied_above < 1.0:
            raise ConfigError(
                f"thresholds free_below={self.free_below:g} occupied_above={self.occupied_above:g}: "
                "needs 0 < free_below <= occupied_above < 1"
            )

    def states(self, steps: Steps) -> StateArray:
        """Return the states of cells from their log-odds steps."""
        states = np.full(steps.shape, UNKNOWN, dtype=np.int8)
        states[self.occupied(steps)] = OCCUPIED
        states[steps < log_odds(self.free_below) * STEPS_A_UNIT] = FREE
        return states

    def occupied(self, steps: Steps) -> BoolArray:
        """Return which cells are occupied, from their log-odds steps."""
        return np.asarray(steps > log_odds(self.occupied_above) * STEPS_A_UNIT)


THRESHOLDS = Thresholds()


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """An occupancy grid map of square cells.

    Attributes
    ----------
    steps
        (rows, cols) log-odds of occupancy in steps of 1 / `fusion.bayes.STEPS_A_UNIT`; row 0 has the
        lowest y, 0 is unknown (Li2020 Eq. (7): P = 0.5).
    resolution_m
        Side of a cell.
    T_map_grid
        Pose of the lower-left corner of cell (0, 0); columns run along its x axis, rows along its y axis.

    Examples
    --------
    >>> import numpy as np, slam
    >>> log_odds = np.array([[2.0, -2.0, 0.0]], np.float32)  # a wall, free, unknown
    >>> grid = slam.OccupancyGrid.of_log_odds(log_odds, resolution_m=0.05)
    >>> grid.shape, grid.states().tolist(), grid.log_odds.tolist()
    ((1, 3), [[100, 0, -1]], [[2.0, -2.0, 0.0]])
    """

    steps: Steps
    resolution_m: float
    T_map_grid: gtsam.Pose2 = field(default_factory=lambda: gtsam.Pose2())

    __repr__ = one_line

    def _repr_html_(self) -> str:
        return with_pictures(self, self.picture())

    @classmethod
    def of_log_odds(
        cls, log_odds: Float32Array, resolution_m: float, T_map_grid: gtsam.Pose2 | None = None
    ) -> OccupancyGrid:
        """Create a grid from (rows, cols) log-odds, rounded to steps."""
        steps = np.rint(log_odds * np.float32(STEPS_A_UNIT)).astype(np.int16)
        return cls(steps, resolution_m, T_map_grid or gtsam.Pose2())

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns."""
        rows, cols = self.steps.shape
        return rows, cols

    @property
    def log_odds(self) -> Float32Array:
        """(rows, cols) log-odds of occupancy."""
        return np.asarray(self.steps / np.float32(STEPS_A_UNIT))

    def probabilities(self) -> Float32Array:
        """Return the (rows, cols) occupancy probability.

        Examples
        --------
        >>> import numpy as np, slam
        >>> slam.OccupancyGrid.of_log_odds(np.zeros((1, 1), np.float32), 0.05).probabilities().tolist()
        [[0.5]]
        """
        half = np.float32(0.5)
        probabilities: Float32Array = half + half * np.tanh(half * self.log_odds)
        return probabilities

    def states(self, thresholds: Thresholds = THRESHOLDS) -> StateArray:
        """Return (rows, cols) of OCCUPIED, FREE and UNKNOWN."""
        return thresholds.states(self.steps)

    def picture(self, way_map: FloatArray | None = None) -> NDArray[np.uint8]:
        """Draw a small image (H, W, 3), y up: walls black, free cells white, (N, 2) points of a path blue.

        Examples
        --------
        >>> import numpy as np, slam
        >>> grid = slam.OccupancyGrid.of_log_odds(np.array([[3.0, -3.0, 0.0]], np.float32), 0.05)
        >>> grid.picture()[0, :, 0].tolist()  # black, white, grey
        [0, 255, 205]
        """
        shades = np.select([self.states() == OCCUPIED, self.states() == FREE], [0, 255], 205)
        drawing = np.repeat(shades.astype(np.uint8)[..., None], 3, axis=2)
        if way_map is not None:
            cells = self.cells_of(way_map)
            row, col = cells[((cells >= 0) & (cells < self.shape)).all(axis=1)].T
            drawing[row, col] = 0, 0, 255
        return shrunk(drawing[::-1])

    def cells_of(self, points_map: FloatArray) -> NDArray[np.int64]:
        """Return (N, 2) row and column of (N, 2) points; they may lie outside the grid.

        Examples
        --------
        >>> import gtsam, numpy as np, slam
        >>> grid = slam.OccupancyGrid(np.zeros((40, 60), np.int16), 0.1, gtsam.Pose2(-3.0, -2.0, 0.0))
        >>> grid.cells_of(np.array([[0.0, 0.0], [-2.95, 1.0]])).tolist()  # row and column
        [[20, 30], [30, 0]]
        """
        points_map = numbers_of(points_map, (None, 2), "points_map")
        points_grid = _to_frame(points_map, self.T_map_grid) / self.resolution_m
        return np.floor(points_grid[:, ::-1]).astype(np.int64)


def _to_frame(points: FloatArray, T_a_b: gtsam.Pose2) -> FloatArray:
    """Transform (N, 2) points from frame a to frame b."""
    cosine, sine = math.cos(T_a_b.theta()), math.sin(T_a_b.theta())
    moved = np.asarray(points, dtype=np.float64) - [T_a_b.x(), T_a_b.y()]
    turned: FloatArray = moved @ np.array([[cosine, -sine], [sine, cosine]])
    return turned


def looked_up(picture: NDArray[_Cell], cells: NDArray[np.int64], outside: Any = 0) -> NDArray[_Cell]:
    """Look up (N,) values of an image at (N, 2) rows and columns, which may lie outside of it."""
    inside = ((cells >= 0) & (cells < picture.shape)).all(axis=1)
    values = np.full(len(cells), outside, picture.dtype)
    values[inside] = picture[cells[inside, 0], cells[inside, 1]]
    return values
