"""Search the whole map for poses from which a set of points may have been seen, by branch and bound.

Hess 2016 Sec. V-B over the whole map and all yaws. It returns not only the best pose but all poses with
nearly as good a score, because rooms look alike.
"""

from __future__ import annotations

import math
import os
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ZERO, kernel
from slam.config.localization import LocalizationConfig
from slam.localization.poses import SAME_M, SAME_RAD, Measured
from slam.localization.whole_map_field import WholeMapField
from slam.measurements import AnyFloatArray, FloatArray, row_from_pose2

# Points in a search: more add no information.
_POINTS = 150
# Blocks whose best eighths are evaluated first, level by level, to get a lower bound.
_DIVE = 64
# Largest number of blocks evaluated per level, and in the best eighth: if there are more, the scan is
# ambiguous, and the best blocks suffice. It limits the delay of a reading.
_MOST_BLOCKS = 1 << 16

T = TypeVar("T")
Pixels: TypeAlias = NDArray[np.int32]
Nodes: TypeAlias = NDArray[np.int64]
# Work that yields when a reading has waited enough, and its result.
Steps: TypeAlias = Generator[None, None, T]


class Place(NamedTuple):
    """A candidate pose: (3,) x, y, yaw in the map, and its mean likelihood."""

    pose: FloatArray
    score: float


class Window(NamedTuple):
    """Search window: (2,) lowest and highest x and y, metres, and a yaw with half width, radians."""

    lowest: FloatArray
    highest: FloatArray
    yaw: float
    half_yaw: float

    @classmethod
    def of(cls, known: Measured, sigmas: float) -> Window:
        """Create it from so many standard deviations around a planar pose, plus the size of one place."""
        pose = row_from_pose2(known.pose)
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        turned = np.array([[cos, -sin], [sin, cos]])
        variances = np.diag(turned @ known.covariance[:2, :2] @ turned.T)
        half_m = sigmas * np.sqrt(variances) + SAME_M
        half_yaw = sigmas * float(np.sqrt(known.covariance[2, 2])) + SAME_RAD
        return cls(pose[:2] - half_m, pose[:2] + half_m, float(pose[2]), half_yaw)


def at_once(steps: Steps[T]) -> T:
    """Return the result of stepwise work."""
    while True:
        try:
            next(steps)
        except StopIteration as ended:
            result: T = ended.value
            return result


def search_map(
    field: WholeMapField,
    points: AnyFloatArray,
    settings: LocalizationConfig,
    most: int,
    window: Window | None = None,
) -> Steps[list[Place]]:
    """Return every place with a score near the best, best first, independent of the number of threads.

    Parameters
    ----------
    points
        (M, 2) points as seen from the base, of which a sample is used.
    settings
        The mean likelihood below which poses are not searched, and the share of the best score above which
        others are reported too.
    window
        Search window; None searches everywhere.
    """
    if len(points) == 0:
        return []
    points = points[:: -(-len(points) // _POINTS)]
    reach_m = max(1.0, float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90)))
    turns = math.ceil(2.0 * math.pi * reach_m / field.cell_m)
    yaws: FloatArray = np.arange(turns, dtype=np.float64) * (2.0 * math.pi / turns)
    if window is not None:
        # In order, since they are searched in blocks.
        turned = (yaws - window.yaw + np.pi) % (2.0 * np.pi) - np.pi
        order = np.argsort(turned)
        yaws = yaws[order[np.abs(turned[order]) <= window.half_yaw]]
    columns, rows = _rotated_pixels(np.asarray(points, np.float64), yaws, field.cell_m)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        search = _Search(field, columns, rows, pool, window)
        bar = math.ceil(settings.search_least_score * 255.0 * len(points))
        nodes, scores = yield from search.descend(bar, settings.search_keep_share)
    # By score, then position and yaw: independent of the thread.
    order = np.lexsort((nodes[:, 0], nodes[:, 2], nodes[:, 1], -scores))
    nodes, scores = nodes[order], scores[order]
    poses = np.column_stack(
        [
            field.origin_x + (nodes[:, 1] + 0.5) * field.cell_m,
            field.origin_y + (nodes[:, 2] + 0.5) * field.cell_m,
            (yaws[nodes[:, 0]] + np.pi) % (2.0 * np.pi) - np.pi,
        ]
    )
    chosen = _apart(poses, most)
    return [Place(poses[n], float(scores[n]) / (255.0 * len(points))) for n in chosen]


