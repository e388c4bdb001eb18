"""Simulates traffic: cars on their lanes, one in front of the recording car, cyclists, people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import Float32Array, FloatArray
from slam.simulation.street_drive import StreetDrive, road_poses
from slam.simulation.street_mesh import Label
from slam.simulation.street_plan import CAR_PARTS, KERB_HEIGHT_M, KERB_M, LANE_M, Town

_AHEAD_S = 2.2  # the car in front is this far ahead on the same path
_SIGHT_M = 90.0
_APART_M = (4.5, 2.4)  # minimum distance to the recording car, along and across
_TRIES = 60
_LOOK_S = 0.1


@dataclass(frozen=True, slots=True)
class _Kind:
    """Parts, offset to the right of the middle of a street, speeds, brightness."""

    label: Label
    parts: tuple[tuple[tuple[float, float], tuple[float, float]], ...]
    aside_m: float
    speeds_m_s: tuple[float, float]
    share: float


_KINDS = (
    _Kind(Label.MOVING_CAR, CAR_PARTS, LANE_M, (5.0, 9.0), 0.45),
    _Kind(
        Label.MOVING_CYCLIST,
        (((1.7, 0.15), (0.05, 0.95)), ((0.5, 0.45), (0.85, 1.75))),
        2.75,
        (3.5, 5.5),
        0.15,
    ),
    _Kind(
        Label.MOVING_PERSON,
        (((0.3, 0.35), (0.0, 0.85)), ((0.3, 0.5), (0.8, 1.7))),
        KERB_M + 1.6,
        (0.8, 1.6),
        0.4,
    ),
)
_SHARES = [kind.share for kind in _KINDS]


@dataclass(frozen=True, slots=True)
class _Mover:
    """An object that moves straight along a street, repeatedly from its start; or ahead on the car's path."""

    kind: _Kind
    start: FloatArray
    along: FloatArray
    length_m: float
    speed_m_s: float
    phase_m: float
    brightness: float
    ours: StreetDrive | None = None

    def at(self, times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, y and yaw, (N,) each."""
        if self.ours is not None:
            x, y, yaw = self.ours.planar(np.minimum(times_s + _AHEAD_S, self.ours.duration_s)).T
            return x, y, yaw
        driven = np.mod(self.phase_m + self.speed_m_s * times_s, self.length_m)
        x, y = (self.start + driven[:, None] * self.along).T
        return x, y, np.full(len(times_s), np.arctan2(self.along[1], self.along[0]))


class Traffic:
    """All moving objects of a drive.

    Parameters
    ----------
    density
        Moving objects per 100 m of street.
    """

    def __init__(self, town: Town, drive: StreetDrive, density: float, rng: np.random.Generator) -> None:
        self._ground = town.ground
        streets = _streets(town)
        length_m = sum(float(np.linalg.norm(end - start)) for start, end in streets)
        count = round(density * length_m / 100.0)
        self._movers = [_mover(streets, rng, kind) for kind in rng.choice(len(_KINDS), count, p=_SHARES)]
        self._movers = [self._polite(mover, streets, drive, rng) for mover in self._movers]
        if density > 0.0:
            car = _KINDS[0]
            self._movers.append(_Mover(car, np.zeros(2), np.zeros(2), 1.0, 0.0, 0.0, 0.4, ours=drive))

    def _polite(
        self,
        mover: _Mover,
        streets: list[tuple[FloatArray, FloatArray]],
        drive: StreetDrive,
        rng: np.random.Generator,
    ) -> _Mover:
        """The mover, or another of its type that never blocks the recording car."""
        times_s = np.arange(0.0, drive.duration_s, _LOOK_S)
        x, y, yaw = drive.planar(times_s).T
        for _ in range(_TRIES):
            other_x, other_y, _ = mover.at(times_s)
            ahead = np.cos(yaw) * (other_x - x) + np.sin(yaw) * (other_y - y)
            aside = np.cos(yaw) * (other_y - y) - np.sin(yaw) * (other_x - x)
            if not ((np.abs(ahead) < _APART_M[0]) & (np.abs(aside) < _APART_M[1])).any():
                return mover
            mover = _mover(streets, rng, _KINDS.index(mover.kind))
        return mover

    def near(self, place: FloatArray, time_s: float) -> MovingBoxes:
        """The movers that may be visible from a position at a time."""
        rows, owners = [], []
        for number, mover in enumerate(self._movers):
            x, y, yaw = mover.at(np.array([time_s - 0.05, time_s, time_s + 0.05]))
            if np.hypot(x[1] - place[0], y[1] - place[1]) > _SIGHT_M:
                continue
            rotations, positions = road_poses(self._ground, x, y, yaw)
            velocity = (positions[2] - positions[0]) / 0.1
            velocity = velocity if np.linalg.norm(velocity) < 40.0 else np.zeros(3)  # it restarts
            up = KERB_HEIGHT_M if mover.kind.label is Label.MOVING_PERSON else 0.0
            for size, height in mover.kind.parts:
                half = [0.5 * size[0], 0.5 * size[1]]
                box = [-half[0], -half[1], height[0] + up, half[0], half[1], height[1] + up]
                rows.append([*positions[1], *velocity, *rotations[1].ravel(), *box])
                owners.append(number)
        table = np.array(rows).reshape(-1, 21)
        kinds = np.array([int(self._movers[i].kind.label) | (i + 1) << 16 for i in owners], np.uint32)
        bright = np.array([self._movers[i].brightness for i in owners], np.float32)
        return MovingBoxes(table, kinds, bright)


@dataclass(frozen=True, slots=True)
class MovingBoxes:
    """Boxes that move with constant velocity for a short time.

    Attributes
    ----------
    table
        (N, 21) position, velocity, rotation (row-major), minimum and maximum corner in its own frame.
    label
        (N,) `Label` in the lower half, the number of the mover, from 1, in the upper.
    brightness
        (N,).
    """

    table: FloatArray
    label: NDArray[np.uint32]
    brightness: Float32Array

    def meet(
        self, rays: Float32Array, late_s: FloatArray, range_m: Float32Array
    ) -> tuple[NDArray[np.int32], Float32Array]:
        """Find the boxes that rays hit first; ranges are replaced in place.

        Parameters
        ----------
        rays
            (N, 6) origin and unit direction, map frame.
        late_s
            (N,) time after that of the boxes.
        range_m
            (N,) range to the static scene.

        Returns
        -------
        (N,) index of the box, -1 for none; (N,) cosine between ray and face.
        """
        boxes = np.full(len(rays), -1, np.int32)
        cosine = np.zeros(len(rays), np.float32)
        _meet_boxes(rays, late_s, self.table, range_m, boxes, cosine)
        return boxes, cosine


def _streets(town: Town) -> list[tuple[FloatArray, FloatArray]]:
    """Both ends of the centre line of each street."""
    along_y = [(np.array([x, town.low_m[1]]), np.array([x, town.high_m[1]])) for x in town.across_x]
    along_x = [(np.array([town.low_m[0], y]), np.array([town.high_m[0], y])) for y in town.across_y]
    return along_y + along_x


def _mover(streets: list[tuple[FloatArray, FloatArray]], rng: np.random.Generator, kind: int) -> _Mover:
    """A mover of a type at a random position."""
    start, end = streets[rng.integers(len(streets))]
    if rng.random() < 0.5:
        start, end = end, start
    what, length_m = _KINDS[kind], float(np.linalg.norm(end - start))
    along = (end - start) / length_m
    right = what.aside_m * np.array([along[1], -along[0]])
    if what.label is Label.MOVING_PERSON and rng.random() < 0.5:
        right = -right
    return _Mover(
        what,
        start + right,
        along,
        length_m,
        rng.uniform(*what.speeds_m_s),
        rng.uniform(0.0, length_m),
        rng.uniform(0.1, 0.8),
    )


@kernel
def _meet_boxes(
    rays: Float32Array,
    late_s: FloatArray,
    table: FloatArray,
    range_m: Float32Array,
    boxes: NDArray[np.int32],
    cosine: Float32Array,
) -> None:
    """Intersect rays with the slabs of each box in its own frame."""
    for ray in range(len(rays)):
        for box in range(len(table)):
            row = table[box]
            near, far = 0.0, np.float64(range_m[ray])
            face = 0.0
            for axis in range(3):
                start, step = 0.0, 0.0
                for inner in range(3):
                    turned = row[6 + 3 * inner + axis]
                    start += turned * (rays[ray, inner] - row[inner] - late_s[ray] * row[3 + inner])
                    step += turned * rays[ray, 3 + inner]
                if abs(step) < 1e-12:
                    step = 1e-12
                enter, leave = (row[15 + axis] - start) / step, (row[18 + axis] - start) / step
                if enter > leave:
                    enter, leave = leave, enter
                if enter > near:
                    near, face = enter, abs(step)
                far = min(far, leave)
            if near < far and face > 0.0:
                range_m[ray], boxes[ray], cosine[ray] = near, box, face
