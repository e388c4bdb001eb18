"""Changes since an earlier visit: what disappeared, what appeared, and how likely each change is.

If scans of one visit hit something that scans of the other passed through, something has changed, unless the
two poses are wrong: an object that disappeared must be absent wherever it may have been. Hidden or unseen
space is no change. Something hit only at times, while other scans of the same visit passed through, was not
an object there: it was a person, or glass. Evidence is that of the occupancy grid (Li2020 Eq. (8)), drawn for
each visit separately; an object counts once, however many cells it has.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from fusion.bayes import STEPS_A_UNIT
from fusion.estimation import FEWEST, gate
from slam.config import Config
from slam.errors import ScanweaveError
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.mapping.keyframe_grid import grid_of_keyframes, layer_settings
from slam.mapping.lidar_layer import LidarModel, lidar_board
from slam.mapping.occupancy_grid import FREE, OCCUPIED, THRESHOLDS, OccupancyGrid
from slam.measurements import BoolArray, FloatArray, LaserScan, one_line, pose2_from_row, row_from_pose2
from slam.storage.map_contents import MapContents

# Maximum distance between legs of one object; also an upper limit for the width of a person.
_APART_M = 0.5
# Longest time that a person waits for a robot: objects of this size must be seen for longer.
_WAITING_S = 15.0

# Covariance (2, 2) of the position of a point (2,) in one visit relative to the other, along the map axes,
# for the keyframes of both visits that saw it.
Spread = Callable[[NDArray[np.int64], NDArray[np.int64], FloatArray], FloatArray]


@dataclass(frozen=True, slots=True)
class Visit:
    """Keyframes of a visit: K scans, None if missing, and (K, 3) poses in the common frame."""

    scans: Sequence[LaserScan | None]
    poses: FloatArray

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class Change:
    """An object that is present on one visit and absent on the other.

    Attributes
    ----------
    appeared
        Whether it appeared; otherwise it disappeared.
    cells_m
        (N, 2) centres of the cells in which it was hit, map frame.
    probability
        Probability that it was there, and on the other visit was not.
    standing
        Probability that it was there during its whole visit; low for people and glass.
    """

    appeared: bool
    cells_m: FloatArray
    probability: float
    standing: float

    __repr__ = one_line


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of two visits.

    Attributes
    ----------
    changes
        All possible changes, the most likely first.
    steps
        (2, rows, cols) log-odds of both visits, in steps as of a grid.
    resolution_m, corner_m
        Side of a cell, and corner of the lower left cell, map frame.
    """

    changes: Sequence[Change]
    steps: NDArray[np.int16]
    resolution_m: float
    corner_m: tuple[float, float]

    __repr__ = one_line

    def seen_m2(self) -> tuple[float, float, float]:
        """Areas seen by both visits, only by the first, and only by the second."""
        first, second = self.steps != 0
        cell_m2 = self.resolution_m**2
        counts = ((first & second).sum(), (first & ~second).sum(), (second & ~first).sum())
        both, one, other = (float(count * cell_m2) for count in counts)
        return both, one, other


