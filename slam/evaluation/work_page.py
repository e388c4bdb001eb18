"""The interactive plan as parts of a page: data, scripts, and a picture for browsers without scripts."""

from __future__ import annotations

import base64
import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from slam.evaluation.pages import TEMPLATES, render
from slam.foreign import plain_lines
from slam.measurements import FloatArray

_ALIGNED = 8
# Largest number of corners of the path, and of loops, in a picture.
_CORNERS, _LINES = 2000, 400
_MARGIN_M = 0.5


@dataclass(frozen=True, slots=True)
class WorkPage:
    """What a template needs for the plan.

    Attributes
    ----------
    blob
        The data, see `packed`.
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


def packed(head: Mapping[str, Any]) -> str:
    """Pack texts, numbers and numpy arrays in mappings and sequences as base64 of gzip, deterministically.

    The first four bytes are the length of a JSON head, little-endian; together with them it is a multiple of
    eight. The arrays follow as they are in memory, each at a multiple of eight from there; in the head an
    array is ``{"dtype": "f4", "shape": [rows, columns], "offset": bytes}``. The page reads it by
    ``templates/page/data.js``.

    Texts are made plain, see `slam.foreign`; a float that is not finite becomes null, in an array it stays.
    """
    parts: list[NDArray[Any]] = []
    text = json.dumps(_told(head, parts), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    filled = text + b" " * (-(4 + len(text)) % _ALIGNED)
    # Packed part by part: all at once would need twice the memory more.
    packer = zlib.compressobj(4, zlib.DEFLATED, 16 + zlib.MAX_WBITS)
    pieces = [packer.compress(struct.pack("<I", len(filled)) + filled)]
    for part in parts:
        pieces += [packer.compress(part.data), packer.compress(bytes(-part.nbytes % _ALIGNED))]
    return base64.b64encode(b"".join([*pieces, packer.flush()])).decode("ascii")


def _told(value: Any, parts: list[NDArray[Any]]) -> Any:
    """Convert a value for JSON; arrays are appended to the parts."""
    if isinstance(value, np.ndarray):
        offset = sum(part.nbytes + -part.nbytes % _ALIGNED for part in parts)
        parts.append(np.ascontiguousarray(value, value.dtype.newbyteorder("<")).reshape(-1).view(np.uint8))
        return {"dtype": value.dtype.str[1:], "shape": list(value.shape), "offset": offset}
    if isinstance(value, str):
        return plain_lines(value)
    if isinstance(value, Mapping):
        return {plain_lines(str(key)): _told(one, parts) for key, one in value.items()}
    if isinstance(value, Sequence):
        return [_told(one, parts) for one in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
