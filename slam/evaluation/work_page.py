"""The interactive plan as parts of a page: data, scripts, and a picture for browsers without scripts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from slam.evaluation.page_blob import packed
from slam.evaluation.pages import TEMPLATES, render
from slam.measurements import FloatArray

# Largest number of corners of the path, and of loops, in a picture.
_CORNERS, _LINES = 2000, 400
_MARGIN_M = 0.5


@dataclass(frozen=True, slots=True)
class WorkPage:
    """What a template needs for the plan.

    Attributes
    ----------
    title, legend
        Of the picture.
    blob
        The data, see `slam.evaluation.page_blob`.
    picture
        SVG.
    scripts, styles
        Names of templates, in order.
    """

    title: str
    legend: str
    blob: Markup
    picture: Markup
    scripts: tuple[str, ...]
    styles: tuple[str, ...]


def work_page(data: Mapping[str, Any], title: str, legend: str = "") -> WorkPage:
    """The plan of a map's or a drive's data, see `slam.evaluation.page_data.map_data`."""
    libraries = ["vendor/ol.min.js", "vendor/uplot.min.js"]
    if data.get("cloud"):
        libraries.append("vendor/three.min.js")
    own = sorted(f"page/{path.name}" for path in (TEMPLATES / "page").glob("*.js"))
    own.sort(key="page/base.js".__ne__)
    styles = ["vendor/ol.min.css", "vendor/uplot.min.css"]
    styles += sorted(f"page/{path.name}" for path in (TEMPLATES / "page").glob("*.css"))
    return WorkPage(title, legend, Markup(packed(data)), picture_of(data), (*libraries, *own), tuple(styles))


def picture_of(data: Mapping[str, Any]) -> Markup:
    """The first layer with the path and the accepted loops drawn in, as SVG in metres."""
    layers, path_m = data["layers"], data["trajectory"]["xy"].astype(np.float64)
    path_m = path_m[np.isfinite(path_m).all(axis=1)]
    path_m = path_m[:: max(1, len(path_m) // _CORNERS)]
    loops = np.zeros((0, 4))
    if "loops" in data:
        ends, bases = data["loops"], data["nodes"]["bases"]
        chosen = np.flatnonzero(ends["accepted"])
        chosen = chosen[:: max(1, -(-len(chosen) // _LINES))]
        loops = np.hstack([bases[ends[side][chosen], :2] for side in ("place", "keyframe")])
    low, high = _bounds(layers[0] if layers else None, path_m)
    return render(
        "picture.html",
        box=[low[0], -high[1], *(high - low)],
        layer=layers[0] if layers else None,
        turn_deg=-np.degrees(layers[0]["corner"][2]) if layers else 0.0,
        way=" ".join(f"{x:.2f},{-y:.2f}" for x, y in path_m.tolist()),
        loops=" ".join(f"M{a:.2f},{-b:.2f}L{c:.2f},{-d:.2f}" for a, b, c, d in loops.tolist()),
        ends=[(x, -y) for x, y in path_m[[0, -1]].tolist()] if len(path_m) else [],
        dot_m=0.008 * float((high - low).max()),
    )


def _bounds(layer: Mapping[str, Any] | None, path_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner of layer and way, with a margin."""
    corners = [path_m]
    if layer is not None:
        x, y, yaw = layer["corner"]
        size = np.array([layer["cols"], layer["rows"]]) * layer["resolution_m"]
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        corners.append((np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size) @ turn + [x, y])
    points = np.vstack(corners)
    if not len(points):
        points = np.zeros((1, 2))
    return points.min(axis=0) - _MARGIN_M, points.max(axis=0) + _MARGIN_M
