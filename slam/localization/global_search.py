"""Where in a whole map a set of points may have been seen from: branch and bound over every pose.

Hess 2016 Sec. V-B over all of the map and all yaws; not the best pose alone is told, but every one that
comes near it, for rooms are alike.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import NONE, ONE, ZERO, kernel
from slam.localization.whole_map_field import WholeMapField
from slam.matching.planar import wrap
from slam.measurements import AnyFloatArray, FloatArray

# The best pose of a block of so many pixels a side (2^3) stands for the others in it.
_PEAK_LEVEL = 3
# After so many points each, a sum is looked at.
_GLANCE = 16
# Two poses nearer than this are one place.
_APART_M = 0.5
_APART_RAD = 0.3
# Peaks that there is room for at first.
_ROOM = 4096

Pixels: TypeAlias = NDArray[np.int32]


class Place(NamedTuple):
    """A pose from which the points may have been seen: (3,) x, y, yaw in the map, and its mean likelihood."""

    pose: FloatArray
    score: float


def search_everywhere(
    field: WholeMapField,
    points: AnyFloatArray,
    least_score: float,
    keep_share: float,
    most: int,
    threads: int = 1,
) -> list[Place]:
    """Every place with a score near the best, best first; the same for any number of threads.

    Parameters
    ----------
    field
        The map.
    points
        (M, 2) points as seen from the base, M > 0.
    least_score
        Poses below this mean likelihood are not looked for.
    keep_share
        Poses with at least this share of the best score are told too.
    most
        How many places at most.
    threads
        Yaws are shared out among so many.
    """
    reach_m = max(1.0, float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90)))
    turns = math.ceil(2.0 * math.pi * reach_m / field.cell_m)
    yaws: FloatArray = np.arange(turns, dtype=np.float64) * (2.0 * math.pi / turns)
    columns, rows = _rotated_pixels(np.asarray(points, np.float64), yaws, field.cell_m)
    least = math.ceil(least_score * 255.0 * len(points))
    shares = [np.arange(first, turns, threads) for first in range(threads)]
    if threads == 1:
        found = [_search(field, columns, rows, shares[0], least, keep_share)]
    else:
        with ThreadPoolExecutor(threads) as pool:
            found = list(
                pool.map(lambda share: _search(field, columns, rows, share, least, keep_share), shares)
            )
    peaks = np.concatenate(found)
    if len(peaks) == 0:
        return []
    peaks = peaks[peaks[:, 0] >= keep_share * peaks[:, 0].max()]
    # By score, then place and yaw: the order does not depend on who found it.
    peaks = peaks[np.lexsort((peaks[:, 3], peaks[:, 2], peaks[:, 1], -peaks[:, 0]))]
    poses = np.column_stack(
        [
            field.origin_x + (peaks[:, 1] + 0.5) * field.cell_m,
            field.origin_y + (peaks[:, 2] + 0.5) * field.cell_m,
            yaws[peaks[:, 3]],
        ]
    )
    chosen = _apart(poses, most)
    scores = peaks[chosen, 0] / (255.0 * len(points))
    return [
        Place(np.array([pose[0], pose[1], wrap(pose[2])]), float(score))
        for pose, score in zip(poses[chosen], scores, strict=True)
    ]


def _apart(poses: FloatArray, most: int) -> list[int]:
    """The first of every group of poses that are near each other, (n, 3) in order of preference."""
    chosen: list[int] = []
    left = np.ones(len(poses), np.bool_)
    while len(chosen) < most and left.any():
        n = int(left.argmax())
        chosen.append(n)
        far = np.hypot(poses[:, 0] - poses[n, 0], poses[:, 1] - poses[n, 1]) > _APART_M
        turn = np.abs((poses[:, 2] - poses[n, 2] + np.pi) % (2.0 * np.pi) - np.pi)
        left &= far | (turn > _APART_RAD)
    return chosen


def _rotated_pixels(points: FloatArray, yaws: FloatArray, cell_m: float) -> tuple[Pixels, Pixels]:
    """Pixels from the robot's own to that of every point, for every yaw: (turns, M) columns and rows."""
    cos, sin = np.cos(yaws)[:, None], np.sin(yaws)[:, None]
    x, y = points.T
    columns, rows = cos * x - sin * y, sin * x + cos * y
    return (
        np.floor(columns / cell_m + 0.5).astype(np.int32),
        np.floor(rows / cell_m + 0.5).astype(np.int32),
    )


def _search(
    field: WholeMapField,
    columns: Pixels,
    rows: Pixels,
    turns: NDArray[np.int64],
    least: int,
    keep_share: float,
) -> NDArray[np.int64]:
    """Peaks of some yaws: (n, 4) score sum, x, y, number of the yaw."""
    top = len(field.table) - 1
    floor = min(_PEAK_LEVEL, top)
    # Of the widest blocks, most can hold anything: begin where there are at least some.
    top = max(top - 2, floor)
    bounds = np.empty(len(turns) * int(field.table[top, 4] * field.table[top, 5]), np.int64)
    _bound_blocks(field, columns, rows, turns, top, least, bounds)
    order = np.argsort(-bounds, kind="stable")
    stack, inner = np.empty((4 * (top + 1), 4), np.int64), np.empty((4 * (floor + 1), 4), np.int64)
    room = np.empty((_ROOM, 4), np.int64)
    peaks, count = _search_blocks(
        field, columns, rows, turns, top, floor, least, keep_share, bounds, order, stack, inner, room
    )
    return np.asarray(peaks[:count])


