"""Generates a town: streets with kerbs on hills, houses, parked cars, trees, poles; or a tunnel."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from slam.measurements import FloatArray
from slam.simulation.sensor_clock import generator
from slam.simulation.street_mesh import Label, MeshBuilder, StreetMesh

LANE_M, KERB_M, BESIDE_M = 1.6, 5.0, 5.7  # distances from the middle of a street: lanes, kerb, trees
_PARKED_M, _FRONT_M = 4.0, 8.0  # parked cars, fronts of houses
KERB_HEIGHT_M = 0.12
_OUTSKIRTS_M = 30.0  # from the outermost street to the end of the town
_CORNER_M = 9.0  # minimum distance of a parked car to a crossing
_STEP_M = 2.0  # of the triangles of the ground
_STEEPEST = 0.04  # for each of the two waves of a hill
_TUNNEL_HALF_M, _TUNNEL_WALL_M, _TUNNEL_TOP_M = 5.5, 4.0, 6.5
# (length, width), lowest and highest z above the road: body and cabin.
CAR_PARTS = (((4.3, 1.8), (0.25, 0.85)), ((2.3, 1.6), (0.85, 1.45)))


@dataclass(frozen=True)
class Ground:
    """Hills: two waves.

    Attributes
    ----------
    waves
        (N, 4) wave numbers along x and y, phase, height.
    """

    waves: FloatArray

    def height_m(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Height of the road, with the shape of x."""
        kx, ky, phase, height = self.waves.T
        angle = np.multiply.outer(x, kx) + np.multiply.outer(y, ky) + phase
        total: FloatArray = (height * np.sin(angle)).sum(axis=-1)
        return total

    def slope(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Slope along x and along y."""
        kx, ky, phase, height = self.waves.T
        cos = height * np.cos(np.multiply.outer(x, kx) + np.multiply.outer(y, ky) + phase)
        return (cos * kx).sum(axis=-1), (cos * ky).sum(axis=-1)


@dataclass(frozen=True)
class Town:
    """Streets and the objects along them.

    Attributes
    ----------
    across_x, across_y
        Centre lines of the streets along y, and of those along x.
    low_m, high_m
        Corners of the whole town.
    mesh
        The static scene.
    tunnel_m
        Start and end along x; None without a tunnel.
    """

    across_x: FloatArray
    across_y: FloatArray
    low_m: FloatArray
    high_m: FloatArray
    ground: Ground
    mesh: StreetMesh
    tunnel_m: tuple[float, float] | None


def generate_town(home: int, *, tunnel: bool = False) -> Town:
    """Generate four streets in each direction; or a single one through a tunnel of 200 m without features."""
    rng = generator(home, "town")
    if tunnel:
        across_x, across_y, inside = np.zeros(0), np.zeros(1), (70.0, 270.0)
        low, high = np.array([-10.0, -_OUTSKIRTS_M]), np.array([340.0, _OUTSKIRTS_M])
    else:
        across_x = np.cumsum([0.0, *rng.uniform(50.0, 70.0, 3)])
        across_y = np.cumsum([0.0, *rng.uniform(40.0, 55.0, 3)])
        inside = None
        low = np.array([across_x[0], across_y[0]]) - _OUTSKIRTS_M
        high = np.array([across_x[-1], across_y[-1]]) + _OUTSKIRTS_M
    ground = _hills(rng)
    builder = MeshBuilder()
    blocks_x = _between(across_x, low[0], high[0])
    blocks_y = _between(across_y, low[1], high[1])
    _lay_ground(builder, ground, blocks_x, blocks_y, low, high)
    furnisher = _Furnisher(builder, ground, rng, inside)
    for block_x, block_y in itertools.product(blocks_x, blocks_y):
        furnisher.furnish((*block_x, *block_y), low, high)
    if inside is not None:
        _dig(builder, ground, inside)
    return Town(across_x, across_y, low, high, ground, builder.built(), inside)


def _hills(rng: np.random.Generator) -> Ground:
    """Two waves of 90 to 160 m with slightly different directions."""
    lengths, turns = rng.uniform(90.0, 160.0, 2), rng.uniform(0.0, np.pi) + np.array([0.0, 1.3])
    numbers = 2.0 * np.pi / lengths
    return Ground(
        np.column_stack(
            [
                numbers * np.cos(turns),
                numbers * np.sin(turns),
                rng.uniform(0.0, 2.0 * np.pi, 2),
                _STEEPEST / numbers,
            ]
        )
    )


def _between(streets: FloatArray, low: float, high: float) -> list[tuple[float, float]]:
    """Intervals between the kerbs of parallel streets."""
    edges = [low, *np.ravel([(at - KERB_M, at + KERB_M) for at in streets]), high]
    return list(zip(edges[::2], edges[1::2], strict=True))


def _lay_ground(
    builder: MeshBuilder,
    ground: Ground,
    blocks_x: list[tuple[float, float]],
    blocks_y: list[tuple[float, float]],
    low: FloatArray,
    high: FloatArray,
) -> None:
    """Add road everywhere, pavement on the blocks, and kerbs around them."""
    _patch(builder, ground, (low[0], high[0], low[1], high[1]), 0.0, Label.ROAD)
    for (west, east), (south, north) in itertools.product(blocks_x, blocks_y):
        _patch(builder, ground, (west, east, south, north), KERB_HEIGHT_M, Label.PAVEMENT)
        corners = np.array([(west, south), (east, south), (east, north), (west, north), (west, south)])
        for start, end in itertools.pairwise(corners):
            count = max(2, round(float(np.linalg.norm(end - start)) / _STEP_M) + 1)
            flat = np.linspace(start, end, count)
            foot = np.column_stack([flat, ground.height_m(*flat.T) - 0.2])
            builder.sheet(foot, foot + np.array([0.0, 0.0, 0.2 + KERB_HEIGHT_M]), Label.PAVEMENT, 0.35)


def _patch(
    builder: MeshBuilder,
    ground: Ground,
    edges: tuple[float, float, float, float],
    above_m: float,
    label: Label,
) -> None:
    """Add ground between minimum and maximum of x and y."""
    west, east, south, north = edges
    x = np.linspace(west, east, max(2, round((east - west) / _STEP_M) + 1))
    y = np.linspace(south, north, max(2, round((north - south) / _STEP_M) + 1))
    brightness = 0.15 if label is Label.ROAD else 0.3
    for left, right in itertools.pairwise(x):
        lines = [
            np.column_stack([np.full(len(y), at), y, ground.height_m(np.full(len(y), at), y) + above_m])
            for at in (left, right)
        ]
        builder.sheet(lines[0], lines[1], label, brightness)


def _dig(builder: MeshBuilder, ground: Ground, inside: tuple[float, float]) -> None:
    """Add a smooth tube over the road, with constant cross-section."""
    turn = np.linspace(0.0, np.pi, 9)
    arch = np.column_stack(
        [
            _TUNNEL_HALF_M * np.cos(turn),
            _TUNNEL_WALL_M + (_TUNNEL_TOP_M - _TUNNEL_WALL_M) * np.sin(turn),
        ]
    )
    arch = np.vstack([[_TUNNEL_HALF_M, -0.3], arch, [-_TUNNEL_HALF_M, -0.3]])
    along = np.linspace(*inside, round((inside[1] - inside[0]) / _STEP_M) + 1)
    road = ground.height_m(along, np.zeros(len(along)))
    lines = [np.column_stack([along, np.full(len(along), side), road + up]) for side, up in arch]
    for one, other in itertools.pairwise(lines):
        builder.sheet(one, other, Label.BUILDING, 0.4)


class _Furnisher:
    """Adds houses, trees, poles and parked cars along the edges of blocks that face a street."""

    def __init__(
        self,
        builder: MeshBuilder,
        ground: Ground,
        rng: np.random.Generator,
        inside: tuple[float, float] | None,
    ) -> None:
        self._builder, self._ground, self._rng, self._inside = builder, ground, rng, inside

    def furnish(self, block: tuple[float, float, float, float], low: FloatArray, high: FloatArray) -> None:
        """Furnish a block, given by minimum and maximum of x and y."""
        west, east, south, north = block
        sides = (
            (south > low[1], (west, south), (east, south), (0.0, 1.0)),
            (north < high[1], (east, north), (west, north), (0.0, -1.0)),
            (west > low[0], (west, north), (west, south), (1.0, 0.0)),
            (east < high[0], (east, south), (east, north), (-1.0, 0.0)),
        )
        for faces, start, end, inward in sides:
            if faces:
                edge = np.array([start, end])
                self._houses(edge, np.array(inward))
                self._kerbside(edge, np.array(inward))

    def _houses(self, edge: FloatArray, inward: FloatArray) -> None:
        """Add a row of fronts, with gaps, bays and doors."""
        rng = self._rng
        along, length_m = _direction(edge)
        at_m, front_m = _FRONT_M - KERB_M, _FRONT_M - KERB_M
        while at_m < length_m - front_m - 6.0:
            width_m = min(rng.uniform(7.0, 15.0), length_m - front_m - at_m)
            back_m, deep_m, tall_m = rng.uniform(0.0, 2.0), rng.uniform(7.0, 10.0), rng.uniform(5.0, 15.0)
            middle = edge[0] + along * (at_m + 0.5 * width_m) + inward * front_m
            if rng.random() > 0.12 and not self._covered(middle[0]):
                yaw, bright = float(np.arctan2(along[1], along[0])), rng.uniform(0.3, 0.8)
                self._upright(
                    middle + inward * (back_m + 0.5 * deep_m),
                    (width_m, deep_m),
                    (-1.5, tall_m),
                    yaw,
                    Label.BUILDING,
                    bright,
                )
                for _ in range(rng.integers(2, 6)):
                    part_m, foot_m = rng.uniform(0.8, 2.5), rng.choice([-0.5, 3.0, 6.0])
                    aside = rng.uniform(-0.5, 0.5) * max(width_m - part_m, 0.0)
                    place = middle + along * aside + inward * back_m
                    self._upright(
                        place,
                        (part_m, 2.0 * rng.uniform(0.1, 0.6)),
                        (foot_m, min(foot_m + rng.uniform(1.2, 2.6), tall_m)),
                        yaw,
                        Label.BUILDING,
                        rng.uniform(0.2, 0.9),
                    )
            at_m += width_m + (rng.uniform(1.0, 4.0) if rng.random() < 0.3 else 0.0)

    def _kerbside(self, edge: FloatArray, inward: FloatArray) -> None:
        """Add parked cars in front of the kerb, trees and poles behind it."""
        rng = self._rng
        along, length_m = _direction(edge)
        yaw = float(np.arctan2(along[1], along[0]))
        at_m = _CORNER_M
        while at_m < length_m - _CORNER_M:
            place = edge[0] + along * at_m - inward * (KERB_M - _PARKED_M)
            if rng.random() < 0.55 and not self._covered(place[0]):
                bright, turn = rng.uniform(0.05, 0.9), yaw + rng.normal(0.0, 0.02)
                for size_m, height_m in CAR_PARTS:
                    self._upright(place, size_m, height_m, turn, Label.CAR, bright)
            at_m += rng.uniform(5.5, 8.0)
        at_m = rng.uniform(2.0, 8.0)
        while at_m < length_m - 2.0:
            place = edge[0] + along * at_m + inward * (BESIDE_M - KERB_M)
            if not self._covered(place[0]):
                self._tree_or_pole(place)
            at_m += rng.uniform(6.0, 14.0)

    def _tree_or_pole(self, place: FloatArray) -> None:
        """Add one of them."""
        rng, x, y = self._rng, float(place[0]), float(place[1])
        foot_m = float(self._ground.height_m(place[0], place[1])) + KERB_HEIGHT_M
        if rng.random() < 0.5:
            height_m = foot_m + rng.uniform(2.2, 3.2)
            self._builder.prism((x, y), rng.uniform(0.1, 0.2), (foot_m - 0.2, height_m), Label.TRUNK, 0.3)
            radius_m = rng.uniform(1.0, 1.9)
            self._builder.leaves(np.array([x, y, height_m + 0.7 * radius_m]), radius_m, rng)
        else:
            top_m = foot_m + rng.uniform(3.0, 7.0)
            self._builder.prism((x, y), rng.uniform(0.05, 0.1), (foot_m - 0.2, top_m), Label.POLE, 0.6)

    def _upright(
        self,
        place: FloatArray,
        size_m: tuple[float, float],
        height_m: tuple[float, float],
        yaw_rad: float,
        label: Label,
        brightness: float,
    ) -> None:
        """Add a box with heights relative to the ground under its centre."""
        foot_m = float(self._ground.height_m(place[0], place[1]))
        low_m, high_m = height_m
        middle = (float(place[0]), float(place[1]))
        self._builder.box(middle, size_m, (foot_m + low_m, foot_m + high_m), yaw_rad, label, brightness)

    def _covered(self, x: float) -> bool:
        """Whether there is a tunnel at this x."""
        return self._inside is not None and self._inside[0] - 6.0 < x < self._inside[1] + 6.0


def _direction(edge: FloatArray) -> tuple[FloatArray, float]:
    """Unit vector and length of an edge (2, 2)."""
    step = edge[1] - edge[0]
    length_m = float(np.linalg.norm(step))
    return step / length_m, length_m
