"""Display of records: one line in a shell; that line and a small picture in a notebook."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sized
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY

Pixels: TypeAlias = NDArray[np.uint8]


def one_line(record: Any) -> str:
    """Return a record as its ``__repr__``: short values as they are, arrays and long values summarised.

    Examples
    --------
    >>> import fusion, numpy as np
    >>> fusion.LidarCurve(np.linspace(1.0, 4.0, 181), start_angle_rad=-1.57, step_rad=0.01745)
    LidarCurve(ranges_m=float64[181] 1..4, start_angle_rad=-1.57, step_rad=0.01745, range_max_m=inf)
    """
    names = [item.name for item in fields(record) if item.repr] if is_dataclass(record) else vars(record)
    shown = [f"{name}={_shown(name, getattr(record, name))}" for name in names if not name.startswith("_")]
    if not is_dataclass(record) and hasattr(record, "__len__"):
        shown.insert(0, f"len={len(record)}")
    return f"{type(record).__name__}({', '.join(shown)})"


def _shown(name: str, value: Any) -> str:
    """Return a field in one line."""
    kind = type(value).__name__
    if isinstance(value, np.ndarray):
        return _array(name, value)
    if isinstance(value, float | np.floating):
        return f"{value:.3f}" if 100_000 <= abs(float(value)) < math.inf else f"{value:.6g}"  # a stamp
    if isinstance(value, Enum):
        return f"{kind}.{value.name}"
    if kind == "Pose2":
        return f"Pose2({value.x():.6g}, {value.y():.6g}, {value.theta():.6g})"
    if kind == "Pose3":
        place, turn = (_several(part + 0.0) for part in (value.translation(), value.rotation().rpy()))
        return f"Pose3(xyz=({place}), rpy=({turn}))"
    if isinstance(value, Sized) and not isinstance(value, str):
        return _counted(name, value)
    if isinstance(value, np.generic | Path):
        value = str(value) if isinstance(value, Path) else value.item()
    # The generated __repr__ of dataclasses would format all contents of a large record.
    text = one_line(value) if hasattr(type(value).__repr__, "__wrapped__") else repr(value)
    return text if len(text) <= 140 and "\n" not in text else f"{kind}(...)"


def _counted(name: str, value: Sized) -> str:
    """Return a few short values as they are; for more, their number and type."""
    kinds = set[str]()
    if isinstance(value, list | tuple):
        text = ", ".join(_shown(name, item) for item in value[:5])
        text = f"({text})" if isinstance(value, tuple) else f"[{text}]"
        kinds = {type(item).__name__ for item in value if item is not None}
    else:
        text = repr(value) if isinstance(value, dict) and len(value) <= 4 else "..."
    if len(value) <= 4 and len(text) <= 100 and "..." not in text:
        return text
    return f"{type(value).__name__}[{' '.join([str(len(value)), *sorted(kinds)])}]"


def _array(name: str, value: NDArray[Any]) -> str:
    """Return type, shape and extent: for points along each axis, for other numbers from least to largest."""
    text = f"{value.dtype}{list(value.shape)}"
    if value.dtype.kind not in "fiu" or not value.size:
        return text
    if "covariance" in name and value.ndim == 2:
        return f"{text} sigmas {_several(np.sqrt(np.maximum(np.diag(value), 0.0)).round(6))}"
    if value.ndim == 1 and value.size <= 6:
        return f"({_several(value)})"
    if name.startswith(("points", "positions", "stamps")):
        return f"{text} over {extent(value)}"
    finite = value[np.isfinite(value)]
    return f"{text} {finite.min():.4g}..{finite.max():.4g}" if finite.size else text


def extent(points: NDArray[Any]) -> str:
    """Return the extent of points (N, d) along each axis, or of numbers (N,)."""
    rows = points[:, None] if points.ndim == 1 else points
    rows = rows[np.isfinite(rows).all(axis=1)]
    return " x ".join(f"{side:.3g}" for side in np.ptp(rows, axis=0)) if len(rows) else "nothing"


def _several(values: NDArray[Any]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)


def with_pictures(record: Any, *pictures: Pixels | bytes | None) -> str:
    """Return HTML of a record: pictures (PNG, or arrays with row 0 at the top), then its line."""
    from PIL import Image

    parts = []
    for picture in pictures:
        if isinstance(picture, np.ndarray):
            buffer = io.BytesIO()
            Image.fromarray(np.ascontiguousarray(picture)).save(buffer, format="png")
            picture = buffer.getvalue()
        if picture is not None:
            data = base64.b64encode(picture).decode("ascii")
            parts.append(
                f'<img src="data:image/png;base64,{data}" style="max-width:320px; margin-right:8px">'
            )
    return f"<div>{''.join(parts)}<br><code>{html.escape(repr(record))}</code></div>"


def drawn(side: int = 320, **layers: NDArray[Any]) -> Pixels | None:
    """Draw points (N, 2), each layer in the colour of its name, x to the right and y up; None without any."""
    from PIL import Image, ImageDraw

    known = {color: points[np.isfinite(points).all(axis=1)] for color, points in layers.items()}
    everything = np.concatenate(list(known.values()))
    if not len(everything):
        return None
    low, extent = everything.min(axis=0), np.ptp(everything, axis=0)
    scale = (side - 3) / max(extent.max(), TINY)
    width, height = np.ceil(extent * scale).astype(int) + 3
    picture = Image.new("RGB", (int(width), int(height)), "white")
    pen = ImageDraw.Draw(picture)
    for color, points in known.items():
        x, y = np.rint((points - low) * scale).astype(int).T
        for right, down in ((1, 1), (2, 1), (1, 2), (2, 2)):
            pen.point(np.column_stack([x + right, height - 1 - y - down]).ravel().tolist(), fill=color)
    return np.asarray(picture)


def shaded(values: NDArray[Any], side: int = 320) -> Pixels:
    """Draw numbers (H, W) in grey, larger ones brighter, not finite ones black; photos are unchanged."""
    step = -(-max(values.shape[:2]) // side)
    values = values[::step, ::step]
    if values.dtype == np.uint8:
        return values
    known = np.isfinite(values)
    low, high = (values[known].min(), values[known].max()) if known.any() else (0, 1)
    share = (np.where(known, values, low) - low) / max(high - low, TINY)
    return np.asarray(np.where(known, 30 + 225 * share, 0), np.uint8)


def shrunk(drawing: Pixels, side: int = 320) -> Pixels:
    """Shrink a drawing (H, W, 3): the darkest of neighbouring pixels is kept, so that lines remain."""
    step = -(-max(drawing.shape[:2]) // side)
    for axis in (0, 1):
        drawing = np.minimum.reduceat(drawing, np.arange(0, drawing.shape[axis], step), axis=axis)
    return drawing
