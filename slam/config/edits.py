"""Manual edits of a finished map: ``edits.yaml``, written by hand or by the report page.

All coordinates are in metres in the map before the file is applied. A keyframe is named by the number
of its session, from 1, and of its reading in that log: these do not change when the map grows or moves.
"""

from __future__ import annotations

from typing import Annotated, Any

import yaml
from pydantic import Field, model_validator

from slam.config.files import StrictModel, model_of, nearest_field

# Corners of a polygon, and entries of a list: enough for manual edits, and checks remain fast.
_MOST_CORNERS, _MOST_ENTRIES = 1000, 10_000
_FARTHEST_M = 1e6

Metres = Annotated[float, Field(ge=-_FARTHEST_M, le=_FARTHEST_M)]
Point = tuple[Metres, Metres]
Polygon = Annotated[tuple[Point, ...], Field(min_length=3, max_length=_MOST_CORNERS)]
Name = Annotated[str, Field(min_length=1, max_length=100)]


class Keyframe(StrictModel):
    """A keyframe, named by its reading."""

    session: int = Field(default=1, ge=1, description="number of the log in the map, from 1")
    reading: int = Field(ge=0, description="number of the scan, cloud or frame in that log")

    def __str__(self) -> str:
        return f"session {self.session}, reading {self.reading}"


Pair = tuple[Keyframe, Keyframe]


class AddedLoop(StrictModel):
    """Two keyframes that see the same place."""

    pair: Pair = Field(description="the two keyframes, in any order")
    guess: tuple[Metres, Metres, Annotated[float, Field(ge=-7, le=7)]] | None = Field(
        default=None, description="pose of the second in the frame of the first: x, y, yaw in radians"
    )


class LoopEdits(StrictModel):
    """Corrections of the loops of the map."""

    forbid: tuple[Pair, ...] = Field(default=(), max_length=_MOST_ENTRIES, description="loops that are wrong")
    force: tuple[Pair, ...] = Field(default=(), max_length=_MOST_ENTRIES, description="loops that are right")
    add: tuple[AddedLoop, ...] = Field(default=(), max_length=100, description="loops that were not found")


class Erased(StrictModel):
    """A region in which all readings are removed."""

    polygon: Polygon
    name: Name | None = None
    later: bool = Field(default=False, description="also remove what sessions that join later see there")


class Zone(StrictModel):
    """A region where the robot must not go."""

    polygon: Polygon
    name: Name


class SlowZone(Zone):
    """A region where the robot goes slowly."""

    percent: float = Field(gt=0, lt=100, description="percent of the usual speed")


class Turn(StrictModel):
    """Rotation of the map; give exactly one of the three."""

    to_walls: bool = Field(default=False, description="align most walls with x or y by the smallest rotation")
    degrees: float | None = Field(default=None, ge=-360, le=360, description="counter-clockwise")
    along_x: tuple[Point, Point] | None = Field(
        default=None, description="two points; x runs from the first to the second"
    )

    @model_validator(mode="after")
    def _one_way(self) -> Turn:
        """Check that exactly one rotation is given."""
        if self.to_walls + (self.degrees is not None) + (self.along_x is not None) != 1:
            raise ValueError("give one of to_walls: true, degrees, along_x")
        if self.along_x is not None and self.along_x[0] == self.along_x[1]:
            raise ValueError("along_x needs two different points")
        return self


class Place(StrictModel):
    """A position with a name."""

    name: Name
    position: Point
    yaw_deg: float = Field(default=0.0, ge=-360, le=360)


class Edits(StrictModel):
    """All edits of one file; what the file does not mention stays unchanged."""

    loops: LoopEdits = LoopEdits()
    erase: tuple[Erased, ...] = Field(default=(), max_length=_MOST_ENTRIES)
    keep_out: tuple[Zone, ...] = Field(default=(), max_length=_MOST_ENTRIES)
    slow: tuple[SlowZone, ...] = Field(default=(), max_length=_MOST_ENTRIES)
    crop: Polygon | None = Field(default=None, description="everything outside is removed from the map")
    turn: Turn | None = None
    origin: Point | None = Field(default=None, description="the point that becomes 0, 0")
    places: tuple[Place, ...] = Field(default=(), max_length=_MOST_ENTRIES)
    settings: dict[str, Any] = Field(
        default={}, description="settings by their dotted names, as for 'scanweave remap'"
    )

    @property
    def empty(self) -> bool:
        """Whether there are no edits."""
        return self == Edits()


def edits_of(tree: object, source: str) -> Edits:
    """Create edits from plain values.

    Parameters
    ----------
    source
        Where they came from; used in messages.

    Raises
    ------
    ConfigError
        If a key is unknown or a value is invalid; the message has one line.
    """
    hint = nearest_field((Edits, LoopEdits, AddedLoop, Keyframe, Erased, SlowZone, Turn, Place))
    return model_of(Edits, {} if tree is None else tree, source, hint, most=1)


def dump_edits(edits: Edits) -> str:
    """Return edits as YAML text, without defaults; `edits_of` takes what is read from it."""
    tree = edits.model_dump(mode="json", exclude_defaults=True)
    return yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, allow_unicode=True)