def _apart(poses: FloatArray, most: int) -> list[int]:
    """Return the first of every group of close poses, (n, 3) in order of preference."""
    chosen: list[int] = []
    candidates = np.ones(len(poses), np.bool_)
    while len(chosen) < most and candidates.any():
        n = int(candidates.argmax())
        chosen.append(n)
        is_far = np.hypot(poses[:, 0] - poses[n, 0], poses[:, 1] - poses[n, 1]) > SAME_M
        turn = np.abs((poses[:, 2] - poses[n, 2] + np.pi) % (2.0 * np.pi) - np.pi)
        candidates &= is_far | (turn > SAME_RAD)
    return chosen


def _rotated_pixels(points: FloatArray, yaws: FloatArray, cell_m: float) -> tuple[Pixels, Pixels]:
    """Return the pixel offsets of all points from the robot, for every yaw: (turns, M) columns and rows."""
    cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x, y = points.T
    columns, rows = cos * x - sin * y, sin * x + cos * y
    return (np.floor(columns / cell_m + 0.5).astype(np.int32), np.floor(rows / cell_m + 0.5).astype(np.int32))


class _Seen(NamedTuple):
    """Pixel offsets of the points in blocks of yaws.

    Attributes
    ----------
    columns, rows
        (blocks, M) the least pixel offsets from the robot over all yaws of a block.
    pooled
        Level of the map pooled as wide as the blocks, by the motion of the farthest point in them.
    """

    columns: Pixels
    rows: Pixels
    pooled: int


