"""Floor plan: rooms, walls as lines, doors, lengths and areas with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.estimation import TINY, half_interval
from fusion.showing import one_line
from slam.measurements import FloatArray


@dataclass(frozen=True, slots=True)
class Wall:
    """One side of a room.

    Attributes
    ----------
    begin_m, end_m
        (2,) map frame; the room is on the left.
    sigma_m
        Standard deviation across it at its middle, in the map; None if it was not seen.
    seen_m
        (n, 2) begin and end along it of each stretch with a hit.
    """

    begin_m: FloatArray
    end_m: FloatArray
    sigma_m: float | None
    seen_m: FloatArray

    __repr__ = one_line

    @property
    def length_m(self) -> float:
        """Length from corner to corner."""
        return float(np.hypot(*(self.end_m - self.begin_m)))

    def at(self, along_m: float) -> FloatArray:
        """Return (2,) the point at a distance along it."""
        return np.asarray(self.begin_m + along_m / self.length_m * (self.end_m - self.begin_m))

    def pieces(self) -> list[tuple[FloatArray, FloatArray, bool]]:
        """Return begin and end of each stretch, and whether it was seen."""
        pieces, last = [], 0.0
        for low, high in self.seen_m:
            if low > last:
                pieces.append((self.at(last), self.at(low), False))
            pieces.append((self.at(low), self.at(high), True))
            last = high
        if last < self.length_m:
            pieces.append((self.at(last), self.end_m, False))
        return pieces


@dataclass(frozen=True, slots=True)
class Length:
    """Distance from one wall to the opposite wall.

    Attributes
    ----------
    begin_m, end_m
        (2,) end points of the measurement.
    length_m, sigma_m
        The length and its standard deviation.
    """

    begin_m: FloatArray
    end_m: FloatArray
    length_m: float
    sigma_m: float

    @property
    def half_interval_m(self) -> float:
        """Half of the 95 % interval."""
        return half_interval(self.sigma_m)

    @property
    def text(self) -> str:
        """Return the length with its interval, as text."""
        return f"{self.length_m:.3f} +- {self.half_interval_m:.3f} m"


@dataclass(frozen=True, slots=True)
class Room:
    """A room.

    Attributes
    ----------
    number
        Number from 1; the largest room comes first.
    walls
        Walls, counter-clockwise; each begins where the one before ends.
    area_m2
        Area within the walls.
    area_sigma_m2
        Its standard deviation; None if a wall was not seen.
    lengths
        Its extents along and across its walls, if both walls were seen.
    entered
        Whether the robot has been in it.
    """

    number: int
    walls: Sequence[Wall]
    area_m2: float
    area_sigma_m2: float | None
    lengths: Sequence[Length]
    entered: bool

    __repr__ = one_line

    @property
    def corners_m(self) -> FloatArray:
        """(n, 2) counter-clockwise, map frame."""
        return np.array([wall.begin_m for wall in self.walls])

    @property
    def middle_m(self) -> FloatArray:
        """(2,) centre of its area."""
        x, y = (self.corners_m - self.corners_m[0]).T
        weights = x * np.roll(y, -1) - np.roll(x, -1) * y
        sums = np.array([(v + np.roll(v, -1)) @ weights for v in (x, y)])
        return np.asarray(self.corners_m[0] + sums / (3 * weights.sum()))

    @property
    def area_half_interval_m2(self) -> float | None:
        """Half of the 95 % interval; None if a wall was not seen."""
        return None if self.area_sigma_m2 is None else half_interval(self.area_sigma_m2)

    @property
    def area_text(self) -> str:
        """Return the area as text: with its interval, or with `about` if it has none."""
        half = self.area_half_interval_m2
        return f"about {self.area_m2:.1f} m2" if half is None else f"{self.area_m2:.2f} +- {half:.2f} m2"


@dataclass(frozen=True, slots=True)
class Door:
    """An opening between two rooms.

    Attributes
    ----------
    begin_m, end_m
        (2,) sides of the opening.
    driven
        Whether the robot drove through it; otherwise it was seen open.
    """

    begin_m: FloatArray
    end_m: FloatArray
    rooms: tuple[int, int]
    driven: bool

    @property
    def width_m(self) -> float:
        """Width from side to side, accurate to two cells of the grid."""
        return float(np.hypot(*(self.end_m - self.begin_m)))

    @property
    def middle_m(self) -> FloatArray:
        """(2,) middle of the opening."""
        return np.asarray(0.5 * (self.begin_m + self.end_m))


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Rooms and the doors between them, in the map frame, metres.

    The uncertainty of lengths and areas comes from the points and the poses. It does not include a constant
    offset or a scale error of the lidar.
    """

    rooms: Sequence[Room]
    doors: Sequence[Door]

    __repr__ = one_line

    @property
    def yaw_rad(self) -> float:
        """Direction of most walls in the map, from -45 to 45 degrees."""
        walls = [wall.end_m - wall.begin_m for room in self.rooms for wall in room.walls]
        # Four times the angle is the same for all four directions.
        turned = [complex(x, y) ** 4 / max(abs(complex(x, y)), TINY) ** 3 for x, y in walls]
        return float(np.angle(sum(turned)) / 4) if turned else 0.0

    def text(self) -> str:
        """Return one line per room and per door; a length without a 95 % interval was not seen completely."""
        doors = sum(door.driven for door in self.doors)
        lines = [f"{len(self.rooms)} rooms, {len(self.doors)} doors, {doors} of them driven through"]
        for room in self.rooms:
            parts = [f"  room {room.number}: {room.area_text}", " x ".join(one.text for one in room.lengths)]
            parts += [] if room.entered else ["never entered"]
            lines.append(", ".join(filter(None, parts)))
        for door in self.doors:
            how = "" if door.driven else ", not driven through"
            lines.append(f"  door {door.rooms[0]}-{door.rooms[1]}: {door.width_m:.2f} m{how}")
        return "\n".join(lines)
