"""Gaps in walls: one straight piece ends and another continues, at most the width of a door away."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from slam.mapping.occupancy_grid import OCCUPIED, OccupancyGrid, looked_up
from slam.mapping.wall_segments import SAME_DIRECTION_RAD, Segment
from slam.measurements import BoolArray, FloatArray

# What is thinner is the leaf of an open door, what is thicker is furniture.
THINNEST_WALL_M, THICKEST_WALL_M = 0.06, 0.45
# The widest double door.
WIDEST_DOOR_M = 2.2


def wall_gaps(segments: Sequence[Segment], grid: OccupancyGrid) -> tuple[list[Segment], list[Segment]]:
    """All gaps, and the segments that are walls: what the grid knows, and what goes on in line."""
    occupied = grid.states() == OCCUPIED
    dilated = scipy.ndimage.binary_dilation(occupied)
    sturdy = np.array([_share(dilated, s, grid) > 0.5 for s in segments], dtype=np.bool_)
    following = _following(segments, sturdy)
    lengths = _in_line(following, [s.length_m for s in segments])
    leaves = _leaves(segments, following)
    gaps = [
        (Segment(segments[index].end_m, segments[next_].begin_m), index, next_)
        for index, next_ in following.items()
    ]
    gaps += _before_walls(segments, following, np.array(lengths) > WIDEST_DOOR_M, occupied, grid)
    closed, walls = [], sturdy.copy()
    for gap, one, other in gaps:
        if leaves[one] or leaves[other] or _across(gap, occupied, grid):
            continue
        closed.append(gap)
        if one != other:
            walls[[one, other]] = True
    return closed, [segment for segment, wall in zip(segments, walls, strict=True) if wall]


def _leaves(segments: Sequence[Segment], following: dict[int, int]) -> list[bool]:
    """Which segments are leaves of open doors. Panes of glass are as thin, but go on as walls."""
    paired = {
        end
        for index, next_ in following.items()
        if np.hypot(*(segments[index].end_m - segments[next_].begin_m)) < THICKEST_WALL_M
        for end in (index, next_)
    }
    return [
        index not in paired
        and THICKEST_WALL_M < segment.length_m < 0.5 * WIDEST_DOOR_M
        and _thin(segment, segments)
        for index, segment in enumerate(segments)
    ]


def _before_walls(
    segments: Sequence[Segment],
    following: dict[int, int],
    long: BoolArray,
    wall: BoolArray,
    grid: OccupancyGrid,
) -> list[tuple[Segment, int, int]]:
    """Gaps between the end of a wall and another that stands across."""
    gaps = []
    for index, segment in enumerate(segments):
        for on, end_m, along in (
            (following.keys(), segment.end_m, segment.along),
            (following.values(), segment.begin_m, -segment.along),
        ):
            hit_m = _ahead(end_m, along, wall, grid) if long[index] and index not in on else None
            if hit_m is not None:
                # The side that was seen stays on the left.
                ahead = along @ segment.along > 0.0
                gaps.append((Segment(end_m, hit_m) if ahead else Segment(hit_m, end_m), index, index))
    return gaps


def _share(such: BoolArray, segment: Segment, grid: OccupancyGrid) -> float:
    """Of a segment, over cells that are such."""
    points = segment.points(0.5 * grid.resolution_m)
    return float(looked_up(such, grid.cells_of(points)).mean())


def _across(gap: Segment, wall: BoolArray, grid: OccupancyGrid) -> bool:
    """Whether it leads from one side of a corridor to the other: walls stand across before both its ends."""
    step_m = 0.5 * grid.resolution_m
    before = gap.points(step_m, aside_m=6 * step_m, beyond_m=0.5 * THICKEST_WALL_M)
    return all(half.any() for half in np.array_split(looked_up(wall, grid.cells_of(before)), 2))


def _ahead(end_m: FloatArray, along: FloatArray, wall: BoolArray, grid: OccupancyGrid) -> FloatArray | None:
    """The first obstacle in line with the end of a wall, no farther than a door is wide and not at once."""
    points = Segment(end_m, end_m + WIDEST_DOOR_M * along).points(0.5 * grid.resolution_m)
    there = looked_up(wall, grid.cells_of(points)) > 0
    # The wall itself may go on for a while, as a pane seen from a slant does.
    clear = int(np.argmin(there))
    hits = clear + np.flatnonzero(there[clear:])
    return np.asarray(points[hits[0]]) if len(hits) and hits[0] > clear + 4 else None


def _following(segments: Sequence[Segment], sturdy: BoolArray) -> dict[int, int]:
    """For each segment the next in line with it, if there is one."""
    next_of: dict[int, int] = {}
    if not segments:
        return next_of
    begins, ends, alongs = (
        np.array([getattr(s, name) for s in segments]) for name in ("begin_m", "end_m", "along")
    )
    for index, segment in enumerate(segments):
        to = begins - segment.end_m
        ahead, aside = to @ segment.along, np.abs(to @ segment.normal)
        slack = np.tan(SAME_DIRECTION_RAD / 4) * np.maximum(ahead, 0.0)
        same = (alongs @ segment.along > np.cos(SAME_DIRECTION_RAD)) & (aside < THICKEST_WALL_M / 4 + slack)
        same[index] = False
        # What overlaps goes on beside it: no gap.
        same &= ((ends - segment.end_m) @ segment.along > 0.0) & (ahead > -0.5 * THICKEST_WALL_M)
        if same.any():
            next_ = int(np.argmin(np.where(same, ahead, np.inf)))
            if ahead[next_] < WIDEST_DOOR_M and (sturdy[index] or sturdy[next_]):
                next_of[index] = next_
    return next_of


def _thin(segment: Segment, segments: Sequence[Segment]) -> bool:
    """Whether the other side was seen, closer than that of a wall: it is the leaf of a door."""
    normal, along, opposite = segment.normal, segment.along, -np.cos(SAME_DIRECTION_RAD)
    middle = 0.5 * (segment.begin_m + segment.end_m)
    for other in segments:
        # Most are not opposite; the rest is only for these.
        if other.normal[0] * normal[0] + other.normal[1] * normal[1] > opposite:
            continue
        begin, end = other.begin_m - middle, other.end_m - middle
        reach = begin @ along, end @ along
        if (
            0.0 < -0.5 * float((begin + end) @ normal) < THINNEST_WALL_M
            and min(reach) < THICKEST_WALL_M
            and max(reach) > -THICKEST_WALL_M
        ):
            return True
    return False


def _in_line(following: dict[int, int], lengths_m: Sequence[float]) -> list[float]:
    """Of each segment, the length of all in its line."""
    owner = np.arange(len(lengths_m))
    for index, next_ in following.items():
        owner[owner == owner[index]] = owner[next_]
    return [float(np.sum(np.array(lengths_m)[owner == line])) for line in owner]