class _Search:
    """Bounds of blocks of poses; a block (yaws, x, y) of level k has 2^k yaws and 2^k pixels per side."""

    def __init__(
        self,
        field: WholeMapField,
        columns: Pixels,
        rows: Pixels,
        pool: ThreadPoolExecutor,
        window: Window | None,
    ) -> None:
        self._field, self._seen = field, [_Seen(columns, rows, 0)]
        # Lowest and highest pixels x and y.
        self._lowest, self._highest = np.zeros(2, np.int64), np.array(field.levels[0].shape[::-1]) - 1
        if window is not None:
            origin = np.array([field.origin_x, field.origin_y])
            lowest, highest = (np.floor((corner - origin) / field.cell_m) for corner in window[:2])
            self._lowest = np.maximum(self._lowest, lowest.astype(np.int64))
            self._highest = np.minimum(self._highest, highest.astype(np.int64))
        self._pool, self._threads = pool, os.cpu_count() or 1
        self._room = _MOST_BLOCKS

    def descend(self, bar: int, keep_share: float) -> Steps[tuple[Nodes, Nodes]]:
        """Find all poses with a score sum above the bar and the share of the best: (n, 3) and (n,)."""
        # The smallest block size at which all blocks can be evaluated.
        level, standing = 0, self._field.standing
        while standing[level].sum() * len(self._seen[level].columns) > _MOST_BLOCKS and self._widen():
            level += 1
        turns = np.arange(len(self._seen[level].columns))
        y, x = np.nonzero(self._field.standing[level])
        places = np.column_stack([x, y])[None].repeat(len(turns), axis=0) << level
        nodes = np.insert(places.reshape(-1, 2), 0, turns.repeat(len(x)), axis=1)
        nodes, bounds = yield from self._bounded(level, self._inside(level, nodes), bar)
        while level > 0:
            if len(nodes):
                bar = max(bar, math.ceil(keep_share * (yield from self._dive(level, nodes))))
            nodes = nodes[bounds >= bar]
            level -= 1
            nodes, bounds = yield from self._bounded(level, self._eighths(level, nodes), bar)
        kept = bounds >= keep_share * bounds.max(initial=0)
        return nodes[kept], bounds[kept]

    def _widen(self) -> bool:
        """Prepare the next level; return False if no image is pooled as wide as its blocks."""
        level = len(self._seen)
        turns = len(self._seen[0].columns)
        first = np.arange(0, turns, 1 << level)
        cells = np.stack(self._seen[0][:2])
        least: Pixels = np.minimum.reduceat(cells, first, axis=1)
        wide = (1 << level) + int((np.maximum.reduceat(cells, first, axis=1) - least).max())
        pooled = (wide - 1).bit_length()
        if pooled >= len(self._field.levels):
            return False
        self._seen.append(_Seen(least[0], least[1], pooled))
        return True

    def _dive(self, level: int, nodes: Nodes) -> Steps[int]:
        """Return the score of a pose in the blocks: the best one, if the likeliest blocks contain it."""
        for below in range(level - 1, -1, -1):
            nodes, bounds = yield from self._bounded(below, self._eighths(below, nodes[:_DIVE]), 0)
        return int(bounds.max(initial=0))

    def _eighths(self, level: int, nodes: Nodes) -> Nodes:
        """Return the eighths of blocks, one level down."""
        halves = np.indices((2, 2, 2)).reshape(3, -1).T * np.array([1, 1 << level, 1 << level])
        parts: Nodes = nodes[:, None, :] * np.array([2, 1, 1]) + halves
        return self._inside(level, parts.reshape(-1, 3))

    def _inside(self, level: int, nodes: Nodes) -> Nodes:
        """Return the blocks of a level with a yaw and a pixel in the search window."""
        corner = nodes[:, 1:]
        inside = ((corner <= self._highest) & (corner + (1 << level) > self._lowest)).all(axis=1)
        inside &= nodes[:, 0] < len(self._seen[level].columns)
        return np.ascontiguousarray(nodes[inside])

    def _bounded(self, level: int, nodes: Nodes, bar: int) -> Steps[tuple[Nodes, Nodes]]:
        """Return the blocks that can reach the bar, and upper bounds of their scores; best first."""
        bounds, scan = np.empty(len(nodes), np.int64), self._seen[level]

        def part(first: int) -> None:
            share = slice(first, begin + self._room, self._threads)
            pictures = self._field.levels[scan.pooled], self._field.standing[level]
            _bound(*pictures, self._field.unknown, level, *scan, nodes[share], bar, bounds[share])

        begin = 0
        while begin < len(nodes):
            list(self._pool.map(part, range(begin, begin + self._threads)))
            looked_at = min(self._room, len(nodes) - begin)
            begin, self._room = begin + looked_at, self._room - looked_at
            if not self._room:
                yield
                self._room = _MOST_BLOCKS
        most = min(np.sum(bounds >= max(bar, 0)), _MOST_BLOCKS // 8)
        likeliest = np.argsort(-bounds, kind="stable")[:most]
        return nodes[likeliest], bounds[likeliest]


@kernel(nogil=True)
def _bound(picture, standing, unknown, level, columns, rows, pooled, nodes, bar, bounds):  # type: ignore[no-untyped-def]
    """Return an upper bound of the score sum over all poses of each block.

    -1 if the robot cannot be in any of them, or the sum does not reach ``bar``.
    """
    width = 1 << pooled
    count = columns.shape[1]
    for n in range(nodes.shape[0]):
        turn = nodes[n, 0]
        x = nodes[n, 1]
        y = nodes[n, 2]
        bounds[n] = -1
        if not standing[y >> level, x >> level]:
            continue
        x += width - 1
        y += width - 1
        total = ZERO
        for i in range(count):
            c = columns[turn, i] + x
            r = rows[turn, i] + y
            if 0 <= c < picture.shape[1] and 0 <= r < picture.shape[0]:
                total += picture[r, c]
            else:
                total += unknown
            if total + 255 * (count - 1 - i) < bar:
                break
        else:
            bounds[n] = total
