"""Combine changes into moved objects: one that disappeared here and appeared there in the same shape."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, spatial

from slam.measurements import FloatArray, one_line
from slam.sessions.changes import Change

# Rotation steps for comparing two shapes: at most a cell at the edge of a piece of furniture.
_TURNS = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
# Minimum overlap of two outlines of the same object, as a fraction.
_ALIKE = 0.7


@dataclass(frozen=True, slots=True)
class ChangedThing:
    """An object that disappeared, appeared or moved between two visits.

    Attributes
    ----------
    what
        ``went``, ``appeared`` or ``moved``.
    before_m, after_m
        (M, 2) corners around it on the first and on the second visit, map frame; None if it was not there.
    size_m
        Length and width of the part that the lidar saw, rounded to cells.
    probability
        Probability of the change; for ``moved``, that both places changed.
    """

    what: str
    before_m: FloatArray | None
    after_m: FloatArray | None
    size_m: tuple[float, float]
    probability: float

    __repr__ = one_line

    @property
    def places_m(self) -> list[FloatArray]:
        """Return (2,) the centre of its old and of its new position; one of them, or both."""
        boxes = [corners for corners in (self.before_m, self.after_m) if corners is not None]
        return [0.5 * (corners.min(axis=0) + corners.max(axis=0)) for corners in boxes]

    @property
    def moved_m(self) -> float:
        """Distance that it moved; 0 if it disappeared or appeared."""
        places = self.places_m
        return math.dist(places[0], places[-1])


def changed_things(changes: Sequence[Change], cell_m: float) -> list[ChangedThing]:
    """Return changed objects, the most likely first; two changes of the same shape are one moved object."""
    went = [change for change in changes if not change.appeared]
    came = [change for change in changes if change.appeared]
    likeness = np.array([[_likeness(old.cells_m, new.cells_m, cell_m) for new in came] for old in went])
    things, paired = [], set()
    # Among similar objects, assume the smallest total motion.
    ways_m = [[math.dist(old.cells_m.mean(axis=0), new.cells_m.mean(axis=0)) for new in came] for old in went]
    cost = np.where(likeness > _ALIKE, ways_m, 1.0 + np.sum(ways_m)) if likeness.size else np.zeros((0, 0))
    for n, m in zip(*optimize.linear_sum_assignment(cost), strict=True):
        old, new = went[n], came[m]
        if likeness[n, m] > _ALIKE:
            paired |= {id(old), id(new)}
            larger = max(old.cells_m, new.cells_m, key=len)
            probability = old.probability * new.probability
            corners = _around(old.cells_m, cell_m), _around(new.cells_m, cell_m)
            things.append(ChangedThing("moved", *corners, _size(larger, cell_m), probability))
    for change in changes:
        if id(change) not in paired:
            around, size_m = _around(change.cells_m, cell_m), _size(change.cells_m, cell_m)
            what, before, after = ("appeared", None, around) if change.appeared else ("went", around, None)
            things.append(ChangedThing(what, before, after, size_m, change.probability))
    return sorted(things, key=lambda thing: -thing.probability)


def _likeness(one: FloatArray, other: FloatArray, cell_m: float) -> float:
    """Return how well two shapes, (N, 2) and (M, 2) cells, cover each other at the best rotation, 0 to 1.

    It is the mean of the shares of each that cover the other, since a lidar sees other sides of an object
    that was rotated. Shapes of different length do not match.
    """
    if round(abs(_size(one, cell_m)[0] - _size(other, cell_m)[0]) / cell_m) > 2:
        return 0.0
    tree, reach_m, best = spatial.cKDTree(other), math.sqrt(2.0) * cell_m, 0.0
    for turn in _TURNS:
        c, s = math.cos(turn), math.sin(turn)
        moved = one @ np.array([[c, s], [-s, c]])
        moved += 0.5 * (other.min(axis=0) + other.max(axis=0) - moved.min(axis=0) - moved.max(axis=0))
        there, back = tree.query(moved)[0], spatial.cKDTree(moved).query(other)[0]
        best = max(best, 0.5 * float(np.mean(there <= reach_m) + np.mean(back <= reach_m)))
    return best


def _size(cells_m: FloatArray, cell_m: float) -> tuple[float, float]:
    """Return length and width of the smallest rectangle around (N, 2) cell centres, at least one cell."""
    sides = []
    for turn in _TURNS[: len(_TURNS) // 4]:
        c, s = math.cos(turn), math.sin(turn)
        sides.append(np.ptp(cells_m @ np.array([[c, -s], [s, c]]), axis=0))
    least = np.maximum(min(sides, key=lambda side: float(np.prod(side + cell_m))), cell_m)
    return float(least.max()), float(least.min())


def _around(cells_m: FloatArray, cell_m: float) -> FloatArray:
    """Return (M, 2) corners of the convex hull of (N, 2) cells, counter-clockwise."""
    square = 0.5 * cell_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = (cells_m[:, None] + square).reshape(-1, 2)
    return np.asarray(corners[spatial.ConvexHull(corners).vertices])
