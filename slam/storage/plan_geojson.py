"""Floor plan as GeoJSON, in metres in the map frame."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from slam.mapping.floor_plan import FloorPlan
from slam.measurements import FloatArray
from slam.storage.files import write_lines


def write_plan_geojson(path: Path, plan: FloorPlan) -> None:
    """Write rooms (polygons), walls and doors (lines).

    Coordinates are metres in the map's frame, not longitude and latitude, for a map is not georeferenced:
    what RFC 7946 section 4 allows by agreement. The member ``frame`` says so.

    Raises
    ------
    MapFileError
        If the file cannot be written.
    """
    write_lines(path, [json.dumps(plan_geojson(plan), indent=1)])


def plan_geojson(plan: FloorPlan) -> dict[str, Any]:
    """The plan as plain data, for files and for the page of a map."""
    features: list[dict[str, Any]] = []
    for room in plan.rooms:
        ring = _rounded(room.corners_m)
        sizes = [
            {
                "from": _rounded(length.begin_m),
                "to": _rounded(length.end_m),
                "length_m": round(length.length_m, 4),
                "half_interval_m": round(length.half_interval_m, 4),
            }
            for length in room.lengths
        ]
        features.append(
            feature(
                "Polygon",
                [[*ring, ring[0]]],
                kind="room",
                number=room.number,
                area_m2=round(room.area_m2, 3),
                area_half_interval_m2=_some(room.area_half_interval_m2),
                entered=room.entered,
                lengths=sizes,
            )
        )
        for wall in room.walls:
            for begin, end, seen in wall.pieces():
                line = [_rounded(begin), _rounded(end)]
                tags = {"kind": "wall", "room": room.number, "seen": seen, "sigma_m": _some(wall.sigma_m)}
                if line[0] != line[1]:  # shorter than a tenth of a millimetre: no line
                    features.append(feature("LineString", line, **tags))
    for door in plan.doors:
        line = [_rounded(door.begin_m), _rounded(door.end_m)]
        width = round(door.width_m, 2)
        features.append(
            feature("LineString", line, kind="door", rooms=door.rooms, driven=door.driven, width_m=width)
        )
    return {"type": "FeatureCollection", "frame": "map", "unit": "metre", "features": features}


def feature(geometry: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    """One of GeoJSON's features."""
    return {
        "type": "Feature",
        "geometry": {"type": geometry, "coordinates": coordinates},
        "properties": properties,
    }


def _rounded(points_m: FloatArray) -> Any:
    """To a tenth of a millimetre."""
    return points_m.round(4).tolist()


def _some(value: float | None) -> float | None:
    """Rounded, if it is known."""
    return None if value is None else round(value, 4)
