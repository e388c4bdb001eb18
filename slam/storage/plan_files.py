"""Floor plan for other programs, in metres in the map frame.

SVG: a drawing, 1:50, rotated to align with its walls. CAD: DXF R2010. GIS: GeoJSON.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import needs
from slam.mapping.floor_plan import FloorPlan, Length, Room
from slam.measurements import FloatArray
from slam.storage.files import replacing, write_lines

_MARGIN_M = 1.0
_SCALE = 50
_STYLE = (
    ".room{fill:#f3f1ec}.wall{stroke:#111;stroke-width:5}"
    ".unseen{stroke:#777;stroke-width:3;stroke-dasharray:10 8}"
    ".door{stroke:#fff;stroke-width:7}.leaf{stroke:#2468b4;stroke-width:2}.size{stroke:#888;stroke-width:1}"
    "text{font-family:sans-serif;font-size:16px;text-anchor:middle;fill:#222}.small{font-size:12px;fill:#555}"
)

# Layers with their colours of AutoCAD's index and line types.
_LAYERS = {
    "WALLS": (7, "CONTINUOUS"),
    "UNOBSERVED": (8, "DASHED"),
    "DOORS": (5, "CONTINUOUS"),
    "ROOMS": (3, "CONTINUOUS"),
    "TEXT": (7, "CONTINUOUS"),
}
_TEXT_M = 0.15


def write_plan_svg(path: Path, plan: FloorPlan) -> None:
    """Write rooms with area and extents and their 95 % intervals; dashed where no wall was seen.

    A unit of the drawing is a centimetre; the plan is turned so that most walls are level or upright.

    Raises
    ------
    MapFileError
        If the file cannot be written.
    """
    write_lines(path, _Drawing(plan).lines())


class _Drawing:
    """From the map's metres to centimetres from the upper left."""

    def __init__(self, plan: FloorPlan) -> None:
        self._plan = plan
        cos, sin = np.cos(plan.yaw_rad), np.sin(plan.yaw_rad)
        self._turn = np.array([[cos, -sin], [sin, cos]])
        corners = [room.corners_m @ self._turn for room in plan.rooms] or [np.zeros((1, 2))]
        self._low = np.concatenate(corners).min(axis=0) - _MARGIN_M
        self._high = np.concatenate(corners).max(axis=0) + _MARGIN_M

    def at(self, points_m: FloatArray) -> FloatArray:
        """(..., 2) points on the sheet."""
        turned = points_m @ self._turn
        return 100.0 * np.stack([turned[..., 0] - self._low[0], self._high[1] - turned[..., 1]], axis=-1)

    def lines(self) -> Iterator[str]:
        """The file."""
        width, height = 100.0 * (self._high - self._low)
        millimetres = 10.0 / _SCALE
        yield (
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width * millimetres:.1f}mm" '
            f'height="{height * millimetres:.1f}mm" viewBox="0 0 {width:.1f} {height:.1f}">'
        )
        yield f"<title>Floor plan, 1:{_SCALE}</title><style>{_STYLE}</style>"
        yield '<rect width="100%" height="100%" fill="#fff"/>'
        for room in self._plan.rooms:
            corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in self.at(room.corners_m))
            yield f'<polygon class="room" id="room{room.number}" points="{corners}"/>'
        for room in self._plan.rooms:
            for wall in room.walls:
                for begin, end, seen in wall.pieces():
                    yield self._line("wall" if seen else "unseen", begin, end)
        for door in self._plan.doors:
            yield self._line("door", door.begin_m, door.end_m)
            yield self._line("leaf", door.begin_m, door.end_m)
        for room in self._plan.rooms:
            for length in room.lengths:
                yield from self._size(length)
            yield from self._label(room)
        yield from self._scale_bar(height)
        yield "</svg>"

    def _line(self, kind: str, begin_m: FloatArray, end_m: FloatArray) -> str:
        """A straight line."""
        (x1, y1), (x2, y2) = self.at(begin_m), self.at(end_m)
        return f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'

    def _size(self, length: Length) -> Iterator[str]:
        """A dimension line with its figure."""
        yield self._line("size", length.begin_m, length.end_m)
        begin, end = self.at(length.begin_m), self.at(length.end_m)
        along = (end - begin) / max(float(np.hypot(*(end - begin))), 1.0)
        for x, y in (begin, end):
            dx, dy = 6.0 * (along + np.array([-along[1], along[0]]))
            ends = f'x1="{x - dx:.1f}" y1="{y - dy:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}"'
            yield f'<line class="size" {ends}/>'
        turn = np.degrees(np.arctan2(along[1], along[0]))
        turn = (turn + 90.0) % 180.0 - 90.0
        x, y = 0.5 * (begin + end)
        yield (
            f'<text class="small" transform="translate({x:.1f} {y:.1f}) rotate({turn:.1f})" dy="-4">'
            f"{length.text.replace('+-', '±')}</text>"
        )

    def _label(self, room: Room) -> Iterator[str]:
        """Number and area."""
        x, y = self.at(room.middle_m)
        yield f'<text x="{x:.1f}" y="{y - 4:.1f}">Room {room.number}</text>'
        area = room.area_text.replace("+-", "±").replace("m2", "m²")
        yield f'<text x="{x:.1f}" y="{y + 16:.1f}">{area}</text>'

    def _scale_bar(self, height: float) -> Iterator[str]:
        """Five metres, and what the figures mean."""
        y = height - 40.0
        for metre in range(5):
            fill = "#111" if metre % 2 == 0 else "#fff"
            x = 50.0 + 100.0 * metre
            yield f'<rect x="{x:.0f}" y="{y:.0f}" width="100" height="8" fill="{fill}" stroke="#111"/>'
        yield f'<text class="small" x="50" y="{y - 4:.0f}">0</text>'
        yield f'<text class="small" x="550" y="{y - 4:.0f}">5 m</text>'
        yield (
            f'<text class="small" x="50" y="{y + 26:.0f}" style="text-anchor:start">± 95 % interval, by '
            "points and poses, as far as the lidar's ranges are right; dashed: not seen</text>"
        )


