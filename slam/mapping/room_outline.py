"""Outline of a room: which faces of the arrangement of its wall lines are inside.

The lines of all straight walls divide the plane into faces (Mura et al. 2014). Inside are faces seen free to
a third, and faces hidden by furniture: in front of the outermost lines, no larger than the largest furniture.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import scipy
from numpy.typing import NDArray

from fusion.estimation import FEWEST
from slam.mapping.polygons import inside
from slam.mapping.rooms import LARGEST_FURNITURE_M2, RoomMap
from slam.mapping.wall_gaps import WIDEST_DOOR_M
from slam.mapping.wall_segments import SAME_DIRECTION_RAD, Segment, WallPoints, wall_segments
from slam.measurements import BoolArray, FloatArray


@dataclass(frozen=True, slots=True)
class Face:
    """An infinite line with a room in front of it.

    Attributes
    ----------
    point_m
        (2,) point on it, map frame.
    normal
        (2,) unit vector into the room.
    seen
        Whether beams hit it; otherwise it is the border of the visible area.
    length_m
        Visible length.
    """

    point_m: FloatArray
    normal: FloatArray
    seen: bool
    length_m: float

    @property
    def tangent(self) -> FloatArray:
        """Return (2,) the unit vector along it; the room is on the left in the opposite direction."""
        x, y = self.normal
        return np.array([y, -x])

    def along(self, points_m: FloatArray) -> FloatArray:
        """Return (N,) positions of (N, 2) points along it, from its point."""
        return np.asarray((points_m - self.point_m) @ self.tangent)

    def off(self, points_m: FloatArray) -> FloatArray:
        """Return (N,) distances of (N, 2) points, positive inside."""
        return np.asarray((points_m - self.point_m) @ self.normal)


@dataclass(frozen=True, slots=True)
class Outline:
    """A polygon, counter-clockwise; edge i leads from corner i to the next, along face i."""

    corners_m: FloatArray
    faces: tuple[Face, ...]

    def edge(self, edge: int) -> tuple[FloatArray, FloatArray]:
        """Return (2,) the start and end corners of an edge."""
        return self.corners_m[edge], self.corners_m[(edge + 1) % len(self.faces)]

    def ends(self, edge: int) -> tuple[float, float]:
        """Return the ends of an edge along its face, by `Face.along`, the lower first."""
        low, high = sorted(self.faces[edge].along(np.array(self.edge(edge))).tolist())
        return low, high


def corners_of(faces: Sequence[Face]) -> FloatArray:
    """Return (n, 2) the intersections of each face with the previous one."""
    normals = np.array([[face.normal for face in (faces[k - 1], face)] for k, face in enumerate(faces)])
    offsets = np.array([face.normal @ face.point_m for face in faces])
    return np.asarray(
        np.linalg.solve(normals, np.stack([np.roll(offsets, 1), offsets], axis=1)[..., None])[..., 0]
    )


def area_m2(corners_m: FloatArray) -> float:
    """Return the area of a polygon, positive if counter-clockwise."""
    x, y = (corners_m - corners_m.mean(axis=0)).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def seen_from(rooms: RoomMap, points: WallPoints) -> NDArray[np.int32]:
    """Return (2, N) the rooms from which points were seen: two cells in front of each, and three."""
    cell = rooms.resolution_m
    return np.array([rooms.at(points.points_map + cells * cell * points.normals_map) for cells in (2, 3)])


def room_outline(
    rooms: RoomMap, label: int, points: WallPoints, others: Sequence[Outline] = ()
) -> Outline | None:
    """Return the outline of a room from the points seen from inside; None if they form none.

    It does not overlap others.
    """
    cell = rooms.resolution_m
    of_room = rooms.labels == label
    rows, cols = np.nonzero(of_room)
    middles = rooms.middles(rows, cols)
    segments = wall_segments(points, cell, 4 * cell)
    axes = _axes(segments)
    faces = _faces(segments, axes, cell)
    faces += _ends(faces, axes, middles, cell)
    margin = math.ceil(LARGEST_FURNITURE_M2**0.5 / cell)
    low = np.array([rows.min(), cols.min()]) - margin
    high = np.array([rows.max(), cols.max()]) + margin + 1
    grid_rows, grid_cols = np.mgrid[low[0] : high[0], low[1] : high[1]]
    everywhere = rooms.middles(grid_rows.ravel(), grid_cols.ravel())
    labels = rooms.at(everywhere).reshape(grid_rows.shape)
    before = np.array([face.off(everywhere) > 0.0 for face in faces]).reshape(len(faces), *labels.shape)
    mask = _inside(labels, label, before, cell)
    for other in others:
        mask &= ~inside(everywhere, other.corners_m).reshape(labels.shape)
        faces += [Face(face.point_m, -face.normal, False, 0.0) for face in other.faces]
    mask = _largest(mask, labels == label)
    if not mask.any():
        return None
    middles_m = everywhere.reshape(*labels.shape, 2)
    return _traced(mask, faces, middles_m, cell) or _boxed(middles_m[mask], axes)


def _axes(segments: list[Segment]) -> FloatArray:
    """Return (4, 2) unit vectors along and across most of the walls."""
    if not segments:
        return np.array([(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
    lengths = np.array([segment.length_m for segment in segments])
    # Four times the angle is the same for all four directions.
    turned = np.exp(4j * np.array([math.atan2(*segment.along[::-1]) for segment in segments]))
    parallel = np.abs(np.angle(turned[:, None] / turned)) < 0.5 * SAME_DIRECTION_RAD
    best = parallel[np.argmax(parallel @ lengths)]
    x, y = _direction(complex((turned * lengths)[best].sum()))
    return np.array([(x, y), (-x, -y), (-y, x), (y, -x)])


def _direction(fourfold: complex) -> tuple[float, float]:
    """Return a unit vector at a quarter of a complex number's angle."""
    angle = math.atan2(fourfold.imag, fourfold.real) / 4
    return math.cos(angle), math.sin(angle)


