"""Which sides of rooms are reported as walls: what speaks for one, and what against it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.mapping.room_outline import Face, Outline
from slam.mapping.rooms import RoomMap
from slam.mapping.sure_walls import sides_of, sure_walls
from slam.mapping.wall_fits import Contrast, WallFit
from slam.mapping.wall_segments import Segment

CELL_M = 0.05
SOUTH, EAST, NORTH, WEST = range(4)


def room(x0: float, y0: float, x1: float, y1: float, turn: float = 0.0) -> Outline:
    """A rectangle; its south side may be turned."""
    return outlined([(x0, y0), (x1, y0 + turn * (x1 - x0)), (x1, y1), (x0, y1)])


def outlined(points: list[tuple[float, float]]) -> Outline:
    """A polygon, all of whose sides were seen."""
    corners = np.array(points)
    ways = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack([-ways[:, 1], ways[:, 0]]) / np.hypot(*ways.T)[:, None]
    faces = [Face(corner, normal, True, 1.0) for corner, normal in zip(corners, normals, strict=True)]
    return Outline(corners, tuple(faces))


def fits(outline: Outline, *seen: tuple[float, float]) -> list[WallFit | None]:
    """Of all sides; the south one by points along these stretches, the others all along."""
    found: list[WallFit | None] = []
    for edge, face in enumerate(outline.faces):
        low, high = outline.ends(edge)
        stretches = [(low + a, low + b) for a, b in seen] if edge == SOUTH else [(low, high)]
        at = np.concatenate([np.arange(a + 0.01, b, 0.02) for a, b in stretches])
        still = Contrast(0.0, np.zeros(0))
        found.append(WallFit(face, 0.5 * (low + high), 0.0, 0.0, np.zeros((2, 0)), np.zeros(2), at, still))
    return found


def south(
    *seen: tuple[float, float],
    others: tuple[Outline, ...] = (),
    pieces: tuple[Segment, ...] = (),
    own: Outline | None = None,
) -> bool:
    """Whether the south side of a room, of 4 x 3 m if it is not said, is a wall."""
    outlines = {1: own or room(0.0, 0.0, 4.0, 3.0), **dict(enumerate(others, start=2))}
    lines = [fits(outlines[1], *seen), *(fits(one, (0.0, 9.0)) for one in others)]
    labels = np.zeros((400, 400), np.int32)
    corner = gtsam.Pose2(-10.0, -10.0, 0.0)
    for label, outline in outlines.items():
        low, high = ((outline.corners_m[[0, 2]] + 10.0) / CELL_M).astype(int)
        labels[low[1] : high[1], low[0] : high[0]] = label
    sides = sides_of(outlines, lines)
    return bool(sure_walls(sides, pieces, RoomMap(labels, CELL_M, corner))[SOUTH])


def test_a_side_seen_from_corner_to_corner_or_past_what_stands_before_it_is_a_wall() -> None:
    assert south((0.0, 4.0))
    assert south((0.2, 1.0), (2.5, 3.8))
    assert not south((0.5, 2.5))


def test_a_room_right_behind_or_a_wall_in_line_makes_it_one() -> None:
    assert south((0.5, 2.5), others=(room(0.0, -3.12, 4.0, -0.12),))
    assert south((0.5, 2.5), others=(room(4.12, 0.0, 7.0, 3.0),))
    assert not south((0.5, 2.5), others=(room(4.12, 0.2, 7.0, 3.0),))


def test_what_is_behind_must_be_as_far_away_as_elsewhere() -> None:
    behind, beside = room(0.0, -3.4, 4.0, -0.4), room(4.12, 0.3, 7.0, 3.0)
    assert south((0.5, 2.5), others=(behind,))
    assert not south((0.5, 2.5), others=(behind, beside))


@pytest.mark.parametrize(("y", "wall"), [(-0.4, False), (-2.5, True)])
def test_a_piece_behind_it_speaks_against_it_where_furniture_may_be(y: float, wall: bool) -> None:
    piece = Segment(np.array([3.2, y]), np.array([3.9, y]))
    assert south((0.0, 4.0), pieces=(piece,)) is wall
    assert south((0.0, 4.0), pieces=(Segment(piece.end_m, piece.begin_m),))


def test_a_piece_of_another_room_does_not() -> None:
    piece = Segment(np.array([0.0, -1.4]), np.array([4.0, -1.4]))
    assert south((0.0, 4.0), others=(room(0.0, -1.4, 4.0, -0.12),), pieces=(piece,))


def test_what_stands_askew_or_juts_into_the_room_is_none() -> None:
    assert not south((0.0, 4.0), own=room(0.0, 0.0, 4.0, 3.0, turn=0.05))
    corners = [(0.0, 0.0), (2.0, 0.0), (2.0, -1.0), (4.0, -1.0), (4.0, 3.0), (0.0, 3.0)]
    assert not south((0.0, 2.0), own=outlined(corners))
    assert south((0.0, 4.0), own=outlined([(0.0, 0.0), (4.0, 0.0), *corners[4:]]))
