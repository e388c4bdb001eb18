"""What the figures of report.html share: their look, and how they become PNG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam.measurements import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, GREY = "#2563b8", "#d9730d", "#1f8a4c", "#c2352b", "#667281"
DPI = 100
_MAX_POINTS = 4000


def figure_of(width_px: int, height_px: int, facecolor: str = "white") -> Figure:
    """A figure without pyplot: no global state, no window system."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_px / DPI, height_px / DPI), dpi=DPI, facecolor=facecolor)


def plain(axes: Axes) -> None:
    """Small labels, a faint grid, no box at the right and the top."""
    axes.tick_params(labelsize=8, colors=GREY)
    axes.xaxis.label.set(fontsize=9, color=GREY)
    axes.yaxis.label.set(fontsize=9, color=GREY)
    axes.grid(True, color=GREY, alpha=0.18, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def legend_above(axes: Axes) -> None:
    """A legend in one line above the axes, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 0.985), ncols=5, fontsize=8, frameon=False)


def thinned(rows: FloatArray) -> FloatArray:
    """At most _MAX_POINTS rows or so, evenly taken, the last one kept."""
    step = max(1, len(rows) // _MAX_POINTS)
    return np.concatenate([rows[:-1:step], rows[-1:]])


def png_of(figure: Figure, ground: NDArray[np.uint8] | None = None) -> bytes:
    """The figure rendered by Agg, over an (H, W, 3) ground of the same size."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas: Any = FigureCanvasAgg(figure)  # its methods bear no types
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())
    rgb = drawn[..., :3]
    if ground is not None:
        # Laid over by hand: imshow would resample by way of several float copies, tens of megabytes.
        alpha = drawn[..., 3:].astype(np.uint16)
        rgb = ((rgb * alpha + ground * (255 - alpha)) // 255).astype(np.uint8)
    return encoded_png(rgb)


def encoded_png(image: NDArray[np.uint8]) -> bytes:
    """An (H, W) grey or (H, W, 3) RGB picture as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="png")
    return buffer.getvalue()
