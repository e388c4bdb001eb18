"""Common parts of matplotlib figures: their style, and conversion to PNG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from slam.measurements import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, GREY = "#2563b8", "#d9730d", "#1f8a4c", "#c2352b", "#667281"
DPI = 100
_MAX_POINTS = 4000


def figure_of(width_px: int, height_px: int) -> Figure:
    """A figure without pyplot: no global state, no window system."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_px / DPI, height_px / DPI), dpi=DPI, facecolor="white")


def plain(axes: Axes) -> None:
    """Small labels, a faint grid, no box at the right and the top."""
    axes.tick_params(labelsize=8, colors=GREY)
    axes.xaxis.label.set(fontsize=9, color=GREY)
    axes.yaxis.label.set(fontsize=9, color=GREY)
    axes.grid(True, color=GREY, alpha=0.18, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def thinned(rows: FloatArray) -> FloatArray:
    """At most _MAX_POINTS rows or so, evenly taken, the last one kept."""
    step = max(1, len(rows) // _MAX_POINTS)
    return np.concatenate([rows[:-1:step], rows[-1:]])


def png_of(figure: Figure) -> bytes:
    """The figure rendered by Agg."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas: Any = FigureCanvasAgg(figure)  # its methods bear no types
    canvas.draw()
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).save(buffer, format="png")
    return buffer.getvalue()
