"""Rooms of a floor: free space, divided where walls have gaps no wider than a door.

Narrow passages separate rooms (distance transform and others: Bormann et al. 2016, "Room segmentation:
survey, implementation, and analysis"), but furniture also leaves narrow passages. So a passage counts only if
a wall continues in line with it, between the same two rooms, two thirds as long as the passage is wide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import scipy
from numpy.typing import NDArray

from slam.mapping.occupancy_grid import FREE, OCCUPIED, OccupancyGrid, looked_up
from slam.mapping.wall_gaps import THICKEST_WALL_M, WIDEST_DOOR_M, wall_gaps
from slam.mapping.wall_segments import Segment
from slam.measurements import BoolArray, FloatArray

Labels = NDArray[np.int32]

# The size of a double bed.
LARGEST_FURNITURE_M2 = 4.0


@dataclass(frozen=True, slots=True)
class RoomMap:
    """The room of each free cell.

    Attributes
    ----------
    labels
        (rows, cols) number of the room, from 1; 0 elsewhere.
    """

    labels: Labels
    resolution_m: float
    T_map_grid: gtsam.Pose2

    def middles(self, rows: NDArray[np.int64], cols: NDArray[np.int64]) -> FloatArray:
        """Return (N, 2) cell centres, map frame; they may be outside the map."""
        points = (np.column_stack([cols, rows]) + 0.5) * self.resolution_m
        turned: FloatArray = points @ self.T_map_grid.rotation().matrix().T + self.T_map_grid.translation()
        return turned

    def at(self, points_map: FloatArray) -> Labels:
        """Return (N,) the room of (N, 2) points; 0 outside."""
        frame = OccupancyGrid(np.zeros((0, 0), np.int16), self.resolution_m, self.T_map_grid)
        return looked_up(self.labels, frame.cells_of(points_map))


def segment_rooms(grid: OccupancyGrid, segments: Sequence[Segment], path_map: FloatArray) -> RoomMap:
    """Divide the free cells of a grid into rooms.

    Parameters
    ----------
    segments
        Segments of walls and other straight objects.
    path_map
        (N, 2) where the robot has been.

    Returns
    -------
    Rooms sorted by size. Free space seen through glass or a gap, without walls of its own, is no room.
    """
    free = grid.states() == FREE
    gaps, walls = wall_gaps(segments, grid)
    labels, real = _regions(free, [*gaps, *walls], grid, path_map)
    labels = _merged(labels, gaps, real, grid)
    return RoomMap(labels, grid.resolution_m, grid.T_map_grid)


def _regions(
    free: BoolArray, lines: Sequence[Segment], grid: OccupancyGrid, path_map: FloatArray
) -> tuple[Labels, BoolArray]:
    """Return the parts of free space between lines, and (parts + 1,) which are indoors; label 0 is, too."""
    labels = _wide_parts(free & ~_drawn(lines, grid), int(0.25 * THICKEST_WALL_M / grid.resolution_m))
    real = _closed(labels, grid.states())
    real[looked_up(labels, grid.cells_of(path_map))] = True
    real[0] = True
    return labels, real


def _wide_parts(free: BoolArray, radius: int) -> Labels:
    """Return parts of free space connected by more than a slit, as beams leave between two panes.

    A slit is up to twice the radius wide, in cells; it is assigned to one of the parts it connects.
    """
    block = np.ones((3, 3), np.bool_)
    core = scipy.ndimage.binary_erosion(free, block, iterations=radius) if radius else free
    labels = np.asarray(scipy.ndimage.label(core)[0], dtype=np.int32)
    cross = scipy.ndimage.generate_binary_structure(2, 1)
    for _ in range(4 * radius):
        grown = scipy.ndimage.maximum_filter(labels, footprint=cross)
        labels = np.where(free & (labels == 0), grown, labels)
    # The area between two close lines is a part, too.
    parts, count = scipy.ndimage.label(free)
    strips = np.bincount(parts.ravel(), core.ravel(), count + 1) == 0.0
    return np.where(strips[parts] & free, parts + labels.max(initial=0), labels).astype(np.int32)


def _drawn(lines: Sequence[Segment], grid: OccupancyGrid) -> BoolArray:
    """Return (rows, cols) the cells of lines, 4-connected."""
    drawn = np.zeros(grid.shape, np.bool_)
    for line in lines:
        cells = grid.cells_of(line.points(grid.resolution_m / 4))
        inside = ((cells >= 0) & (cells < grid.shape)).all(axis=1)
        drawn[tuple(cells[inside].T)] = True
    return np.asarray(scipy.ndimage.binary_dilation(drawn, np.ones((2, 2), np.bool_)))


def _closed(labels: Labels, states: NDArray[np.int8]) -> BoolArray:
    """Return (labels + 1,) whether a region is bounded by known cells rather than unknown ones."""
    unknown, known = (np.zeros(labels.max() + 1) for _ in range(2))
    for axis in (0, 1):
        for shift in (1, -1):
            neighbours = np.roll(states, shift, axis)
            edge = (labels > 0) & (neighbours != FREE)
            unknown += np.bincount(labels[edge & (neighbours != OCCUPIED)], minlength=len(unknown))
            known += np.bincount(labels[edge & (neighbours == OCCUPIED)], minlength=len(known))
    return np.asarray(known > unknown)


def _merged(labels: Labels, gaps: Sequence[Segment], real: BoolArray, grid: OccupancyGrid) -> Labels:
    """Merge parts without a wall between them, drop those that are no rooms, number the rest by size.

    Two rooms have wall between them, in line with their openings, two thirds as long as these are wide:
    across a corridor, or from one piece of furniture to another, there is none.
    """
    free = grid.states() == FREE
    areas = np.asarray(np.bincount(labels.ravel(), minlength=len(real)) * grid.resolution_m**2, np.float64)
    areas[0] = 0.0
    # Parts no larger than a doorway are no rooms.
    smallest = THICKEST_WALL_M * WIDEST_DOOR_M
    owner = np.arange(len(real))
    for one, other in _touching(labels):
        if real[one] and real[other]:
            owner[owner == owner[one]] = owner[other]
    # First the doorways themselves, between the faces of a wall.
    for parting in (False, True):
        merged = np.where(real, owner, 0)[labels].astype(np.int32)
        edges = []
        for gap in gaps:
            open_ = _open(free, gap, grid)
            one, other = _sides(merged, gap, open_, grid)
            if one and other and real[one] and real[other] and one != other:
                wall = _in_line(merged, free, gap, grid) if parting else None
                places = _places(gap.points(grid.resolution_m)[open_], gap, grid)
                edges.append(_Opening(one, other, places, wall))
        _join(owner, areas, edges, smallest)
    sizes = np.bincount(owner, areas, len(owner))
    rooms = real & (sizes[owner] >= smallest)
    order = np.unique(owner[rooms])
    number = np.zeros(len(owner), np.int32)
    number[order[np.argsort(-sizes[order], kind="stable")]] = np.arange(1, len(order) + 1)
    return np.where(rooms, number[owner], 0).astype(np.int32)[labels]


def _touching(labels: Labels) -> NDArray[np.int32]:
    """Return (n, 2) adjacent parts."""
    pairs = [
        np.column_stack([ahead[border], behind[border]])
        for ahead, behind in ((labels[1:], labels[:-1]), (labels[:, 1:], labels[:, :-1]))
        for border in [(ahead > 0) & (behind > 0) & (ahead != behind)]
    ]
    return np.unique(np.concatenate(pairs), axis=0)


@dataclass(frozen=True, slots=True)
class _Opening:
    """A gap between two parts of free space.

    Attributes
    ----------
    one, other
        Parts on its left and right.
    cells
        (n,) positions along its line, so that a gap seen from both sides counts once.
    wall
        Objects in line with it; None if no wall can separate the two.
    """

    one: int
    other: int
    cells: NDArray[np.int64]
    wall: _InLine | None


@dataclass(frozen=True, slots=True)
class _InLine:
    """Objects in line with a gap.

    Attributes
    ----------
    cells
        (n,) positions, as those of the gap.
    beside
        (2, n) parts on the left and on the right; 0 if none is seen.
    near
        (n,) whether it is so near to an end of the gap that it would be the side of a door.
    """

    cells: NDArray[np.int64]
    beside: Labels
    near: BoolArray

    def between(self, owner: NDArray[np.int64], one: int, other: int) -> BoolArray:
        """Return (n,) where the owners of the two parts are beside it."""
        sides = np.array([[owner[one]], [owner[other]]])
        seen, of_them = self.beside > 0, owner[self.beside] == sides
        joined = of_them.all(axis=0)
        # Furniture may hide one side of a wall that is no thicker than one beside the gap.
        hidden = (of_them & ~seen[::-1]).any(axis=0) & joined[self.near].any()
        return np.asarray(joined | hidden)


def _join(owner: NDArray[np.int64], areas: FloatArray, openings: Sequence[_Opening], smallest: float) -> None:
    """Merge neighbours if one is too small, or if there is too little wall between them.

    The smallest are merged first, over the widest opening. Merged parts count as one for the next.
    """
    while True:
        sizes = np.bincount(owner, areas, len(owner))
        pairs: dict[tuple[int, int], tuple[set[int], set[int] | None]] = {}
        for opening in openings:
            low, high = sorted((int(owner[opening.one]), int(owner[opening.other])))
            if low == high:
                continue
            gap, wall = pairs.setdefault((low, high), (set(), set() if opening.wall else None))
            gap |= set(opening.cells.tolist())
            if opening.wall and wall is not None:
                between = opening.wall.between(owner, opening.one, opening.other)
                wall |= set(opening.wall.cells[between].tolist())
        open_ = [
            (min(sizes[one], sizes[other]), -len(gap), one, other)
            for (one, other), (gap, wall) in pairs.items()
            if min(sizes[one], sizes[other]) < smallest or (wall is not None and 3 * len(wall) < 2 * len(gap))
        ]
        if not open_:
            return
        _, _, one, other = min(open_)
        owner[owner == one] = other


def _places(points_m: FloatArray, gap: Segment, grid: OccupancyGrid) -> NDArray[np.int64]:
    """Return (n,) points along a gap's line in cells, independent of the side of the wall."""
    step_m = gap.end_m - gap.begin_m
    along = step_m * np.sign(step_m[np.argmax(np.abs(step_m))]) / max(gap.length_m, grid.resolution_m)
    return np.asarray(np.floor(points_m @ along / grid.resolution_m), dtype=np.int64)


