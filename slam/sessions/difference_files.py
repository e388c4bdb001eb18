"""Files of the differences between two visits: text, JSON, GeoJSON and a picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fusion.bayes import FREE, OCCUPIED
from slam.evaluation.figure_parts import BLUE, DPI, ORANGE, RED, figure_of, png_of
from slam.mapping.occupancy_grid import THRESHOLDS
from slam.measurements import FloatArray
from slam.sessions.changes import Comparison
from slam.sessions.moved_things import ChangedThing
from slam.storage.files import make_folder, write_bytes
from slam.storage.plan_files import feature

_COLORS = {"went": RED, "appeared": BLUE, "moved": ORANGE}


def difference_text(things: Sequence[ChangedThing], passing: int, compared: Comparison) -> str:
    """Return one line per object, and how much area could be compared."""
    both, first, second = compared.seen_m2()
    lines = [_line(thing) for thing in things] or ["nothing changed in the area that both visits saw"]
    if passing:
        lines.append(
            f"not counted: {passing} that were seen only briefly or intermittently, such as people and glass"
        )
    lines.append(
        f"compared {both:.1f} m2 that both visits saw; {first:.1f} m2 only the first saw, {second:.1f} m2 "
        "only the second saw"
    )
    return "\n".join(lines)


def difference_plain(
    things: Sequence[ChangedThing], passing: int, compared: Comparison, names: Sequence[str]
) -> dict[str, Any]:
    """Return the same as plain values; positions in metres, in the frame of the first map."""
    both, first, second = compared.seen_m2()
    return {
        "before": names[0],
        "after": names[1],
        "things": [_plain(thing) for thing in things],
        "passing": passing,
        "seen_m2": {"both": round(both, 2), "before_only": round(first, 2), "after_only": round(second, 2)},
    }


def write_difference(
    folder: Path, things: Sequence[ChangedThing], passing: int, compared: Comparison, names: Sequence[str]
) -> list[Path]:
    """Write ``diff.json``, ``diff.geojson`` (metres of the map, no degrees) and ``diff.png``.

    Raises
    ------
    ScanweaveError
        If a file cannot be written.
    """
    make_folder(folder)
    features = [
        feature("Polygon", [_rounded([*corners, corners[0]])], what=thing.what, at=at, **_properties(thing))
        for thing in things
        for at, corners in (("before", thing.before_m), ("after", thing.after_m))
        if corners is not None
    ]
    contents = {
        "diff.json": json.dumps(difference_plain(things, passing, compared, names), indent=1).encode(),
        "diff.geojson": json.dumps({"type": "FeatureCollection", "features": features}, indent=1).encode(),
        "diff.png": difference_picture(things, compared),
    }
    for name, content in contents.items():
        write_bytes(folder / name, content)
    return [folder / name for name in contents]


def difference_picture(things: Sequence[ChangedThing], compared: Comparison) -> bytes:
    """Draw a PNG: what both visits saw; red: disappeared, blue: appeared, orange: moved, with its path."""
    shade = np.full((*compared.steps.shape[1:], 3), 205, dtype=np.uint8)
    states = [THRESHOLDS.states(steps) for steps in compared.steps]
    shade[(states[0] == FREE) | (states[1] == FREE)] = 254
    shade[(states[0] == OCCUPIED) | (states[1] == OCCUPIED)] = 120
    shade[(states[0] == OCCUPIED) & (states[1] == OCCUPIED)] = 0
    rows, cols = shade.shape[:2]
    side_px = 10 * DPI / max(rows, cols)
    figure = figure_of(max(200, round(cols * side_px)), max(200, round(rows * side_px)))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    x, y = compared.corner_m
    side_m = compared.resolution_m
    extent = (x, x + cols * side_m, y, y + rows * side_m)
    axes.imshow(shade, origin="lower", interpolation="nearest", extent=extent)
    for thing in things:
        color = _COLORS[thing.what]
        for corners, style in ((thing.before_m, "--"), (thing.after_m, "-")):
            if corners is not None:
                axes.plot(*np.array([*corners, corners[0]]).T, style, color=color)
        if thing.what == "moved":
            arrow = {"arrowstyle": "->", "color": color}
            axes.annotate("", thing.places_m[1].tolist(), thing.places_m[0].tolist(), arrowprops=arrow)
    axes.set_axis_off()
    return png_of(figure)


def _line(thing: ChangedThing) -> str:
    """Describe an object in words."""
    length_m, width_m = thing.size_m
    size = f"an object of {length_m:.1f} x {width_m:.1f} m"
    places = [f"({x:.1f}, {y:.1f})" for x, y in thing.places_m]
    if thing.what == "moved":
        text = f"moved {thing.moved_m:.1f} m: {size} from {places[0]} to {places[1]}"
    else:
        text = f"{thing.what}: {size} {'at' if thing.what == 'appeared' else 'from'} {places[0]}"
    return f"{text}, probability {thing.probability:.2f}"


def _plain(thing: ChangedThing) -> dict[str, Any]:
    """Return an object as plain values."""
    corners = {"before_m": thing.before_m, "after_m": thing.after_m}
    return {
        "what": thing.what,
        **_properties(thing),
        **{key: _rounded(value) for key, value in corners.items()},
    }


def _properties(thing: ChangedThing) -> dict[str, Any]:
    """Return the properties of an object besides its corners."""
    return {
        "probability": round(thing.probability, 3),
        "size_m": [round(side, 2) for side in thing.size_m],
        "places_m": _rounded(thing.places_m),
        "moved_m": round(thing.moved_m, 2),
    }


def _rounded(points_m: Sequence[FloatArray] | FloatArray | None) -> list[list[float]] | None:
    """Round points to millimetres."""
    return None if points_m is None else np.round(points_m, 3).tolist()
