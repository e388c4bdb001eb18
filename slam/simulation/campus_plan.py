"""Generates a large building from a seed: wings of similar corridors, connected by long corridors."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np

from slam.measurements import FloatArray
from slam.simulation.campus_walls import Corridor, campus_walls, overlapping

_APART_M = 5.0  # between a corridor that connects two wings and everything else
_CROSSING_M = 60.0  # detour that is preferred to crossing another corridor
_STRAIGHT_SLANT = 0.2  # junctions this close to a line along x or y are connected without a corner


@dataclass(frozen=True, slots=True, eq=False)
class Campus:
    """A building.

    Attributes
    ----------
    junctions_m
        (J, 2) ends of corridors, map frame.
    corridors
        All of them.
    ring
        Junctions of the loop through all wings; the last is connected to the first.
    walls_m, glass_m
        (W, 4) and (G, 4) rows of x1, y1, x2, y2: opaque walls, and glass.
    """

    junctions_m: FloatArray
    corridors: tuple[Corridor, ...]
    ring: tuple[int, ...]
    walls_m: FloatArray
    glass_m: FloatArray

    @property
    def corridor_m(self) -> float:
        """Total length of all corridors."""
        return sum(corridor.length_m for corridor in self.corridors)


def generate_campus(seed: int) -> Campus:
    """Generate a building: four or six wings with two patterns, rotated, mirrored, some slightly oblique."""
    rng = np.random.default_rng([seed, 0])
    columns = int(rng.integers(2, 4))
    pitch_m, longest_m = (
        (rng.uniform(105.0, 125.0), 85.0) if columns == 2 else (rng.uniform(85.0, 100.0), 60.0)
    )
    patterns = [_pattern(rng, number, longest_m) for number in range(2)]
    cells = [(column, 0) for column in range(columns)] + [(column, 1) for column in reversed(range(columns))]
    net = _Net(rng)
    wings = []
    for cell, number in zip(cells, rng.permutation(np.arange(len(cells)) % 2), strict=True):
        wings.append(net.add_wing(patterns[number], pitch_m * (np.array(cell) + rng.uniform(-0.05, 0.05, 2))))
    ring: list[int] = []
    for index, wing in enumerate(wings):
        ring += net.connect(wing, wings[(index + 1) % len(wings)], style=2 + index)
    if columns == 3 and rng.random() < 0.5:
        net.connect(wings[1], wings[4], style=2 + len(wings))
    walls, glass = campus_walls(net.corridors, np.random.default_rng([seed, 1]))
    return Campus(np.array(net.junctions), tuple(net.corridors), tuple(ring), walls, glass)


@dataclass(frozen=True, slots=True)
class _Pattern:
    """A wing before placement: a ladder of parallel corridors, around the origin."""

    number: int
    along_m: FloatArray  # of the rungs
    across_m: FloatArray  # of the rails
    widths_m: FloatArray  # rails first
    door_pitch_m: float


def _pattern(rng: np.random.Generator, number: int, longest_m: float) -> _Pattern:
    """Draw a ladder of two or three rails; half of them have evenly spaced rungs."""
    gaps = int(rng.integers(1, 4))
    along = rng.uniform(15.0, 32.0, gaps if rng.random() < 0.5 else 1) * np.ones(gaps)
    across = rng.uniform(15.0, 28.0, 2 if gaps < 3 and rng.random() < 0.4 else 1)
    rungs = np.concatenate([[0.0], np.cumsum(along * min(1.0, longest_m / along.sum()))])
    rails = np.concatenate([[0.0], np.cumsum(across)])
    widths = rng.uniform(1.8, 3.0, len(rails) + len(rungs))
    return _Pattern(number, rungs - rungs.mean(), rails - rails.mean(), widths, rng.uniform(3.0, 4.6))


@dataclass
class _Net:
    """Junctions and corridors so far."""

    rng: np.random.Generator
    junctions: list[FloatArray] = field(default_factory=list)
    corridors: list[Corridor] = field(default_factory=list)

    def add_wing(self, pattern: _Pattern, centre_m: FloatArray) -> list[int]:
        """Place a pattern, rotated by 90 degrees and slightly more, or mirrored; return its junctions."""
        askew_rad = math.radians(self.rng.uniform(-8.0, 8.0)) if self.rng.random() < 0.4 else 0.0
        angle, hand = 0.5 * math.pi * self.rng.integers(0, 4) + askew_rad, int(self.rng.choice([1, -1]))
        axes = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        first, shape = len(self.junctions), (len(pattern.across_m), len(pattern.along_m))
        for across, along in itertools.product(pattern.across_m, pattern.along_m):
            self.junctions.append(centre_m + np.array([along, hand * across]) @ axes)
        numbers = first + np.arange(shape[0] * shape[1]).reshape(shape)
        for line, nodes in enumerate([*numbers.tolist(), *numbers.T.tolist()]):
            style, width_m = (pattern.number, line), float(pattern.widths_m[line])
            self._add(nodes, width_m, style, pattern.door_pitch_m, hand)
        return list(numbers.ravel().tolist())

    def connect(self, here: list[int], there: list[int], style: int) -> list[int]:
        """Connect two wings, maybe with a corner, by a short path with few crossings; return junctions."""
        others = np.array([corridor.box(0.0, corridor.length_m, -1.0, 1.0) for corridor in self.corridors])
        options: list[tuple[float, int, int, list[FloatArray]]] = []
        for a, b in itertools.product(here, there):
            start, end = self.junctions[a], self.junctions[b]
            gap = np.abs(end - start)
            corners = [[np.array([end[0], start[1]])], [np.array([start[0], end[1]])]]
            for corner in [[]] if gap.min() < _STRAIGHT_SLANT * gap.max() else corners:
                cost = _cost_m([start, *corner, end], others) * self.rng.uniform(1.0, 1.25)
                options.append((cost, a, b, corner))
        _, a, b, corner = min(options, key=lambda option: option[0])
        nodes = [a, *range(len(self.junctions), len(self.junctions) + len(corner)), b]
        self.junctions += corner
        width_m = 5.0 if self.rng.random() < 0.25 else float(self.rng.uniform(1.8, 3.0))
        self._add(nodes, width_m, (style, 0), float(self.rng.uniform(4.0, 9.0)))
        return nodes

    def _add(
        self, nodes: list[int], width_m: float, style: tuple[int, int], door_pitch_m: float, hand: int = 1
    ) -> None:
        """Add a corridor from each junction of a line to the next."""
        for piece, (a, b) in enumerate(itertools.pairwise(nodes)):
            ends_m = np.array([self.junctions[a], self.junctions[b]])
            self.corridors.append(Corridor((a, b), ends_m, width_m, (*style, piece), door_pitch_m, hand))


def _cost_m(corners: list[FloatArray], corridors: FloatArray) -> float:
    """Length of a path, plus a detour for each corridor (N, 4, 2) that it would cross between its ends."""
    cost = 0.0
    for place, (p, q) in enumerate(itertools.pairwise(corners)):
        piece = Corridor((0, 0), np.array([p, q]), 0.0, (), 0.0)
        low = _APART_M if place == 0 else 0.0
        high = piece.length_m - (_APART_M if place == len(corners) - 2 else 0.0)
        cost += piece.length_m
        if high > low:
            crossed = overlapping(piece.box(low, high, -_APART_M, _APART_M), corridors)
            cost += _CROSSING_M * np.count_nonzero(crossed)
    return cost
