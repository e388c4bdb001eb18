"""What a person decides of a finished map: ``edits.yaml``, written by hand or by the report's page.

All coordinates are metres in the map as it was before the file is applied; keyframes go by the number of
their session, from 1, and of their reading in its log: names that stay when the map grows or moves.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field, ValidationError, model_validator
from pydantic_core import ErrorDetails

from slam.config import ConfigLoader, nearest
from slam.config.strict import StrictModel
from slam.errors import ConfigError
from slam.foreign import from_yaml, plain

# Corners of a polygon, and entries of a list: no person draws more, and no check takes long.
_MOST_CORNERS, _MOST_ENTRIES = 1000, 10_000
_FARTHEST_M = 1e6

Metres = Annotated[float, Field(ge=-_FARTHEST_M, le=_FARTHEST_M)]
Point = tuple[Metres, Metres]
Polygon = Annotated[tuple[Point, ...], Field(min_length=3, max_length=_MOST_CORNERS)]
Name = Annotated[str, Field(min_length=1, max_length=100)]


class Keyframe(StrictModel):
    """A keyframe, by the reading that it was taken at."""

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
    """Which loops hold the map together."""

    forbid: tuple[Pair, ...] = Field(default=(), max_length=_MOST_ENTRIES, description="loops that are wrong")
    force: tuple[Pair, ...] = Field(default=(), max_length=_MOST_ENTRIES, description="loops that are right")
    add: tuple[AddedLoop, ...] = Field(default=(), max_length=100, description="loops that were not found")


class Erased(StrictModel):
    """A region in which what was seen is taken away."""

    polygon: Polygon
    name: Name | None = None
    later: bool = Field(default=False, description="also what sessions see there that join afterwards")


class Zone(StrictModel):
    """A region where the robot must not go."""

    polygon: Polygon
    name: Name


class SlowZone(Zone):
    """A region where the robot goes slowly."""

    percent: float = Field(gt=0, lt=100, description="of its usual speed")


class Turn(StrictModel):
    """How the map is turned; one of the three."""

    to_walls: bool = Field(default=False, description="most walls along x and y, by the smallest turn")
    degrees: float | None = Field(default=None, ge=-360, le=360, description="counter-clockwise")
    along_x: tuple[Point, Point] | None = Field(
        default=None, description="two points; x runs from the first to the second"
    )

    @model_validator(mode="after")
    def _one_way(self) -> Turn:
        """Ways to turn exclude each other."""
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
    """Everything that one file says; what it leaves out stays as it is."""

    loops: LoopEdits = LoopEdits()
    erase: tuple[Erased, ...] = Field(default=(), max_length=_MOST_ENTRIES)
    keep_out: tuple[Zone, ...] = Field(default=(), max_length=_MOST_ENTRIES)
    slow: tuple[SlowZone, ...] = Field(default=(), max_length=_MOST_ENTRIES)
    crop: Polygon | None = Field(default=None, description="what is outside is no part of the map")
    turn: Turn | None = None
    origin: Point | None = Field(default=None, description="the point that becomes 0, 0")
    places: tuple[Place, ...] = Field(default=(), max_length=_MOST_ENTRIES)
    settings: dict[str, Any] = Field(
        default={}, description="settings by their dotted names, as 'scanweave remap' takes them"
    )

    @property
    def empty(self) -> bool:
        """Whether nothing is said."""
        return self == Edits()


def edits_of(tree: object, source: str) -> Edits:
    """Edits from plain values.

    Parameters
    ----------
    source
        What they came from, for messages.

    Raises
    ------
    ConfigError
        For an unknown key or a bad value, in one line.
    """
    if tree is None:
        tree = {}
    if not isinstance(tree, Mapping):
        raise ConfigError(f"{source} holds a {type(tree).__name__}; write 'erase:' and the like")
    try:
        # By way of JSON, since there strict mode still takes a list for a tuple.
        return Edits.model_validate_json(json.dumps(tree))
    except ValidationError as error:
        # An unknown key says more than what is missing where it stands.
        faults = sorted(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
        more = f"; and {len(faults) - 1} more" if len(faults) > 1 else ""
        raise ConfigError(f"{source}: {_described(faults[0])}{more}") from None
    except (TypeError, ValueError, RecursionError) as error:  # a date, a number that is none
        raise ConfigError(f"{source}: not plain keys and values ({error})") from error


def _described(fault: ErrorDetails) -> str:
    """One fault of pydantic's in the words of a user."""
    dotted = ".".join(str(part) for part in fault["loc"])
    if fault["type"] == "extra_forbidden":
        return f"unknown key '{dotted}'{nearest(str(fault['loc'][-1]), _names())}"
    shown = plain(json.dumps(fault["input"], default=str), longest=60)
    return f"{dotted} = {shown}: {fault['msg'][0].lower()}{fault['msg'][1:]}"


def _names() -> list[str]:
    """Every key that some part of the file takes."""
    models = (Edits, LoopEdits, AddedLoop, Keyframe, Erased, SlowZone, Turn, Place)
    return sorted({name for model in models for name in model.model_fields})


def load_edits(file: Path | str) -> Edits:
    """Edits from a YAML file.

    Raises
    ------
    ConfigError
        For a missing or malformed file, an unknown key or a bad value.
    """
    try:
        tree = from_yaml(Path(file).read_text(encoding="utf-8"), ConfigLoader)
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot read {file}: {' '.join(str(error).split())}") from error
    return edits_of(tree, str(file))


def dump_edits(edits: Edits) -> str:
    """YAML text of edits, without what they leave out; `load_edits` reads it back."""
    tree = edits.model_dump(mode="json", exclude_defaults=True)
    return yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, allow_unicode=True)
