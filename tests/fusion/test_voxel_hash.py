"""The voxels of rooms and streets are spread over a hash table: long runs of full slots would cost time."""

from __future__ import annotations

import numpy as np
import pytest

from fusion.voxel_hash import AXIS, AXIS_BITS, HALF, entries_at, index_keys, table_for


def _keys(cells: np.ndarray, level: int = 0) -> np.ndarray:
    """Return the keys of cells (N, 3)."""
    x, y, z = (cells.astype(np.int64) + HALF & AXIS).T
    return x << 2 * AXIS_BITS | y << AXIS_BITS | z | level << 3 * AXIS_BITS


def _longest_run(table: np.ndarray) -> int:
    """Return the length of the longest run of full slots."""
    ends = np.flatnonzero(np.diff((table >= 0).astype(np.int8), prepend=0, append=0))
    return int(np.diff(ends)[::2].max())


@pytest.mark.parametrize("side", [20, 100])
def test_walls_and_floors_of_every_size_leave_no_long_runs(side: int) -> None:
    keys = []
    for level in range(3):
        across, up = np.indices((side >> level, side >> level)).reshape(2, -1)
        for planes in ((across, up, 0 * up), (across, 0 * up - 1, up + 1), (0 * up - 1, across, up + 1)):
            keys.append(_keys(np.column_stack(planes) - 7, level))
    known = np.unique(np.concatenate(keys))
    table = table_for(len(known))
    index_keys(known, table)
    assert _longest_run(table) < 100


def test_a_point_finds_the_entry_of_its_voxel() -> None:
    cells = np.random.default_rng(1).permutation(np.indices((9, 9, 9)).reshape(3, -1).T - 4)
    keys, table = _keys(cells), table_for(len(cells))
    index_keys(keys, table)
    entries = np.empty(len(cells) + 1, np.int64)
    points = np.vstack([(cells + 0.5) * 0.25, [[9.0, 9.0, 9.0]]])
    entries_at(points, 0.25, table, keys, entries)
    assert entries.tolist() == [*range(len(cells)), -1]
