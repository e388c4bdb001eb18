"""Decide which sides of rooms are walls, and which may be fronts of furniture from corner to corner.

A furniture front is as straight as a wall and its points scatter as little, so no fit can distinguish them.
Other observations can: a wall needs evidence from elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.estimation import TINY
from slam.mapping.room_outline import Outline
from slam.mapping.rooms import LARGEST_FURNITURE_M2, RoomMap
from slam.mapping.wall_fits import WallFit
from slam.mapping.wall_gaps import THICKEST_WALL_M
from slam.mapping.wall_segments import SAME_DIRECTION_RAD, Segment
from slam.measurements import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Side:
    """An edge of a room's outline, with the room on its left.

    Attributes
    ----------
    label
        Label of the room in `RoomMap`.
    begin_m, end_m
        (2,) map frame.
    fit
        Line fit through its points; None if there is none.
    ends_seen
        Whether the sides before and after it were seen; else it may go on there.
    odd
        Whether the room goes on around one of its ends, or it runs askew to most of the others: as
        furniture does.
    """

    label: int
    begin_m: FloatArray
    end_m: FloatArray
    fit: WallFit | None
    ends_seen: tuple[bool, bool]
    odd: bool

    def seen_whole(self, cell_m: float) -> bool:
        """Return whether it was seen from corner to corner, or on both sides of an object in front of it."""
        if self.fit is None:
            return False
        begin, end = self.fit.places(self.begin_m, self.end_m)
        spans = self.fit.seen_m(begin, end, cell_m)
        if len(spans) != 1:
            return len(spans) > 1
        reached = spans[0] == (0.0, abs(end - begin))
        return bool((reached | ~np.array(self.ends_seen)).all())


def sides_of(outlines: dict[int, Outline], fits: Sequence[Sequence[WallFit | None]]) -> list[Side]:
    """Return all edges of all outlines, by the labels of their rooms."""
    sides = []
    for (label, outline), ones in zip(outlines.items(), fits, strict=True):
        normals = np.array([face.normal for face in outline.faces])
        inward = np.linalg.det(np.stack([np.roll(normals, 1, axis=0), normals], axis=1)) < 0.0
        squares = np.abs(np.prod([normals @ normals.T, normals @ [[0, 1], [-1, 0]] @ normals.T], axis=0))
        is_odd = inward | np.roll(inward, -1) | (np.median(squares, axis=1) > TINY)
        is_wall = [face.seen for face in outline.faces]
        for edge, fit in enumerate(ones):
            neighbours = is_wall[edge - 1], is_wall[(edge + 1) % len(is_wall)]
            sides.append(Side(label, *outline.edge(edge), fit, neighbours, bool(is_odd[edge])))
    return sides


def sure_walls(sides: Sequence[Side], segments: Sequence[Segment], rooms: RoomMap) -> BoolArray:
    """(n,) which sides are walls.

    One is, where another room lies right behind, as far away as behind another wall; or the wall of another
    room is in line with it, or it was seen from corner to corner or on both sides of what stands before it.
    These are not enough where it is odd, or where a piece that faces the same way stands behind it, and
    belongs to no other room.

    Parameters
    ----------
    segments
        Of all that is straight.
    """
    cell_m, level = rooms.resolution_m, np.cos(SAME_DIRECTION_RAD)
    labels = np.array([side.label for side in sides])
    is_seen = np.array([side.fit is not None for side in sides], dtype=np.bool_)
    ends = np.array([(side.begin_m, side.end_m) for side in sides]).reshape(-1, 2, 2)
    into = np.array([side.fit.offset_m if side.fit else 0.0 for side in sides])
    gap_m, over, cosines = _behind(ends, ends)
    pairs = (labels[:, None] != labels) & is_seen & is_seen[:, None]
    back = pairs & (cosines < -level) & (over > THICKEST_WALL_M) & (np.abs(gap_m) < THICKEST_WALL_M)
    backed = (back & _usual(gap_m + into + into[:, None], back, cell_m)).any(axis=1)
    is_near = np.abs(gap_m + into[:, None] - into) < 0.5 * cell_m
    in_line = pairs & (cosines > level) & (over > -THICKEST_WALL_M) & is_near
    whole = np.array([side.seen_whole(cell_m) for side in sides], dtype=np.bool_)
    is_odd = np.array([side.odd for side in sides], dtype=np.bool_)
    doubtful = is_odd | _hidden(ends, labels, segments, rooms)
    return np.asarray(is_seen & (backed | (whole | in_line.any(axis=1)) & ~doubtful))


def _behind(ends_m: FloatArray, others_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (n, m) distances of m sides behind n others, their overlap, and cosines of the directions."""
    edges_m = ends_m[:, 1] - ends_m[:, 0]
    length = np.maximum(np.hypot(*edges_m.T), TINY)
    along = edges_m / length[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0]])
    to = others_m[None] - ends_m[:, None, :1]
    reach = np.sort(np.einsum("nmek,nk->nme", to, along), axis=2)
    over = np.minimum(reach[..., 1], length[:, None]) - np.maximum(reach[..., 0], 0.0)
    turned = others_m[:, 1] - others_m[:, 0]
    cosines = along @ (turned / np.maximum(np.hypot(*turned.T), TINY)[:, None]).T
    return -np.einsum("nmek,nk->nm", to, across) / 2.0, over, cosines


def _usual(thickness_m: FloatArray, back: BoolArray, cell_m: float) -> BoolArray:
    """Return (n, n) whether the thickness between two sides is that of other pairs; True for a single one."""
    one, other = np.nonzero(np.triu(back | back.T))
    thick = thickness_m[one, other]
    like = (np.abs(thick - thick[:, None]) < 0.5 * cell_m).sum(axis=1) > min(len(thick) - 1, 1)
    usual = np.zeros_like(back)
    usual[one, other] = usual[other, one] = like
    return usual


def _hidden(ends_m: FloatArray, labels: FloatArray, segments: Sequence[Segment], rooms: RoomMap) -> BoolArray:
    """Return (n,) whether a piece of wall or front is behind a side and belongs to no other room."""
    if not segments:
        return np.zeros(len(ends_m), np.bool_)
    pieces = np.array([(piece.begin_m, piece.end_m) for piece in segments])
    normals, cell_m = np.array([piece.normal for piece in segments]), rooms.resolution_m
    before = [rooms.at(pieces.mean(axis=1) + cells * cell_m * normals) for cells in (2, 3)]
    free = [(label == 0) | (label == labels[:, None]) for label in before]
    gap_m, over, cosines = _behind(ends_m, pieces)
    behind = (gap_m > 2.0 * cell_m) & (gap_m < LARGEST_FURNITURE_M2**0.5) & (over > 2.0 * cell_m)
    return np.asarray((behind & (cosines > np.cos(SAME_DIRECTION_RAD)) & free[0] & free[1]).any(axis=1))
