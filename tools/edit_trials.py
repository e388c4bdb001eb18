"""Erase regions of saved maps at random: whether they stay away, and whether anything else changes.

    python tools/edit_trials.py MAP [MAP ...] --count 10

Each region is a crooked polygon of 0.6 to 2.4 m about an occupied cell. Told are the cells that differ and do
not touch the polygon, at the map's own resolution, and the occupied cells wholly in it, there and after
`remap` with cells of half the side and of twice; of the first region of a map also whether a replay gives the
same bytes, and undo those of before.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import slam
from slam.mapping.occupancy_grid import OCCUPIED, OccupancyGrid
from slam.mapping.polygons import inside
from slam.measurements import BoolArray, FloatArray
from slam.outputs.finished_map import Map

_ACROSS = np.linspace(0.0, 1.0, 9)


@dataclass(frozen=True, slots=True)
class Trial:
    """What became of a region.

    Attributes
    ----------
    outside
        Cells that differ and do not touch it.
    before, left
        Occupied cells wholly in it: before, and after erasing at the resolution of the map, half and twice.
    seconds
        What erasing took.
    """

    outside: int
    before: int
    left: tuple[int, int, int]
    seconds: float


def trial(saved: Map, rng: np.random.Generator) -> tuple[Trial, Map, FloatArray]:
    """Erase one region; the trial, the erased map and the polygon."""
    polygon = _polygon(saved, rng)
    started = time.process_time()
    erased = saved.edited({"erase": [{"polygon": polygon.tolist()}]})
    seconds = time.process_time() - started
    outside = 0
    for name, grid in saved.contents.grids.items():
        other = erased.contents.grids.get(name)  # what was passed by may all be gone
        steps = np.zeros_like(grid.steps) if other is None else other.steps
        assert steps.shape == grid.steps.shape
        outside += int((~_touch(grid, np.argwhere(grid.steps != steps), polygon)).sum())
    sides = (saved.config.grid.resolution_m * factor for factor in (0.5, 2.0))
    anew = [erased, *(erased.remap([f"grid.resolution_m={side}"]) for side in sides)]
    left = tuple(_occupied(one, polygon) for one in anew)
    assert len(left) == 3
    return Trial(outside, _occupied(saved, polygon), left, seconds), erased, polygon


def _polygon(saved: Map, rng: np.random.Generator) -> FloatArray:
    """(n, 2) corners about an occupied cell."""
    grids = list(saved.contents.grids.values())
    grid = grids[int(rng.integers(len(grids)))]
    cells = np.argwhere(grid.states() == OCCUPIED)[:, ::-1]
    middle = _placed(grid, cells[rng.integers(len(cells))] + 0.5)
    turns = np.sort(rng.uniform(0.0, 2.0 * np.pi, int(rng.integers(4, 9))))
    reach = rng.uniform(0.3, 1.2, len(turns))
    return middle + reach[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])


def _placed(grid: OccupancyGrid, cells: FloatArray) -> FloatArray:
    """Columns and rows as points of the map; its grids are not turned."""
    return np.asarray(grid.T_map_grid.translation() + np.asarray(cells) * grid.resolution_m)


def _touch(grid: OccupancyGrid, cells: np.ndarray, polygon: FloatArray) -> BoolArray:
    """Which (row, column) cells have a part in the polygon."""
    found = np.zeros(len(cells), np.bool_)
    for x in _ACROSS:
        for y in _ACROSS:
            found |= inside(_placed(grid, cells[:, ::-1] + np.array([x, y])), polygon)
    return found


def _occupied(saved: Map, polygon: FloatArray) -> int:
    """Occupied cells of all grids wholly in a polygon."""
    total = 0
    for grid in saved.contents.grids.values():
        cells = np.argwhere(grid.states() == OCCUPIED)
        whole = np.ones(len(cells), np.bool_)
        for x in _ACROSS:
            for y in _ACROSS:
                whole &= inside(_placed(grid, cells[:, ::-1] + np.array([x, y])), polygon)
        total += int(whole.sum())
    return total


def _same(saved: Map, erased: Map, polygon: FloatArray) -> str:
    """Whether replay and undo give the bytes that they should."""
    replay = saved.edited({"erase": [{"polygon": polygon.tolist()}]})
    same = Path(replay.path).read_bytes() == Path(erased.path).read_bytes()
    # Kept until they are read: a map in a temporary folder goes with its object.
    plain, undone = saved.remap(), erased.undone()
    back = Path(plain.path).read_bytes() == Path(undone.path).read_bytes()
    return f"replay {'the same' if same else 'ANOTHER'}, undo {'the same' if back else 'ANOTHER'}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a line a map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--count", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    for path in chosen.maps:
        # A map of an older version is compared as this one draws it.
        saved, rng = slam.load_map(path).remap(), np.random.default_rng(chosen.seed)
        found = [trial(saved, rng) for _ in range(chosen.count)]
        trials = [one for one, _, _ in found]
        left = np.sum([one.left for one in trials], axis=0)
        print(
            f"{path}: {len(trials)} regions, {sum(one.outside for one in trials)} cells changed outside; "
            f"occupied inside {sum(one.before for one in trials)} before, {left[0]} after, "
            f"{left[1]} with cells of half the side, {left[2]} of twice; {_same(saved, *found[0][1:])}; "
            f"{np.mean([one.seconds for one in trials]):.1f} CPU s each"
        )


if __name__ == "__main__":
    main()
