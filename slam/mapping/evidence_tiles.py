"""Sums of evidence in square tiles: only seen areas use memory, and the least used tiles go to disk.

Evidence is in integer steps of log-odds (`fusion.bayes.STEPS_A_UNIT`). So sums are exact, and the order of
the boards does not matter.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.errors import ScanweaveError
from slam.mapping.occupancy_grid import Steps
from slam.mapping.ray_tracing import Box
from slam.spool import no_room
from slam.temporary import TemporaryFolder

Tile: TypeAlias = NDArray[np.int32]

SIDE = 256
TILE_BYTES = SIDE * SIDE * np.dtype(np.int32).itemsize


class Board(NamedTuple):
    """Evidence of one reading for a rectangle of cells: log-odds steps, first row and column.

    The steps are (rows, cols), or (rows, cols, heights) if the cells have height bins.
    """

    steps: Steps
    row: int
    col: int

    def box(self) -> Box:
        """Return first row, first col, rows, cols."""
        return self.row, self.col, self.steps.shape[0], self.steps.shape[1]


class EvidenceTiles:
    """The sum of all boards, on an endless lattice.

    Parameters
    ----------
    memory_mb
        Tiles beyond this (10^6 bytes) wait in a temporary folder, which goes with this object.
    heights
        Number of height bins of a cell; a board without heights counts for all of them.
    """

    def __init__(self, memory_mb: float = 24.0, heights: int = 1) -> None:
        self._loaded: OrderedDict[tuple[int, int], Tile] = OrderedDict()
        # A tile uses about the same memory for any number of height bins.
        self._side = max(1, math.isqrt(SIDE * SIDE // heights))
        self._shape = (self._side, self._side, heights)
        self._most_tiles = max(4, int(memory_mb * 1e6 / TILE_BYTES))
        self._spilled: set[tuple[int, int]] = set()
        self._folder: TemporaryFolder | None = None
        self.used: Box | None = None

    def add(self, board: Board) -> None:
        """Add a board, Li2020 Eq. (8) for every cell."""
        box = board.box()
        heights = self._shape[2]
        steps = board.steps if board.steps.ndim == 3 else board.steps[:, :, None]
        if steps.shape[2] < heights:
            steps = np.repeat(steps, heights, axis=2)
        for key, tile_part, board_part in _parts(box, self._side):
            # Boards are mostly empty at their borders: create no tile without evidence.
            if self._holds(key) or steps[board_part].any():
                self._tile(key)[tile_part] += steps[board_part]
        self.used = box if self.used is None else union(self.used, box)

    def clipped(self, box: Box, low: int, high: int) -> Steps:
        """Return (rows, cols) of the sums in a box, clamped: for each cell its most occupied height.

        A height without evidence is unknown: a cell is free only if all its heights are.
        """
        steps = np.zeros(box[2:], dtype=np.int16)
        for key, tile_part, part in _parts(box, self._side):
            if self._holds(key):
                steps[part] = np.clip(self._tile(key)[tile_part].max(axis=2), low, high)
        return steps

    def coarse(self, box: Box, low: int, high: int, side: int) -> Steps:
        """Return `clipped` in cells of ``side`` times ``side``, each with its most occupied one.

        So a partly unknown cell is not free, and every obstacle stays. The box is aligned with such cells;
        one row of tiles is in memory at a time.
        """
        row, col, rows, cols = box
        steps = np.empty((rows // side, cols // side), dtype=np.int16)
        for first in range(0, rows, SIDE * side):
            part = self.clipped((row + first, col, min(SIDE * side, rows - first), cols), low, high)
            blocks = part.reshape(len(part) // side, side, cols // side, side)
            steps[first // side : first // side + len(blocks)] = blocks.max(axis=(1, 3))
        return steps

    def _holds(self, key: tuple[int, int]) -> bool:
        """Return whether the tile exists, in memory or on disk."""
        return key in self._loaded or key in self._spilled

    def _tile(self, key: tuple[int, int]) -> Tile:
        """Return a tile from memory, from disk, or new; mark it as most recently used."""
        tile = self._loaded.get(key)
        if tile is None:
            tile = self._load(key) if key in self._spilled else np.zeros(self._shape, dtype=np.int32)
            self._loaded[key] = tile
            if len(self._loaded) > self._most_tiles:
                self._spill(*self._loaded.popitem(last=False))
        else:
            self._loaded.move_to_end(key)
        return tile

    def _spill(self, key: tuple[int, int], tile: Tile) -> None:
        """Write a tile to disk."""
        try:
            if self._folder is None:
                self._folder = TemporaryFolder()
            tile.tofile(self._path(key))
        except OSError as error:
            raise no_room("tiles of the map", error) from error
        self._spilled.add(key)

    def _load(self, key: tuple[int, int]) -> Tile:
        """Read a tile from disk."""
        self._spilled.discard(key)
        try:
            return np.fromfile(self._path(key), dtype=np.int32).reshape(self._shape)
        except (OSError, ValueError) as error:
            raise ScanweaveError(f"a tile of the map is gone: {self._path(key)}; run again") from error

    def _path(self, key: tuple[int, int]) -> Path:
        assert self._folder is not None
        return self._folder.path / f"{key[0]}_{key[1]}.tile"


def union(a: Box, b: Box) -> Box:
    """Return the smallest box (first row, first col, rows, cols) that contains both."""
    row, col = min(a[0], b[0]), min(a[1], b[1])
    return row, col, max(a[0] + a[2], b[0] + b[2]) - row, max(a[1] + a[3], b[1] + b[3]) - col


def _parts(box: Box, side: int) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
    """Yield the tiles that overlap a box: key, part of the tile, and part of the box."""
    row, col, rows, cols = box
    for i in range(row // side, (row + rows - 1) // side + 1):
        for j in range(col // side, (col + cols - 1) // side + 1):
            top, left = max(row, i * side), max(col, j * side)
            bottom, right = min(row + rows, (i + 1) * side), min(col + cols, (j + 1) * side)
            tile = (slice(top - i * side, bottom - i * side), slice(left - j * side, right - j * side))
            yield (i, j), tile, (slice(top - row, bottom - row), slice(left - col, right - col))