def compare(before: Visit, after: Visit, spread: Spread, config: Config) -> Comparison:
    """Compare two visits of a place.

    Raises
    ------
    ScanweaveError
        If a visit has no scans, or is so large that its cells would be larger than those of the other.
    """
    # A beam without return may have met a black object or nothing.
    certain = config.model_copy(update={"grid": config.grid.model_copy(update={"clear_range_m": 0.0})})
    visits = before, after
    grids = [grid_of_keyframes(visit.scans, visit.poses, certain) for visit in visits]
    steps, resolution_m, corner_m = _on_one_lattice(grids)
    model = layer_settings(certain).lidar
    # Maximum over each cell and its neighbours, because errors below a cell shift evidence to the next one.
    dilated = np.stack([ndimage.maximum_filter(item, 3) for item in steps])
    changes = []
    for appeared, own, other in ((False, 0, 1), (True, 1, 0)):
        labels, count = _things(steps[own], dilated[other], resolution_m)
        if not count:
            continue
        sightings = [_sightings(visit, labels, count, model, resolution_m, corner_m) for visit in visits]
        for n, where in enumerate(ndimage.find_objects(labels)):
            cells = np.argwhere(labels[where] == n + 1) + [part.start for part in where]
            if len(cells) == 1:
                continue  # single cells are noise
            middles_m = (cells[:, ::-1] + 0.5) * resolution_m + corner_m
            hits, through = sightings[own][0][:, n].sum(), sightings[own][1][:, n].sum()
            standing = _standing(int(hits), int(through))
            if (
                np.ptp(middles_m, axis=0).max() <= _APART_M
                and _hit_span_s(visits[own], sightings[own][0][:, n]) < _WAITING_S
            ):
                standing = 0.0
            witnesses = [np.flatnonzero(item[0][:, n] | item[1][:, n]) for item in sightings]
            covariance = spread(witnesses[0], witnesses[1], middles_m.mean(axis=0))
            there = float(special.expit(steps[own][tuple(cells.T)].mean() / STEPS_A_UNIT))
            is_gone = _missing_probability(dilated[other], cells, covariance, resolution_m)
            changes.append(Change(appeared, middles_m, standing * there * is_gone, standing))
    changes.sort(key=lambda item: -item.probability)
    return Comparison(changes, steps, resolution_m, corner_m)


def spread_between(contents: MapContents, before: NDArray[np.int64], after: NDArray[np.int64]) -> Spread:
    """Estimate the uncertainty of one visit relative to another, from the edges between their keyframes.

    Parameters
    ----------
    contents
        A planar map that contains both visits.
    before, after
        The keyframes of each.

    Returns
    -------
    A function that gives it for a point, from the keyframes of both visits that saw it: along the most
    certain path from one of the first to the nearest one of the second; infinite if there is no path.
    """
    poses, graph = contents.keyframe_poses, UncertaintyGraph()
    for _ in poses:
        graph.add_node()
    for factor in contents.factors:
        if factor.kept:
            edge = factor.edge
            motion = row_from_pose2(edge.T_source_target)
            graph.add_edge(edge.source, edge.target, motion, edge.covariance)

    def spread(first: NDArray[np.int64], second: NDArray[np.int64], point_m: FloatArray) -> FloatArray:
        if not len(first) or not len(second):
            return np.full((2, 2), np.inf)
        seen_from = after[second]
        start = int(seen_from[np.hypot(*(poses[seen_from, :2] - point_m).T).argmin()])
        covariances = graph.relative_covariances(start, before[first], poses)
        x, y, yaw = poses[start]
        c, s = math.cos(yaw), math.sin(yaw)
        # In GTSAM's tangent space of the start, a rotation moves the point about the start.
        lever = np.array([[c, -s, -(point_m[1] - y)], [s, c, point_m[0] - x]])
        at_point = lever @ covariances @ lever.T
        return np.asarray(at_point[np.argmin(np.trace(at_point, axis1=1, axis2=2))])

    return spread


def _on_one_lattice(
    grids: Sequence[OccupancyGrid | None],
) -> tuple[NDArray[np.int16], float, tuple[float, float]]:
    """Return steps (2, rows, cols) of both, side of a cell, and corner."""
    first, second = grids
    if first is None or second is None:
        raise ScanweaveError("a visit without lidar scans cannot be compared")
    if first.resolution_m != second.resolution_m:
        raise ScanweaveError(
            f"the grids have cells of {first.resolution_m:g} and {second.resolution_m:g} m; raise "
            "grid.greatest_cells when mapping"
        )
    side_m = first.resolution_m
    corners = [
        np.rint(np.array([grid.T_map_grid.y(), grid.T_map_grid.x()]) / side_m).astype(int)
        for grid in (first, second)
    ]
    low = np.minimum(*corners)
    high = np.maximum(*(corner + grid.shape for corner, grid in zip(corners, (first, second), strict=True)))
    steps = np.zeros((2, *(high - low)), np.int16)
    for part, corner, grid in zip(steps, corners - low, (first, second), strict=True):
        part[corner[0] : corner[0] + grid.shape[0], corner[1] : corner[1] + grid.shape[1]] = grid.steps
    return steps, side_m, (float(low[1] * side_m), float(low[0] * side_m))