def _faces(segments: list[Segment], axes: FloatArray, cell_m: float) -> list[Face]:
    """Return one face for all segments on a line, longest first, aligned with an axis if possible."""
    faces: list[Face] = []
    for segment in segments:
        middle, normal = 0.5 * (segment.begin_m + segment.end_m), segment.normal
        nearest = axes[np.argmax(axes @ normal)]
        # The ends of a segment are within a cell of its line.
        if abs(nearest[0] * normal[1] - nearest[1] * normal[0]) < 2.0 * cell_m / segment.length_m:
            normal = nearest
        elif segment.length_m < 0.5 * WIDEST_DOOR_M:
            continue
        for index, face in enumerate(faces):
            if (
                face.normal @ normal > np.cos(SAME_DIRECTION_RAD)
                and abs(face.off(middle[None])[0]) < 3 * cell_m / 2
            ):
                faces[index] = replace(face, length_m=face.length_m + segment.length_m)
                break
        else:
            faces.append(Face(middle, normal, True, segment.length_m))
    return faces


def _ends(faces: list[Face], axes: FloatArray, middles_m: FloatArray, cell_m: float) -> list[Face]:
    """Return faces where the visible area ends without a wall."""
    sides = []
    for inward in axes:
        at = float(np.percentile(middles_m @ inward, 1)) - 0.5 * cell_m
        walls = [
            face
            for face in faces
            if face.normal @ inward > np.cos(SAME_DIRECTION_RAD)
            and abs(face.point_m @ inward - at) < 4 * cell_m
        ]
        if not walls:
            sides.append(Face(at * inward, inward, False, 0.0))
    return sides


def _inside(labels: NDArray[np.int32], label: int, before: BoolArray, cell_m: float) -> BoolArray:
    """Return (rows, cols) the cells in the room."""
    # Cells on the same sides of all lines form a face of the arrangement.
    keys = np.zeros(labels.shape, np.uint64)
    for index, side in enumerate(before):
        keys ^= np.where(side, np.random.default_rng(index).integers(1 << 63, dtype=np.uint64), np.uint64(0))
    _, owner = np.unique(keys, return_inverse=True)
    owner = owner.reshape(labels.shape)
    sizes = np.bincount(owner.ravel())
    free = np.bincount(owner.ravel(), (labels == label).ravel())
    within = (3 * free > sizes)[owner]
    hull = np.ones_like(within)
    for side in before:
        if np.count_nonzero(within & ~side) < FEWEST:
            hull &= side
    within &= hull
    pockets, count = scipy.ndimage.label(hull & ~within)
    for pocket in range(1, count + 1):
        where = pockets == pocket
        size = np.count_nonzero(where)
        others = np.count_nonzero(where & (labels > 0) & (labels != label))
        if size * cell_m**2 <= LARGEST_FURNITURE_M2 and 10 * others < size:
            within |= where
    return np.asarray(within)


