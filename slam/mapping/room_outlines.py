"""The outlines of all rooms of a floor: what no wall parts is one room, and no place lies in two."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np

from slam.mapping.doors import in_common, open_stretches
from slam.mapping.occupancy_grid import FREE, OccupancyGrid
from slam.mapping.polygons import inside
from slam.mapping.room_outline import Outline, room_outline, seen_from
from slam.mapping.rooms import RoomMap
from slam.mapping.wall_gaps import THICKEST_WALL_M, WIDEST_DOOR_M
from slam.mapping.wall_segments import WallPoints
from slam.measurements import BoolArray, FloatArray


def room_outlines(
    rooms: RoomMap, grid: OccupancyGrid, points: WallPoints, way_map: FloatArray
) -> tuple[RoomMap, dict[int, Outline]]:
    """The rooms, some of them joined, and the outline of each by its label, the largest first.

    Parameters
    ----------
    grid
        What is free.
    points
        Of all that is straight.
    way_map
        (N, 2) where the robot has been.
    """
    owners, entered = seen_from(rooms, points), set(rooms.at(way_map).tolist())

    def drawn(label: int, *others: Outline) -> Outline | None:
        return room_outline(rooms, label, points.chosen((owners == label).any(axis=0)), others)

    found = {label: drawn(label) for label in range(1, int(rooms.labels.max(initial=0)) + 1)}
    # What nobody was in, and has no walls, lies behind a window.
    outlines = {
        label: outline
        for label, outline in found.items()
        if outline is not None and (label in entered or any(face.seen for face in outline.faces))
    }
    free = grid.states() == FREE
    while True:
        apart = _apart(rooms, outlines, drawn)
        open_ = [
            (one, other)
            for one, other in combinations(apart, 2)
            if _unparted(apart[one], apart[other], free, grid)
        ]
        for one, other in open_:
            if one in outlines and other in outlines:
                rooms = replace(rooms, labels=np.where(rooms.labels == other, one, rooms.labels))
                owners[owners == other] = one
                outlines[one] = drawn(one) or outlines[one]
                del outlines[other]
        if not open_:
            sizes = np.bincount(rooms.labels.ravel())
            return rooms, {label: apart[label] for label in sorted(apart, key=lambda label: -sizes[label])}


def _apart(
    rooms: RoomMap, outlines: dict[int, Outline], drawn: Callable[..., Outline | None]
) -> dict[int, Outline]:
    """Of two outlines that overlap the one with less of what both have is drawn anew, outside the other."""
    apart = dict(outlines)
    kept_out: dict[int, list[int]] = {label: [] for label in outlines}
    pairs = list(combinations(apart, 2))
    for pair in pairs:
        loser, winner = _loser(rooms, apart, *pair)
        if loser and winner not in kept_out[loser]:
            kept_out[loser].append(winner)
            apart[loser] = drawn(loser, *(apart[label] for label in kept_out[loser])) or apart[loser]
            pairs += [(loser, label) for label in apart if label != loser]
    return apart


def _unparted(one: Outline, other: Outline, free: BoolArray, grid: OccupancyGrid) -> bool:
    """Whether two rooms are open to each other, along a side or in all, wider than a door.

    And there is less wall than two thirds of what is open.
    """
    corners, others = one.corners_m, other.corners_m
    apart_m = np.maximum(corners.min(axis=0) - others.max(axis=0), others.min(axis=0) - corners.max(axis=0))
    if apart_m.max() > THICKEST_WALL_M:
        return False
    sides = []
    for edge in range(len(one.faces)):
        for place in range(len(other.faces)):
            line = in_common(one.edge(edge), other.edge(place))
            if line is not None:
                stretches = open_stretches(*line, free, grid)
                open_ = sum(float(np.hypot(*(end - begin))) for begin, end in stretches)
                sides.append((float(np.hypot(*(line[1] - line[0]))), open_))
    sides.append((sum(whole for whole, _ in sides), sum(open_ for _, open_ in sides)))
    return any(open_ > WIDEST_DOOR_M and 3 * (whole - open_) < 2 * open_ for whole, open_ in sides)


def _loser(rooms: RoomMap, outlines: dict[int, Outline], one: int, other: int) -> tuple[int, int]:
    """Of two rooms that overlap the one with less of what both have, and the other; 0 where they do not."""
    corners = [outlines[label].corners_m for label in (one, other)]
    low = np.max([corner.min(axis=0) for corner in corners], axis=0)
    high = np.min([corner.max(axis=0) for corner in corners], axis=0)
    x, y = (np.arange(a, max(a, b), rooms.resolution_m) for a, b in zip(low, high, strict=True))
    points = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
    both = rooms.at(points[inside(points, corners[0]) & inside(points, corners[1])])
    if not len(both):
        return 0, 0
    first = np.count_nonzero(both == one) < np.count_nonzero(both == other)
    return (one, other) if first else (other, one)
