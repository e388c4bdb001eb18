"""Common parts of matplotlib figures: their colours, and conversion to PNG."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, GREY = "#2563b8", "#d9730d", "#1f8a4c", "#c2352b", "#667281"
DPI = 100


def figure_of(width_px: int, height_px: int) -> Figure:
    """Create a figure without pyplot: no global state, no window system."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_px / DPI, height_px / DPI), dpi=DPI, facecolor="white")


def png_of(figure: Figure) -> bytes:
    """Render the figure by Agg as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    canvas: Any = FigureCanvasAgg(figure)  # its methods have no types
    canvas.draw()
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).save(buffer, format="png")
    return buffer.getvalue()