def write_plan_dxf(path: Path, plan: FloorPlan) -> None:
    """Write walls, what of them was not seen, doors, rooms as closed polylines, and texts, a layer each.

    Raises
    ------
    LibraryError
        If ezdxf is not installed.
    MapFileError
        If the file cannot be written.
    """
    with needs("DXF needs ezdxf", "dxf"):
        import ezdxf
        from ezdxf import units
    document: Any = ezdxf.new("R2010", setup=["linetypes"])
    document.units = units.M
    for name, (color, line) in _LAYERS.items():
        document.layers.add(name, color=color, linetype=line)
    space = document.modelspace()
    for room in plan.rooms:
        space.add_lwpolyline(room.corners_m.tolist(), close=True, dxfattribs={"layer": "ROOMS"})
        for wall in room.walls:
            for begin, end, seen in wall.pieces():
                layer = "WALLS" if seen else "UNOBSERVED"
                space.add_line(begin.tolist(), end.tolist(), dxfattribs={"layer": layer})
        _text(space, f"Room {room.number}: {room.area_text}", room.middle_m.tolist(), 0.0)
        for length in room.lengths:
            x, y = length.end_m - length.begin_m
            turn = (np.degrees(np.arctan2(y, x)) + 90.0) % 180.0 - 90.0
            middle = 0.5 * (length.begin_m + length.end_m)
            _text(space, length.text, middle.tolist(), float(turn))
    for door in plan.doors:
        space.add_line(door.begin_m.tolist(), door.end_m.tolist(), dxfattribs={"layer": "DOORS"})
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as file:
        document.write(file)


def _text(space: Any, text: str, at_m: list[float], turn_deg: float) -> None:
    """A line of text about a point."""
    from ezdxf.enums import TextEntityAlignment

    entity = space.add_text(text, height=_TEXT_M, rotation=turn_deg, dxfattribs={"layer": "TEXT"})
    entity.set_placement(at_m, align=TextEntityAlignment.MIDDLE_CENTER)


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