def _largest(mask: BoolArray, free: BoolArray) -> BoolArray:
    """Return (rows, cols) the part with most of the free cells, without holes."""
    parts, _ = scipy.ndimage.label(mask)
    most = np.bincount(parts[free], minlength=parts.max() + 1)
    most[0] = 0
    return np.asarray(scipy.ndimage.binary_fill_holes((parts == np.argmax(most)) & bool(most.any())))


def _traced(mask: BoolArray, faces: list[Face], middles_m: FloatArray, cell_m: float) -> Outline | None:
    """Return the border of cells as a polygon of the lines that formed it."""
    import cv2

    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    border = max(contours, key=len)[:, 0, ::-1]
    points = middles_m[tuple(border.T)]
    d_m = np.array([face.off(points) for face in faces])
    # The centre of a cell inside the border is half a cell, at most half its diagonal, from the line.
    d_m = np.where((d_m > -0.5 * cell_m) & (d_m < 3 * cell_m / 2), np.abs(d_m - 0.5 * cell_m), np.inf)
    nearest = np.where(np.isfinite(d_m.min(axis=0)), np.argmin(d_m, axis=0), -1)
    # A corner cell is at two lines: it belongs to that of its neighbours.
    owners = _runs(nearest, 3)
    # Between two consecutive parallel lines, the step is too short to be detected.
    owners = [
        one
        for index, one in enumerate(owners)
        if abs(np.linalg.det([faces[one].normal, faces[owners[index - 1]].normal])) > SAME_DIRECTION_RAD
    ]
    if len(owners) < 3:
        return None
    edges = [faces[owner] for owner in owners]
    polygon = corners_of(edges)
    if area_m2(polygon) < 0.0:
        edges = edges[::-1]
        polygon = corners_of(edges)
    size = np.count_nonzero(mask) * cell_m**2
    if not 3 * size < 4 * area_m2(polygon) < 5 * size:
        return None
    return Outline(polygon, tuple(edges))


def _boxed(middles_m: FloatArray, axes: FloatArray) -> Outline:
    """Return the bounding box of a room whose walls form no polygon."""
    faces = [
        Face(float((middles_m @ inward).min()) * inward, inward, False, 0.0) for inward in axes[[2, 1, 3, 0]]
    ]
    corners = corners_of(faces)
    if area_m2(corners) < 0.0:
        faces = faces[::-1]
    return Outline(corners_of(faces), tuple(faces))


def _runs(nearest: NDArray[np.int64], shortest: int) -> list[int]:
    """Return the lines along a closed border in order, without short runs and parallel neighbours."""
    count = len(nearest)
    starts = np.flatnonzero(nearest != np.roll(nearest, 1))
    if not len(starts):
        return []
    lengths = np.diff(np.append(starts, starts[0] + count))
    runs = [
        int(nearest[start])
        for start, length in zip(starts, lengths, strict=True)
        if length >= shortest and nearest[start] >= 0
    ]
    return [run for index, run in enumerate(runs) if run != runs[index - 1]]


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

    found = {label: drawn(label) for label in own}
    # A room without walls that the robot did not enter is behind a window.
    outlines = {
        label: outline
        for label, outline in found.items()
        if outline is not None and (label in entered or any(face.seen for face in outline.faces))
    }
    return _apart(rooms, outlines, drawn)


def _apart(
    rooms: RoomMap, outlines: dict[int, Outline], drawn: Callable[..., Outline | None]
) -> dict[int, Outline]:
    """Of two overlapping outlines, redraw the one with less of the overlap, outside the other."""
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


def _loser(rooms: RoomMap, outlines: dict[int, Outline], one: int, other: int) -> tuple[int, int]:
    """Return the room with less of the overlap of two rooms, and the other; 0 without overlap."""
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