@kernel(nogil=True)
def _bound(field, k, columns, rows, turn, x, y, bar):  # type: ignore[no-untyped-def]
    """Upper bound of the score sum over robot pixels x..x+w-1, y..y+w-1, w = 2^k.

    -1 where the robot cannot stand in any of them, or the sum will not reach ``bar``.
    """
    width = 1 << k
    table = field.table
    if field.standing[table[k, 3] + (y >> k) * table[k, 5] + (x >> k)] == 0:
        return -1
    start = table[k, 0]
    height = table[k, 1]
    stride = table[k, 2]
    count = columns.shape[1]
    total = ZERO
    for i in range(count):
        if i % _GLANCE == 0 and total + 255 * (count - i) < bar:
            return -1
        c = columns[turn, i] + x + width - 1
        r = rows[turn, i] + y + width - 1
        if 0 <= c < stride and 0 <= r < height:
            total += field.buffer[start + r * stride + c]
        else:
            total += field.unknown
    return total


@kernel(nogil=True)
def _peak(field, columns, rows, turn, x, y, level, bar, stack):  # type: ignore[no-untyped-def]
    """Best score sum of a block that is at least ``bar``, with its x and y; score -1 where there is none."""
    best = NONE
    best_x = best_y = ZERO
    stack[0, 0] = level
    stack[0, 1] = x
    stack[0, 2] = y
    stack[0, 3] = 1 << 60
    depth = ONE
    while depth > 0:
        depth -= 1
        bound = stack[depth, 3]
        if bound <= best:
            continue
        if stack[depth, 0] == 0:
            best = bound
            best_x = stack[depth, 1]
            best_y = stack[depth, 2]
            continue
        depth = _push_children(field, columns, rows, turn, max(bar, best + 1), stack, depth)
    return best, best_x, best_y


@kernel(nogil=True)
def _push_children(field, columns, rows, turn, bar, stack, depth):  # type: ignore[no-untyped-def]
    """Put the quarters of the block at ``depth`` whose bound is at least ``bar`` there, the best on top."""
    k = stack[depth, 0]
    x = stack[depth, 1]
    y = stack[depth, 2]
    half = 1 << (k - 1)
    first = depth
    for child in range(4):
        left = x + (child & 1) * half
        low = y + (child >> 1) * half
        if left >= field.table[0, 5] or low >= field.table[0, 4]:
            continue
        bound = _bound(field, k - 1, columns, rows, turn, left, low, bar)
        if bound < bar:
            continue
        place = depth
        while place > first and stack[place - 1, 3] > bound:
            for n in range(4):
                stack[place, n] = stack[place - 1, n]
            place -= 1
        stack[place, 0] = k - 1
        stack[place, 1] = left
        stack[place, 2] = low
        stack[place, 3] = bound
        depth += 1
    return depth


@kernel(nogil=True)
def _kept(peaks, count, bar):  # type: ignore[no-untyped-def]
    """Drop peaks below the bar; where all stay, make room for as many again: the array and their number."""
    kept = ZERO
    for n in range(count):
        if peaks[n, 0] >= bar:
            for m in range(4):
                peaks[kept, m] = peaks[n, m]
            kept += 1
    if kept < peaks.shape[0] // 2:
        return peaks, kept
    larger = np.empty((2 * peaks.shape[0], 4), np.int64)
    for n in range(kept):
        for m in range(4):
            larger[n, m] = peaks[n, m]
    return larger, kept


@kernel(nogil=True)
def _bound_blocks(field, columns, rows, turns, top, least, bounds):  # type: ignore[no-untyped-def]
    """Write the bound of every block of the top level for every yaw, yaw by yaw."""
    across = field.table[top, 5]
    node = ZERO
    for n in range(turns.size):
        for y in range(field.table[top, 4]):
            for x in range(across):
                bounds[node] = _bound(field, top, columns, rows, turns[n], x << top, y << top, least)
                node += 1


@kernel(nogil=True)
def _search_blocks(  # type: ignore[no-untyped-def]
    field, columns, rows, turns, top, floor, least, keep_share, bounds, order, stack, inner, peaks
):
    """Depth first through the blocks in the order of their bounds: the peaks, and how many there are."""
    across = field.table[top, 5]
    blocks = across * field.table[top, 4]
    best = ZERO
    bar = least
    count = ZERO
    for node in order:
        if bounds[node] < bar:
            break
        turn = turns[node // blocks]
        stack[0, 0] = top
        stack[0, 1] = (node % blocks % across) << top
        stack[0, 2] = (node % blocks // across) << top
        stack[0, 3] = bounds[node]
        depth = ONE
        while depth > 0:
            depth -= 1
            if stack[depth, 3] < bar:
                continue
            if stack[depth, 0] > floor:
                depth = _push_children(field, columns, rows, turn, bar, stack, depth)
                continue
            level = stack[depth, 0]
            score, x, y = _peak(
                field, columns, rows, turn, stack[depth, 1], stack[depth, 2], level, bar, inner
            )
            if score < bar:
                continue
            if score > best:
                best = score
                bar = max(bar, math.ceil(keep_share * best))
            if count == peaks.shape[0]:
                peaks, count = _kept(peaks, count, bar)
            peaks[count, 0] = score
            peaks[count, 1] = x
            peaks[count, 2] = y
            peaks[count, 3] = turn
            count += 1
    return peaks, count
