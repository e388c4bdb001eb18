"""Layers of a map as images under the plan of its page."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.mapping.layered_map import LayeredMap, LayerName
from slam.mapping.occupancy_grid import FREE, OCCUPIED, THRESHOLDS, OccupancyGrid
from slam.measurements import BoolArray

# A browser draws images of this size smoothly; larger maps are shown in coarser cells.
_LONGEST_SIDE_PX = 4096
_MARGIN_CELLS = 8  # margin around the known cells
# Kinds of cells, in ascending priority when cells are joined.
_UNSEEN, _FREE, _LIDAR_HEIGHT, _WALL = range(4)
_SHADES = ((205, 205, 205), (254, 254, 254), (232, 232, 232), (0, 0, 0))
_CONFLICT = ((0, 0, 0), (217, 115, 13), (147, 51, 234))
_GONE = (220, 38, 38)
LEGENDS = {
    "map": "The map for navigation: black is an obstacle, white is free.",
    "probability": "Probability that a cell is occupied, from all sensors: white 0, black 1.",
    "lidar": "Lidar only, at its own height (layers/lidar.yaml).",
    "depth": "Cameras only, over the robot's height (layers/depth.yaml).",
    "fused": "Lidar and cameras fused; unknown where they contradict each other (layers/fused.yaml).",
    "removed objects": "Red: seen by the lidar for a while, then passed by beams "
    "(layers/passed_by.yaml); not in the map.",
    "sensors disagree": "Orange: only the cameras see an obstacle. Violet: only the lidar does.",
}


@dataclass(frozen=True, slots=True)
class Picture:
    """A layer.

    Attributes
    ----------
    kinds
        (rows, cols) index into the shades; 0 is transparent. Row 0 at the lowest y, as in a grid.
    shades
        Colour of each kind.
    """

    name: str
    kinds: NDArray[np.uint8]
    shades: Sequence[tuple[int, int, int]]

    def known(self) -> tuple[BoolArray, BoolArray]:
        """Return (rows,) and (cols,) with visible cells."""
        return np.asarray(self.kinds.any(axis=1)), np.asarray(self.kinds.any(axis=0))

    def png(self, window: tuple[slice, slice]) -> bytes:
        """Return a part of it as PNG, row 0 at the top."""
        from PIL import Image

        kinds = _joined(self.kinds[window])
        image = Image.fromarray(np.ascontiguousarray(kinds[::-1]), mode="P")
        image.putpalette(np.array(self.shades, np.uint8).tobytes())
        buffer = io.BytesIO()
        image.save(buffer, format="png", transparency=0)
        return buffer.getvalue()


def layer_pictures(layers: LayeredMap | None, passed_by: OccupancyGrid | None = None) -> list[dict[str, Any]]:
    """Return the map and then its layers for the header of the page's data; empty without a map.

    Each has its name, the meaning of its colours, the PNG as a data URL, whether it is drawn over another
    layer, the side of a pixel, and the pose ``T_map_corner`` (x, y, yaw) of its lower-left corner.
    """
    if layers is None:
        return []
    window = _known(_pictures(layers, passed_by))
    rows, columns = (part.stop - part.start for part in window)
    pixel_m = layers.resolution_m * _step((rows, columns))
    low = gtsam.Pose2(window[1].start * layers.resolution_m, window[0].start * layers.resolution_m, 0.0)
    corner = layers.T_map_grid.compose(low)

    def entry(picture: Picture) -> dict[str, Any]:
        address = "data:image/png;base64," + base64.b64encode(picture.png(window)).decode("ascii")
        return {
            "name": picture.name,
            "legend": LEGENDS[picture.name],
            "png": address,
            "over": picture.shades is _CONFLICT,
            "resolution_m": pixel_m,
            "corner": [corner.x(), corner.y(), corner.theta()],
            "rows": -(-rows // _step((rows, columns))),
            "cols": -(-columns // _step((rows, columns))),
        }

    # A loop would keep an image until it has the next one.
    return [*map(entry, _pictures(layers, passed_by))]


def areas_m2(layers: LayeredMap) -> tuple[float, float]:
    """Return the free floor area, and the additional area free only at the height of the lidar."""
    # Row by row, since it counts 8-byte integers.
    counts = np.zeros(len(_SHADES), np.int64)
    for row in _map(layers).kinds:
        counts += np.bincount(row, minlength=len(_SHADES))
    return counts[_FREE] * layers.resolution_m**2, counts[_LIDAR_HEIGHT] * layers.resolution_m**2


def _map(layers: LayeredMap) -> Picture:
    """Return the navigation map, with a separate kind for cells that only the lidar saw as free."""
    kinds = _kinds(layers, "decision")
    if layers.names:
        kinds[layers.free_at_lidar_height() & (kinds == _UNSEEN)] = _LIDAR_HEIGHT
    return Picture("map", kinds, _SHADES)


def _pictures(layers: LayeredMap, passed_by: OccupancyGrid | None) -> Iterator[Picture]:
    """Yield the map, its layers and removed objects; one in memory at a time."""
    yield _map(layers)
    percent = layers.percent()
    grey = np.rint(np.linspace(254.0, 0.0, 101)).astype(int).tolist()
    shades = [(0, 0, 0), *((shade, shade, shade) for shade in grey)]
    percent += 1
    yield Picture("probability", percent.view(np.uint8), shades)
    del percent
    for name in layers.names:
        if name != "decision":
            yield Picture(name, _kinds(layers, name), _SHADES)
    if layers.lidar is not None and layers.depth is not None:
        lidar, depth = layers.states("lidar"), layers.states("depth")
        kinds = np.zeros(lidar.shape, np.uint8)
        kinds[(lidar == FREE) & (depth == OCCUPIED)] = 1
        kinds[(lidar == OCCUPIED) & (depth == FREE)] = 2
        yield Picture("sensors disagree", kinds, _CONFLICT)
    if passed_by is not None:
        yield _gone(layers, passed_by)


def _gone(layers: LayeredMap, passed_by: OccupancyGrid) -> Picture:
    """Return temporary objects over the map; both have aligned cells."""
    rows, columns = np.nonzero(THRESHOLDS.occupied(passed_by.steps))
    kinds = _kinds(layers, "decision")
    offset = layers.T_map_grid.between(passed_by.T_map_grid)
    row, column = round(offset.y() / layers.resolution_m), round(offset.x() / layers.resolution_m)
    kinds[rows + row, columns + column] = len(_SHADES)
    return Picture("removed objects", kinds, (*_SHADES, _GONE))


def _kinds(layers: LayeredMap, name: LayerName) -> NDArray[np.uint8]:
    """Convert the states of a layer to kinds."""
    kinds = layers.states(name).view(np.uint8)
    kinds += 1  # from unknown, free and occupied to 0, 1 and more than any kind, in place
    return np.minimum(kinds, _WALL, out=kinds)


def _known(pictures: Iterable[Picture]) -> tuple[slice, slice]:
    """Return the rows and columns of known cells, with a margin; all if nothing is known."""
    windows = []
    for lines in zip(*map(Picture.known, pictures), strict=True):
        (there,) = np.nonzero(np.any(lines, axis=0))
        size = len(lines[0])
        first, last = (there[0], there[-1]) if there.size else (0, size - 1)
        windows.append(slice(max(int(first) - _MARGIN_CELLS, 0), min(int(last) + _MARGIN_CELLS + 1, size)))
    return windows[0], windows[1]


def _step(shape: tuple[int, int]) -> int:
    """Return the number of cells along the side of a pixel."""
    return max(1, -(-max(shape) // _LONGEST_SIDE_PX))


def _joined(kinds: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Join cells of a large image: the highest kind remains, and so do thin walls."""
    step = _step((kinds.shape[0], kinds.shape[1]))
    if step > 1:
        for axis in (0, 1):
            kinds = np.maximum.reduceat(kinds, np.arange(0, kinds.shape[axis], step), axis=axis)
    return kinds
