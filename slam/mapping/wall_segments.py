"""Straight pieces of wall in the points of many scans, and the gaps between two pieces in one line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from slam.matching.scan_points import extract_points
from slam.measurements import BoolArray, FloatArray, LaserScan

# Normals of one wall differ by less from its own: a degree of noise, and what stands close before it.
SAME_DIRECTION_RAD = np.radians(12.0)


@dataclass(frozen=True, slots=True)
class WallPoints:
    """Where beams have met something that is straight there.

    Attributes
    ----------
    points_map, normals_map
        (N, 2) metres, and unit normals that face the sensor.
    keyframes
        (N,) the scan of each.
    weights
        (N,) readings that it stands for.
    """

    points_map: FloatArray
    normals_map: FloatArray
    keyframes: NDArray[np.int64]
    weights: FloatArray

    def __len__(self) -> int:
        return len(self.points_map)

    def chosen(self, which: BoolArray | NDArray[np.int64]) -> WallPoints:
        """Some of them."""
        return WallPoints(
            self.points_map[which], self.normals_map[which], self.keyframes[which], self.weights[which]
        )

    def thinned(self, cell_m: float) -> WallPoints:
        """One for all in a cell that face the same way: their mean."""
        if not len(self):
            return self
        cells = np.floor(self.points_map / cell_m).astype(np.int64)
        facing = np.floor(np.arctan2(self.normals_map[:, 1], self.normals_map[:, 0]) / SAME_DIRECTION_RAD)
        keys = np.column_stack([cells, facing.astype(np.int64)])
        _, first, owner = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        weights = np.asarray(np.bincount(owner.ravel(), self.weights), dtype=np.float64)
        means = [
            np.bincount(owner.ravel(), self.weights * column) / weights
            for column in (*self.points_map.T, *self.normals_map.T)
        ]
        normals = np.column_stack(means[2:])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return WallPoints(np.column_stack(means[:2]), normals, self.keyframes[first], weights)


def wall_points(
    scans: Sequence[LaserScan | None], poses_map: FloatArray, range_m: tuple[float, float], neighbours: int
) -> WallPoints:
    """The straight parts of all scans.

    Parameters
    ----------
    scans
        K sweeps; None if there is none.
    poses_map
        (K, 3) x, y, yaw of the bases.
    range_m, neighbours
        See `slam.matching.scan_points.extract_points`.
    """
    points, normals, keyframes = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for keyframe, (scan, (x, y, yaw)) in enumerate(zip(scans, poses_map, strict=True)):
        if scan is None:
            continue
        oriented = extract_points(scan, *range_m, neighbours).oriented()
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        points.append(oriented[0] @ turn + (x, y))
        normals.append(oriented[1] @ turn)
        keyframes.append(np.full(len(oriented[0]), keyframe))
    stacked = np.concatenate(points)
    return WallPoints(stacked, np.concatenate(normals), np.concatenate(keyframes), np.ones(len(stacked)))


@dataclass(frozen=True)
class Segment:
    """One side of a straight piece of wall, of something that looks like one, or of a gap between two.

    Attributes
    ----------
    begin_m, end_m
        (2,) map frame; from begin to end, the side that was seen is on the left.
    """

    begin_m: FloatArray
    end_m: FloatArray

    @cached_property
    def length_m(self) -> float:
        """From end to end."""
        return float(np.hypot(*(self.end_m - self.begin_m)))

    @cached_property
    def along(self) -> FloatArray:
        """(2,) unit vector from its begin to its end."""
        return np.asarray((self.end_m - self.begin_m) / self.length_m)

    @cached_property
    def normal(self) -> FloatArray:
        """(2,) unit vector to the side that was seen."""
        x, y = self.along
        return np.array([-y, x])

    def points(self, step_m: float, aside_m: float = 0.0, beyond_m: float = 0.0) -> FloatArray:
        """(n, 2) along it, two or more; so far on its left, and so far past its ends."""
        along = (self.end_m - self.begin_m) / max(self.length_m, step_m)
        count = max(2, 1 + int(np.ceil((self.length_m + 2.0 * beyond_m) / step_m)))
        at = np.linspace(-beyond_m, self.length_m + beyond_m, count)[:, None]
        return np.asarray(self.begin_m + at * along + aside_m * np.array([-along[1], along[0]]))


def wall_segments(points: WallPoints, cell_m: float, shortest_m: float) -> list[Segment]:
    """The longest straight pieces first: peaks of a Hough transform of oriented points, each refitted.

    Parameters
    ----------
    cell_m
        Points so far from a line are on it; twice as far apart along it, they are two pieces.
    shortest_m
        What is shorter is left out.
    """
    points = points.thinned(0.5 * cell_m)
    segments: list[Segment] = []
    unused = np.ones(len(points), np.bool_)
    angles = np.arctan2(points.normals_map[:, 1], points.normals_map[:, 0])
    spread = int(np.degrees(SAME_DIRECTION_RAD)) // 4
    while unused.any():
        # One degree a bin, with its neighbours: the wall direction that most points have.
        bins = np.floor(np.degrees(angles[unused])).astype(int) % 360
        votes: NDArray[np.int64] = np.bincount(bins, minlength=360)
        votes = np.sum([np.roll(votes, shift) for shift in range(-spread, spread + 1)], axis=0)
        angle = np.radians(np.argmax(votes) + 0.5)
        parallel = unused & (np.abs(np.angle(np.exp(1j * (angles - angle)))) < SAME_DIRECTION_RAD)
        before, facing = len(segments), np.flatnonzero(parallel)
        for piece in _strips(points.points_map[facing], angle, cell_m):
            members = facing[piece]
            segment, on = _fitted(points, members[unused[members]], cell_m, shortest_m)
            if segment is not None and segment.length_m >= shortest_m:
                segments.append(segment)
                unused[on] = False
        if len(segments) == before:
            unused[parallel] = False
    return sorted(segments, key=lambda segment: -segment.length_m)


def _strips(points: FloatArray, angle: float, cell_m: float) -> Iterator[NDArray[np.int64]]:
    """Rows of points that lie on one line across a direction, without gaps along it, the fullest first."""
    normal = np.array([np.cos(angle), np.sin(angle)])
    across, along = points @ normal, points @ (-normal[1], normal[0])
    bins = np.floor(2.0 * (across - across.min()) / cell_m).astype(int) + 1
    counts = np.bincount(bins, minlength=bins.max() + 2)
    by_row, starts = np.argsort(bins, kind="stable"), np.append(0, np.cumsum(counts)).tolist()
    while True:
        votes = counts[:-2] + counts[1:-1] + counts[2:]
        best = int(np.argmax(votes))
        if votes[best] < 4:
            return
        # Of what is left, in the order of the points.
        rows = [by_row[starts[row] : starts[row + 1]] for row in range(best, best + 3) if counts[row]]
        strip = np.sort(np.concatenate(rows))
        counts[best : best + 3] = 0
        order = strip[np.argsort(along[strip], kind="stable")]
        yield from np.split(order, np.flatnonzero(np.diff(along[order]) > 4 * cell_m) + 1)


def _fitted(
    points: WallPoints, members: NDArray[np.int64], cell_m: float, shortest_m: float
) -> tuple[Segment | None, NDArray[np.int64]]:
    """A segment through points, and those that lie on it; None if it would be shorter than that."""
    for _ in range(3):
        chosen, weights = points.points_map[members], points.weights[members]
        # Most are so few or so close together that a line through them need not be tried.
        if len(members) < 4 or np.hypot(*np.ptp(chosen, axis=0)) < shortest_m or weights.sum() < FEWEST:
            return None, members
        middle = np.average(chosen, axis=0, weights=weights)
        centred = chosen - middle
        values, vectors = np.linalg.eigh((centred * weights[:, None]).T @ centred)
        along, across = vectors[:, 1], vectors[:, 0]
        on_line = np.abs(centred @ across) < 0.5 * cell_m
        if on_line.all():
            break
        members = members[on_line]
    normal = np.average(points.normals_map[members], axis=0, weights=points.weights[members])
    if along[0] * normal[1] - along[1] * normal[0] < 0.0:
        along = -along
    at = (points.points_map[members] - middle) @ along
    if 10 * values[0] > values[1] or weights.sum() < FEWEST:
        return None, members
    low, high = at.min(), at.max()
    return Segment(middle + low * along, middle + high * along), members
