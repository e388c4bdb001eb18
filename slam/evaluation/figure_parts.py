"""Common parts of matplotlib figures: their colours, conversion to PNG, and the picture of a path."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam.mapping.navigation import FreeSpace, Path
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, RED, GREY = "#2563b8", "#d9730d", "#1f8a4c", "#c2352b", "#667281"
DPI = 100

_LONG_SIDE_PX = 1000
_MARGIN_M = 1.0


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


def plan_picture(states: StateArray, space: FreeSpace, path: Path) -> bytes:
    """Draw a PNG: map, grey cells forbidden for the robot's centre, path, green start, red goal."""
    shade = np.full((*states.shape, 3), 205, dtype=np.uint8)
    shade[states == FREE] = (232, 226, 218)
    shade[space.allowed] = 254
    shade[states == OCCUPIED] = 0
    cells = np.array([space.cell_of((float(x), float(y))) for x, y in path.points_map])
    rows, cols = _window(states, cells, round(_MARGIN_M / space.resolution_m))
    height, width = rows.stop - rows.start, cols.stop - cols.start
    scale = _LONG_SIDE_PX / max(height, width)
    figure = figure_of(max(200, round(width * scale)), max(200, round(height * scale)))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    extent = (cols.start - 0.5, cols.stop - 0.5, rows.start - 0.5, rows.stop - 0.5)
    axes.imshow(shade[rows, cols], origin="lower", interpolation="nearest", extent=extent)
    axes.plot(cells[:, 1], cells[:, 0], color=BLUE, linewidth=2.5)
    for place, color in ((0, GREEN), (-1, RED)):
        axes.plot(cells[place, 1], cells[place, 0], "o", color=color, markersize=9)
    axes.set_axis_off()
    return png_of(figure)


def _window(states: StateArray, cells: NDArray[np.int64], margin: int) -> tuple[slice, slice]:
    """Return the part of the map that contains the path and all known cells."""
    known = np.argwhere(states >= FREE)
    low = np.minimum(known.min(axis=0), cells.min(axis=0)) - margin
    high = np.maximum(known.max(axis=0), cells.max(axis=0)) + margin + 1
    low, high = np.maximum(low, 0), np.minimum(high, states.shape)
    return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))
