"""Floor plan as a drawing: SVG, 1:50, rotated to align with its walls."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slam.mapping.floor_plan import FloorPlan, Length, Room
from slam.measurements import FloatArray
from slam.storage.files import write_lines

_MARGIN_M = 1.0
_SCALE = 50
_STYLE = (
    ".room{fill:#f3f1ec}.wall{stroke:#111;stroke-width:5}"
    ".unseen{stroke:#777;stroke-width:3;stroke-dasharray:10 8}"
    ".door{stroke:#fff;stroke-width:7}.leaf{stroke:#2468b4;stroke-width:2}.size{stroke:#888;stroke-width:1}"
    "text{font-family:sans-serif;font-size:16px;text-anchor:middle;fill:#222}.small{font-size:12px;fill:#555}"
)


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
