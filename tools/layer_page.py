"""Common parts of the pages of the two map papers: pictures of grids, tables, one self-contained file."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from slam.evaluation.figure_parts import figure_of, png_of
from slam.evaluation.pages import parts, write_page

_GREY = {100: 0, 0: 254, -1: 178}


def write_parts(path: Path, title: str, pieces: Sequence[str]) -> None:
    """A page of pieces of HTML."""
    write_page(path, "page.html", title=title, kind="experiment", content=Markup("\n".join(pieces)))


def section(title: str, *content: str) -> str:
    """A titled part of the page; the content is HTML."""
    return str(parts().section(title, caller=lambda: Markup("".join(content))))


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts."""
    return str(parts().table(head, rows))


def write_json(path: Path, content: Any) -> None:
    """Write figures; what is not a number is null."""
    path.write_text(json.dumps(plain(content), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def grids(pictures: Sequence[tuple[str, NDArray[np.int8]]], description: str) -> str:
    """Grids of 100, 0 and -1 side by side: black, white, grey."""
    figure = figure_of(270 * len(pictures), 300)
    for place, (title, states) in enumerate(pictures, start=1):
        axes = figure.add_subplot(1, len(pictures), place)
        grey = np.full(states.shape, 178, dtype=np.uint8)
        for state, value in _GREY.items():
            grey[states == state] = value
        axes.imshow(grey, cmap="gray", vmin=0, vmax=255, origin="lower", interpolation="nearest")
        axes.set_title(title, fontsize=10)
        axes.set_xticks([])
        axes.set_yticks([])
    figure.tight_layout()
    return str(parts().image(png_of(figure), description))


def plain(value: Any) -> Any:
    """For JSON: plain numbers, six digits."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return round(float(value), 6) if math.isfinite(value) else None
    return value
