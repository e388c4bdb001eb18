"""Floor plan for CAD: DXF R2010, in metres, in the map frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import LibraryError
from slam.mapping.floor_plan import FloorPlan
from slam.storage.files import replacing

# Layers with their colours of AutoCAD's index and line types.
_LAYERS = {
    "WALLS": (7, "CONTINUOUS"),
    "UNOBSERVED": (8, "DASHED"),
    "DOORS": (5, "CONTINUOUS"),
    "ROOMS": (3, "CONTINUOUS"),
    "TEXT": (7, "CONTINUOUS"),
}
_TEXT_M = 0.15


def write_plan_dxf(path: Path, plan: FloorPlan) -> None:
    """Write walls, what of them was not seen, doors, rooms as closed polylines, and texts, a layer each.

    Raises
    ------
    LibraryError
        If ezdxf is not installed.
    MapFileError
        If the file cannot be written.
    """
    try:
        import ezdxf
        from ezdxf import units
    except ImportError as error:
        raise LibraryError("DXF needs ezdxf; pip install 'scanweave[dxf]'") from error
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