def _in_line(labels: Labels, free: BoolArray, gap: Segment, grid: OccupancyGrid) -> _InLine:
    """Return the objects in line with a gap, up to a door's width past each end."""
    step_m, cells, labels_of, is_near = grid.resolution_m, [], [], []
    asides = np.arange(2.0 * step_m, THICKEST_WALL_M, step_m)
    for end_m, begin_m in ((gap.end_m, gap.begin_m), (gap.begin_m, gap.end_m)):
        along = (end_m - begin_m) / max(gap.length_m, step_m)
        beyond = Segment(end_m + step_m * along, end_m + WIDEST_DOOR_M * along)
        sides = []
        for side in (1.0, -1.0) if begin_m is gap.begin_m else (-1.0, 1.0):
            points = np.array([beyond.points(step_m, side * far) for far in asides])
            labels_met = looked_up(labels, grid.cells_of(points.reshape(-1, 2))).reshape(len(asides), -1)
            # The nearest label to the wall is beside it.
            sides.append(labels_met[np.argmax(labels_met > 0, axis=0), np.arange(len(labels_met.T))])
        stands = ~_open(free, beyond, grid)
        labels_of.append(np.array(sides)[:, stands])
        cells.append(_places(beyond.points(step_m)[stands], gap, grid))
        is_near.append((np.arange(len(stands)) * step_m < THICKEST_WALL_M)[stands])
    return _InLine(np.concatenate(cells), np.concatenate(labels_of, axis=1), np.concatenate(is_near))


def _open(free: BoolArray, line: Segment, grid: OccupancyGrid) -> BoolArray:
    """Return (n,) where a line is open: there is no wall, seen or hidden."""
    step_m = grid.resolution_m
    across = np.array([line.points(step_m, side * step_m) for side in (-1.0, 0.0, 1.0)])
    return np.asarray(looked_up(free, grid.cells_of(across.reshape(-1, 2))).reshape(3, -1).all(axis=0))


def _sides(labels: Labels, gap: Segment, open_: BoolArray, grid: OccupancyGrid) -> list[int]:
    """Return the most frequent labels on the left and right of its open cells; 0 if there is none."""
    sides = []
    for side in (1.0, -1.0):
        points = [gap.points(grid.resolution_m, side * far * grid.resolution_m)[open_] for far in (2.0, 3.0)]
        counts = np.bincount(looked_up(labels, grid.cells_of(np.concatenate(points))), minlength=1)
        counts[0] = 0
        sides.append(int(np.argmax(counts)))
    return sides
