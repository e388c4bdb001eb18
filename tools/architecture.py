"""Draws the picture of the architecture from the imports of slam/ and fusion/."""

from __future__ import annotations

import ast
import sys
from html import escape
from pathlib import Path

REPO = Path(__file__).parents[1]
sys.path.insert(0, str(REPO / "tests"))

from test_layering import FLOORS, floor_of, imports_of, module_name, room_of  # noqa: E402

WIDTH_PX, FLOOR_PX, ROOM_PX, TALL_PX = 900, 58, 128, 30
STYLE = (
    "text{font:13px sans-serif;fill:#26323f;text-anchor:middle}rect{fill:#eef2f6;stroke:#667281;rx:5px}"
    "path{stroke:#2563b8;stroke-width:1.2;fill:none;opacity:.45}"
)


def arrows() -> set[tuple[str, str]]:
    """Packages and the packages that they import."""
    files = {module_name(f, REPO): f for top in ("slam", "fusion") for f in (REPO / top).rglob("*.py")}
    found = set()
    for module, file in files.items():
        tree = ast.parse(file.read_text("utf-8"))
        for one in imports_of(tree, module, is_package=file.name == "__init__.py", known=set(files)):
            if one.target in files and not one.typing_only:
                found.add((room_of(module), room_of(one.target)))
    return {(room, other) for room, other in found if room != other and "slam" not in (room, other)}


def direct(edges: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """Remove edges that are implied by a path through another package."""
    below: dict[str, set[str]] = {}
    for room in sorted({room for edge in edges for room in edge}, key=lambda room: -(floor_of(room) or 0)):
        mine = {other for one, other in edges if one == room}
        below[room] = mine | {far for other in mine for far in below[other]}
    return {
        (room, other)
        for room, other in edges
        if not any(other in below[between] for one, between in edges if one == room and between != other)
    }


def drawing() -> str:
    """An SVG: one row of packages per layer, and a line to each imported package."""
    floors = [sorted(floor) for floor in FLOORS if floor != {"slam"}]
    place = {
        room: (WIDTH_PX * (number + 1) / (len(floor) + 1), FLOOR_PX * (row + 0.5))
        for row, floor in enumerate(floors)
        for number, room in enumerate(floor)
    }
    lines = []
    for room, other in sorted(direct(arrows())):
        (x0, y0), (x1, y1) = place[room], place[other]
        y0, y1 = y0 + TALL_PX / 2, y1 - TALL_PX / 2
        lines.append(
            f'<path d="M{x0:.0f} {y0:.0f}C{x0:.0f} {y0 + 24:.0f} {x1:.0f} {y1 - 24:.0f} {x1:.0f} {y1:.0f}"/>'
        )
    for room, (x, y) in place.items():
        box = f'x="{x - ROOM_PX / 2:.0f}" y="{y - TALL_PX / 2:.0f}" width="{ROOM_PX}" height="{TALL_PX}"'
        lines.append(
            f'<rect {box}/><text x="{x:.0f}" y="{y + 5:.0f}">{escape(room.removeprefix("slam."))}</text>'
        )
    size = f"0 0 {WIDTH_PX} {FLOOR_PX * len(floors)}"
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{size}"><style>{STYLE}</style>'
    return "\n".join(
        [head, '<rect width="100%" height="100%" style="fill:#fff;stroke:none"/>', *lines, "</svg>\n"]
    )
