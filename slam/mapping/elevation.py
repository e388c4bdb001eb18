"""Ground under the map of a 3D lidar: its height everywhere, connected to where the robot was.

So the height band (Yang2021 Eq. (16)-(18)) is correct on ramps, behind kerbs and for a hand-held lidar, where
a single level would not be. There is one height per place: if storeys lie above each other, the plan mixes
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.mapping.band_scan import LEVEL_SHARE
from slam.mapping.sensor_packing import STEP_M
from slam.matching.local_cloud import moved
from slam.measurements import AnyFloatArray, BoolArray, FloatArray
from slam.vision.prefetch import prefetched

Keys = NDArray[np.int64]

BATCH = 32  # clouds before their common cells are merged
_CELL_M = 0.4
# A cell and a height in one number, which sorts ten times as fast: 21 bits each, heights in steps of clouds.
_BITS = 21
_MIDDLE = 1 << _BITS - 1
_STEEPEST = 0.5  # of the ground, kerbs included; steeper surfaces are objects on it
_BESIDE_CELLS = 5.0  # ground is searched within this distance of the robot


@dataclass(frozen=True, slots=True)
class Elevation:
    """Heights of the ground.

    Attributes
    ----------
    height_m
        (rows, cols) in the map; unseen cells have the height of the nearest seen one.
    seen
        (rows, cols) whether it was seen.
    cell_m, origin_xy
        Side of a cell, and the lower left corner of cell (0, 0) in the map.
    """

    height_m: FloatArray
    seen: BoolArray
    cell_m: float
    origin_xy: FloatArray

    def above_m(self, points_map: FloatArray) -> FloatArray:
        """Return (N,) heights of points (N, 3) above the ground."""
        above_m = np.empty(len(points_map))
        _above(points_map, self.height_m, self.cell_m, self.origin_xy, above_m)
        return above_m

    def seen_at(self, points_map: AnyFloatArray) -> BoolArray:
        """Return (N,) whether ground was seen under points (N, 3)."""
        at = np.floor((points_map[:, 1::-1] - self.origin_xy[::-1]) / self.cell_m).astype(np.int64)
        inside = ((at >= 0) & (at < self.seen.shape)).all(axis=1)
        at[~inside] = 0
        return np.asarray(inside & self.seen[at[:, 0], at[:, 1]])

    def slope(self) -> FloatArray:
        """Return (rows, cols) the gradient of the ground."""
        if min(self.height_m.shape) < 2:
            return np.zeros_like(self.height_m)
        rise: FloatArray = np.hypot(*np.gradient(self.height_m, self.cell_m))
        return rise


def elevation(
    clouds: Iterable[FloatArray], poses: Sequence[gtsam.Pose3], ground_m: float, reach_m: float
) -> Elevation | None:
    """Estimate the ground of a map.

    Parameters
    ----------
    clouds
        (N, 3) points of each keyframe, base frame.
    poses
        ``T_map_base`` of each.
    ground_m
        Height of the ground in the base frame, at the robot.
    reach_m
        Points farther from the robot are too sparse.

    Returns
    -------
    None if no ground is connected to the robot's path.
    """
    batches, waiting = list[Keys](), list[Keys]()
    placed = zip(clouds, poses, strict=True)
    for lows in prefetched(placed, lambda args: _lows(moved(*args), args[1].translation(), reach_m), 1):
        waiting.append(lows)
        if len(waiting) == BATCH:
            batches.append(_quantiles(np.concatenate(waiting), 0.5))
            waiting = []
    none = np.zeros(0, np.int64)
    keys, below = _quantiles(np.concatenate([none, *batches, *waiting]), 0.5), (1 << _BITS) - 1
    if not len(keys):
        return None
    row, col = (keys >> 2 * _BITS) - _MIDDLE, (keys >> _BITS & below) - _MIDDLE
    first = np.array([row.min(), col.min()])
    low = np.full((int(np.ptp(row)) + 1, int(np.ptp(col)) + 1), np.nan)
    low[row - first[0], col - first[1]] = ((keys & below) - _MIDDLE) * STEP_M
    feet = np.array([pose.transformFrom(np.array([0.0, 0.0, ground_m])) for pose in poses])
    feet = feet[np.isfinite(feet).all(axis=1)]
    ground = _connected_ground(low, feet, first * _CELL_M)
    if not ground.any():
        return None
    nearest = scipy.ndimage.distance_transform_edt(~ground, return_distances=False, return_indices=True)
    return Elevation(low[tuple(nearest)], ground, _CELL_M, first[::-1] * _CELL_M)


@kernel(nogil=True)
def _above(points, height_m, cell_m, origin_xy, above_m):  # type: ignore[no-untyped-def]
    """Return heights (N,) of points (N, 3) above the ground, interpolated between cell centres."""
    last_row = height_m.shape[0] - 1
    last_col = height_m.shape[1] - 1
    for i in range(points.shape[0]):
        at_row = min(max((points[i, 1] - origin_xy[1]) / cell_m - 0.5, 0.0), last_row)
        at_col = min(max((points[i, 0] - origin_xy[0]) / cell_m - 0.5, 0.0), last_col)
        row = int(at_row)
        col = int(at_col)
        up = min(row + 1, last_row)
        right = min(col + 1, last_col)
        at_row -= row
        at_col -= col
        low = height_m[row, col] * (1.0 - at_col) + height_m[row, right] * at_col
        high = height_m[up, col] * (1.0 - at_col) + height_m[up, right] * at_col
        above_m[i] = points[i, 2] - (low * (1.0 - at_row) + high * at_row)


def _lows(points_map: FloatArray, position: FloatArray, reach_m: float) -> Keys:
    """Return (C,) the cells of one cloud, with their heights."""
    x, y, z = np.ascontiguousarray(points_map.T)
    (in_reach,) = np.nonzero((x - position[0]) ** 2 + (y - position[1]) ** 2 < reach_m**2)
    row, col = (np.floor(axis[in_reach] / _CELL_M).astype(np.int64) + _MIDDLE for axis in (y, x))
    height = np.clip(np.rint(z[in_reach] / STEP_M).astype(np.int64) + _MIDDLE, 0, 2 * _MIDDLE - 1)
    return _quantiles(row << 2 * _BITS | col << _BITS | height, LEVEL_SHARE)


def _quantiles(keys: Keys, share: float) -> Keys:
    """Return (C,) of keys (N,): one per cell, with a quantile of its heights."""
    keys = np.sort(keys)
    cells = keys >> _BITS
    starts = np.flatnonzero(np.diff(cells, prepend=-1))
    counts = np.diff(np.append(starts, len(keys)))
    return keys[starts + (share * counts).astype(np.int64)]


def _connected_ground(low: FloatArray, feet: FloatArray, origin_yx: FloatArray) -> BoolArray:
    """Return (rows, cols) cells that are reachable from the robot's positions without too high a step."""
    from scipy.spatial import cKDTree

    known, step_m = np.isfinite(low), _STEEPEST * _CELL_M
    number = np.where(known, np.cumsum(known.ravel()).reshape(low.shape) - 1, -1)
    pairs = []
    for here, there in (
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
    ):
        with np.errstate(invalid="ignore"):
            flat = np.abs(low[here] - low[there]) <= step_m
        pairs.append(np.column_stack([number[here][flat], number[there][flat]]))
    ends, count = np.vstack(pairs), int(known.sum())
    graph = scipy.sparse.csr_array(
        (np.ones(len(ends), np.int32), (ends[:, 0], ends[:, 1])), shape=(count, count)
    )
    _, parts = scipy.sparse.csgraph.connected_components(graph, directed=False)
    at = np.argwhere(known)
    distance, foot = cKDTree((feet[:, 1::-1] - origin_yx) / _CELL_M - 0.5).query(at)
    stands = (distance <= _BESIDE_CELLS) & (np.abs(low[known] - feet[foot, 2]) <= step_m)
    ground = np.zeros(low.shape, dtype=np.bool_)
    ground[known] = np.isin(parts, parts[stands])
    return ground
