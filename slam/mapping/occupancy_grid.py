"""The log-odds occupancy grid, and how it is built from scans at known poses: Li2020 Eq. (1), (7), (8)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.errors import ConfigError, ScanweaveError
from slam.mapping.ray_tracing import Box, add_evidence, beam_ends, draw_scan
from slam.measurements import Float32Array, FloatArray, LaserScan, one_line, row_from_pose2

StateArray: TypeAlias = NDArray[np.int8]

# The values of nav2's occupancy grid.
OCCUPIED = 100
UNKNOWN = -1
FREE = 0

DEFAULT_MAX_CELLS = 16_000_000
# Evidence is a multiple of this, so that float32 sums up to 16384 are exact, and the same in any order.
_LOG_ODDS_STEP = 1.0 / 1024.0
# Beyond these a number is damaged; below them cell numbers stay far from the end of the integers.
_MAX_POSITION_M = 1e7
_MAX_RANGE_M = 1e5


@dataclass(frozen=True, slots=True)
class InverseSensorModel:
    """What a scan tells about a cell: Ps in Li2020 Eq. (8).

    Attributes
    ----------
    p_hit, p_miss
        Probability that a cell is occupied when a beam of the scan ended in it, or passed it.
    p_min, p_max
        Bounds of the finished map. They leave a second sensor's grid a say in the fusion, Li2020 Eq. (10).
    max_hit_range_m
        A return from farther away is taken as no return.
    max_clear_range_m
        A beam without return clears up to here, but never beyond the sensor's own range: black and
        mirroring things give no return either, so it is less than the range up to which a return is believed.
    """

    p_hit: float = 0.7
    p_miss: float = 0.4
    p_min: float = 0.02
    p_max: float = 0.98
    max_hit_range_m: float = math.inf
    max_clear_range_m: float = 8.0

    def __post_init__(self) -> None:
        """Refuse a model that would mark what it clears.

        Raises
        ------
        ConfigError
            Where the probabilities are not p_min <= p_miss < 0.5 < p_hit <= p_max inside (0, 1), or a
            range is negative or not a number.
        """
        if not 0.0 < self.p_min <= self.p_miss < 0.5 < self.p_hit <= self.p_max < 1.0:
            raise ConfigError(
                f"sensor model p_min={self.p_min:g} p_miss={self.p_miss:g} p_hit={self.p_hit:g}"
                f" p_max={self.p_max:g}: needs 0 < p_min <= p_miss < 0.5 < p_hit <= p_max < 1"
            )
        if not (self.max_hit_range_m > 0.0 and 0.0 <= self.max_clear_range_m < math.inf):
            raise ConfigError(
                f"sensor model max_hit_range_m={self.max_hit_range_m:g} must be positive,"
                f" max_clear_range_m={self.max_clear_range_m:g} finite and not negative"
            )

    def evidence(self) -> tuple[float, float]:
        """Log-odds of a hit and of a miss, to 1/1024."""
        return _quantised_log_odds(self.p_hit), _quantised_log_odds(self.p_miss)


@dataclass(frozen=True, slots=True)
class OccupancyGrid:
    """A map of square cells.

    Attributes
    ----------
    log_odds
        (rows, cols) of being occupied; row 0 at the lowest y, 0 is unknown (Li2020 Eq. (7): P = 0.5).
    resolution_m
        Side of a cell.
    T_map_grid
        The lower-left corner of cell (0, 0); columns run along its x, rows along its y.
    """

    log_odds: Float32Array
    resolution_m: float
    T_map_grid: gtsam.Pose2 = field(default_factory=gtsam.Pose2)

    __repr__ = one_line

    def probabilities(self) -> Float32Array:
        """(rows, cols) probability of being occupied."""
        half = np.float32(0.5)
        probabilities: Float32Array = half + half * np.tanh(half * self.log_odds)
        return probabilities

    def states(self, occupied_above: float = 0.65, free_below: float = 0.35) -> StateArray:
        """(rows, cols) of OCCUPIED, FREE and UNKNOWN, by two bounds on the probability.

        With the default model a single hit marks a cell, and two misses free it: what stops a robot is
        believed sooner than what lets it pass. (Li2020 Eq. (9) with one bound is 0.5, 0.5.)

        Raises
        ------
        ConfigError
            Where the bounds are not 0 < free_below <= occupied_above < 1.
        """
        if not 0.0 < free_below <= occupied_above < 1.0:
            raise ConfigError(
                f"map bounds free_below={free_below:g} occupied_above={occupied_above:g} are out of order"
            )
        states = np.full(self.log_odds.shape, UNKNOWN, dtype=np.int8)
        states[self.log_odds > np.float32(_log_odds(occupied_above))] = OCCUPIED
        states[self.log_odds < np.float32(_log_odds(free_below))] = FREE
        return states

    def cells_of(self, points_map: FloatArray) -> NDArray[np.int64]:
        """(N, 2) row and column of (N, 2) points; they may lie outside the grid."""
        points_grid = _to_frame(points_map, self.T_map_grid) / self.resolution_m
        return np.floor(points_grid[:, ::-1]).astype(np.int64)


class PosedScan(NamedTuple):
    """A scan, and where its laser stood: ranges as in `LaserScan`, pose x, y, yaw in the map."""

    pose_xyt: FloatArray
    ranges_m: Float32Array
    start_angle_rad: float
    step_rad: float
    range_max_m: float

    @classmethod
    def of(cls, scan: LaserScan, T_map_base: gtsam.Pose2) -> PosedScan:
        """The scan of a laser mounted on a base at ``T_map_base``."""
        pose = row_from_pose2(T_map_base.compose(scan.T_base_laser))
        return cls(pose, scan.ranges_m, scan.start_angle_rad, scan.step_rad, scan.range_max_m)


class GridBuilder:
    """A grid that grows with the scans put into it; each is seen once and not kept.

    The evidence is summed without bounds and clamped only when the map is taken: clamping on the way would
    make the map depend on the order of the scans, which means nothing when a map is rebuilt from optimised
    poses. Cells lie on a lattice through the map's origin, whatever comes first.

    Parameters
    ----------
    resolution_m
        Side of a cell.
    model
        What a scan tells about a cell.
    axes_yaw_rad
        Direction of the grid's x axis in the map.
    max_cells
        Largest map; a guard of the memory (5 bytes a cell while building, twice that while growing).
    """

    def __init__(
        self,
        resolution_m: float,
        model: InverseSensorModel | None = None,
        *,
        axes_yaw_rad: float = 0.0,
        max_cells: int = DEFAULT_MAX_CELLS,
    ) -> None:
        if not 1e-4 <= resolution_m < math.inf:
            raise ConfigError(f"map resolution_m={resolution_m:g}: must be 0.0001 or more (0.05 is usual)")
        self._resolution_m = resolution_m
        self._model = model or InverseSensorModel()
        self._axes = gtsam.Pose2(0.0, 0.0, axes_yaw_rad)
        self._max_cells = max_cells
        self._log_odds: Float32Array = np.zeros((0, 0), dtype=np.float32)
        self._corner = (0, 0)
        self._used: Box | None = None

    def add(self, scan: PosedScan) -> None:
        """Add the evidence of one scan.

        Raises
        ------
        ScanweaveError
            Where the pose is not finite, or the map would exceed ``max_cells``; the map is as it was then.
        """
        pose = np.asarray(scan.pose_xyt, dtype=np.float64)
        if not (np.abs(pose) < _MAX_POSITION_M).all():
            raise ScanweaveError(
                f"cannot map a scan at pose {pose.tolist()}: not finite or farther than 1e7 m"
            )
        laser = self._axes.between(gtsam.Pose2(pose[0], pose[1], pose[2]))
        x_cells, y_cells = laser.x() / self._resolution_m, laser.y() / self._resolution_m
        ends, kinds, box = beam_ends(
            np.ascontiguousarray(scan.ranges_m, dtype=np.float32),
            x_cells,
            y_cells,
            laser.theta() + scan.start_angle_rad,
            float(scan.step_rad),
            1.0 / self._resolution_m,
            min(self._model.max_hit_range_m, scan.range_max_m, _MAX_RANGE_M),
            min(self._model.max_clear_range_m, scan.range_max_m, _MAX_RANGE_M),
        )
        self._make_room(box)
        board = draw_scan(ends, kinds, box, x_cells, y_cells)
        hit, miss = self._model.evidence()
        row, col = box[0] - self._corner[0], box[1] - self._corner[1]
        add_evidence(self._log_odds, board, row, col, np.float32(hit), np.float32(miss))

    def finish(self) -> OccupancyGrid:
        """The map so far, clamped; it holds every scan's beams and no more.

        Raises
        ------
        ScanweaveError
            Where no scan was added.
        """
        if self._used is None:
            raise ScanweaveError("no scan was given to build a map from")
        row, col, rows, cols = self._used
        top, left = row - self._corner[0], col - self._corner[1]
        used = self._log_odds[top : top + rows, left : left + cols]
        low, high = np.float32(_log_odds(self._model.p_min)), np.float32(_log_odds(self._model.p_max))
        corner = gtsam.Pose2(col * self._resolution_m, row * self._resolution_m, 0.0)
        return OccupancyGrid(np.clip(used, low, high), self._resolution_m, self._axes.compose(corner))

    def _make_room(self, box: Box) -> None:
        """Enlarge the grid to hold the box, with room to spare so that growing stays rare."""
        used = box if self._used is None else _union(self._used, box)
        if used[2] * used[3] > self._max_cells:
            raise ScanweaveError(
                f"the map would have {used[2]} x {used[3]} cells of {self._resolution_m:g} m, the limit is"
                f" {self._max_cells}: choose a coarser resolution or a smaller max_hit_range_m, or look for a"
                " lost pose"
            )
        held = (*self._corner, *self._log_odds.shape)
        if self._used is None or _union(held, used) != held:
            spare = (used[0] - used[2] // 4, used[1] - used[3] // 4, used[2] * 3 // 2, used[3] * 3 // 2)
            room = _union(spare, used) if spare[2] * spare[3] <= self._max_cells else used
            grown = np.zeros(room[2:], dtype=np.float32)
            if self._used is not None:
                row, col, rows, cols = self._used
                old = self._log_odds[row - held[0] :, col - held[1] :][:rows, :cols]
                grown[row - room[0] :, col - room[1] :][:rows, :cols] = old
            self._log_odds, self._corner = grown, room[:2]
        self._used = used


def build_grid(
    scans: Iterable[PosedScan],
    resolution_m: float,
    model: InverseSensorModel | None = None,
    *,
    axes_yaw_rad: float = 0.0,
    max_cells: int = DEFAULT_MAX_CELLS,
) -> OccupancyGrid:
    """Build a map in one pass over scans at known poses; its bounds follow from them. See `GridBuilder`.

    The result is the same to the bit in whatever order the scans come.

    Raises
    ------
    ScanweaveError
        Where there is no scan, a pose is not finite, or the map would exceed ``max_cells``.
    """
    builder = GridBuilder(resolution_m, model, axes_yaw_rad=axes_yaw_rad, max_cells=max_cells)
    for scan in scans:
        builder.add(PosedScan(*scan))
    return builder.finish()


def _log_odds(probability: float) -> float:
    """log(p / (1 - p))."""
    return math.log(probability / (1.0 - probability))


def _quantised_log_odds(probability: float) -> float:
    """Log-odds to the step in which sums are exact, never zero."""
    value = round(_log_odds(probability) / _LOG_ODDS_STEP) * _LOG_ODDS_STEP
    return value or math.copysign(_LOG_ODDS_STEP, probability - 0.5)


def _union(a: Box, b: Box) -> Box:
    """The smallest (first row, first col, rows, cols) that holds both."""
    row, col = min(a[0], b[0]), min(a[1], b[1])
    return row, col, max(a[0] + a[2], b[0] + b[2]) - row, max(a[1] + a[3], b[1] + b[3]) - col


def _to_frame(points: FloatArray, T_a_b: gtsam.Pose2) -> FloatArray:
    """(N, 2) points of frame a in frame b."""
    cosine, sine = math.cos(T_a_b.theta()), math.sin(T_a_b.theta())
    moved = np.asarray(points, dtype=np.float64) - [T_a_b.x(), T_a_b.y()]
    turned: FloatArray = moved @ np.array([[cosine, -sine], [sine, cosine]])
    return turned