def _things(
    own: NDArray[np.int16], other: NDArray[np.int16], resolution_m: float
) -> tuple[NDArray[np.int32], int]:
    """Number the objects, (rows, cols), in cells that one visit hit and the other saw as free."""
    occupied = (THRESHOLDS.states(own) == OCCUPIED) & (THRESHOLDS.states(other) == FREE)
    reach = round(0.5 * _APART_M / resolution_m)
    in_reach = ndimage.distance_transform_edt(~occupied) <= reach if occupied.any() else occupied
    labels, count = ndimage.label(in_reach, np.ones((3, 3)))
    return np.where(occupied, labels, 0), count


def _sightings(
    visit: Visit,
    labels: NDArray[np.int32],
    count: int,
    model: LidarModel,
    resolution_m: float,
    corner_m: tuple[float, float],
) -> tuple[BoolArray, BoolArray]:
    """Return (K, count) whether a keyframe hit each object, and whether it passed at least half of it."""
    dilated = ndimage.maximum_filter(labels, 3)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
    hit, through = np.zeros((2, len(visit.scans), count), np.bool_)
    row_0, col_0 = round(corner_m[1] / resolution_m), round(corner_m[0] / resolution_m)
    for k, (scan, pose) in enumerate(zip(visit.scans, visit.poses, strict=True)):
        if scan is None:
            continue
        board = lidar_board(scan, pose2_from_row(pose), model, resolution_m)
        row, col = board.row - row_0, board.col - col_0
        first_row, first_col = max(row, 0), max(col, 0)
        part = np.s_[
            first_row : max(row + len(board.steps), 0), first_col : max(col + board.steps.shape[1], 0)
        ]
        rows, cols = labels[part].shape
        steps = board.steps[first_row - row :, first_col - col :][:rows, :cols]
        hits = np.bincount(dilated[part][steps > 0], minlength=count + 1)[1:]
        passes = np.bincount(labels[part][steps < 0], minlength=count + 1)[1:]
        hit[k] = hits > 0
        through[k] = ~hit[k] & (2 * passes >= sizes)
    return hit, through


def _standing(hits: int, through: int) -> float:
    """Return the probability that an object was there all the time, from how many scans hit and passed it.

    A fixed object is missed by one scan in as many as make a statistic. A person or glass may be hit by any
    share of the scans.
    """
    stood = special.betaln(FEWEST - 1 + hits, 1 + through) - special.betaln(FEWEST - 1, 1)
    return float(special.expit(stood - special.betaln(1 + hits, 1 + through)))


def _hit_span_s(visit: Visit, hits: BoolArray) -> float:
    """Return the time from the first to the last of the scans that (K,) selects."""
    stamps_s = [scan.stamp_s for scan, hit in zip(visit.scans, hits, strict=True) if hit and scan is not None]
    return max(stamps_s, default=0.0) - min(stamps_s, default=0.0)


def _missing_probability(
    other: NDArray[np.int16], cells: NDArray[np.int64], covariance: FloatArray, resolution_m: float
) -> float:
    """Return the probability that a visit did not hit an object of the other in (N, 2) cells.

    Parameters
    ----------
    covariance
        (2, 2) covariance of these positions, x and y in metres; rounding to cells is added twice.
    """
    if not np.isfinite(covariance).all():
        return 0.0
    spread = covariance / resolution_m**2 + np.eye(2) / 6
    weight, reach = np.linalg.inv(spread), math.sqrt(gate(2) * float(np.linalg.eigvalsh(spread)[-1]))
    side = np.arange(-math.ceil(reach), math.ceil(reach) + 1)
    offsets = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    likely = -0.5 * np.einsum("ni,ij,nj->n", offsets[:, ::-1], weight, offsets[:, ::-1])
    padded = np.pad(other, reach_cells := int(side[-1]))
    there = np.array([padded[tuple((cells + offset + reach_cells).T)].mean() for offset in offsets])
    return float(special.expit(-(likely + there / STEPS_A_UNIT).max()))
