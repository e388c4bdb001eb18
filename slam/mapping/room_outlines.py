"""Outlines of all rooms of a floor, without overlap."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from itertools import combinations

import numpy as np

from slam.mapping.polygons import inside
from slam.mapping.room_outline import Outline, room_outline
from slam.mapping.rooms import RoomMap
from slam.mapping.wall_segments import WallPoints


def room_outlines(
    rooms: RoomMap, own: Mapping[int, WallPoints], entered: Container[int]
) -> dict[int, Outline]:
    """Return the outline of each room by its label, the largest first.

    Parameters
    ----------
    own
        The points of each room's walls, by its label.
    entered
        Labels of the rooms in which the robot has been.
    """

    def drawn(label: int, *others: Outline) -> Outline | None:
        return room_outline(rooms, label, own[label], others)

    shapes = {label: drawn(label) for label in own}
    # A room without walls that the robot did not enter is behind a window.
    outlines = {
        label: outline
        for label, outline in shapes.items()
        if outline is not None and (label in entered or any(face.seen for face in outline.faces))
    }
    return _apart(rooms, outlines, drawn)


def _apart(
    rooms: RoomMap, outlines: dict[int, Outline], drawn: Callable[..., Outline | None]
) -> dict[int, Outline]:
    """Of two overlapping outlines, redraw the one with less of the overlap, outside the other."""
    final = dict(outlines)
    kept_out: dict[int, list[int]] = {label: [] for label in outlines}
    pairs = list(combinations(final, 2))
    for pair in pairs:
        loser, winner = _loser(rooms, final, *pair)
        if loser and winner not in kept_out[loser]:
            kept_out[loser].append(winner)
            final[loser] = drawn(loser, *(final[label] for label in kept_out[loser])) or final[loser]
            pairs += [(loser, label) for label in final if label != loser]
    return final


def _loser(rooms: RoomMap, outlines: dict[int, Outline], one: int, other: int) -> tuple[int, int]:
    """Return the room with less of the overlap of two rooms, and the other; 0 without overlap."""
    corners = [outlines[label].corners_m for label in (one, other)]
    low = np.max([corner.min(axis=0) for corner in corners], axis=0)
    high = np.min([corner.max(axis=0) for corner in corners], axis=0)
    x, y = (np.arange(a, max(a, b), rooms.resolution_m) for a, b in zip(low, high, strict=True))
    points = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
    overlap = rooms.at(points[inside(points, corners[0]) & inside(points, corners[1])])
    if not len(overlap):
        return 0, 0
    first = np.count_nonzero(overlap == one) < np.count_nonzero(overlap == other)
    return (one, other) if first else (other, one)
