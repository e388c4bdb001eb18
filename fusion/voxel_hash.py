"""A voxel hash table: slots contain indices of entries, -1 for an empty slot."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ZERO, kernel

# A key consists of three axes, and a level in the upper bits.
AXIS_BITS = 20
HALF, AXIS = 1 << AXIS_BITS - 1, (1 << AXIS_BITS) - 1
# 2^64 over the golden ratio, as a signed number: Knuth 1998, "The Art of Computer Programming", section 6.4.
_GOLDEN = -7046029254386353131


def table_for(count: int) -> NDArray[np.int32]:
    """Empty slots for ``count`` entries: a power of two, of which at least half remain empty."""
    return np.full(1 << max(2 * count - 1, 1).bit_length(), -1, np.int32)


@kernel(inline="always")
def key_of_cell(column, row, layer):  # type: ignore[no-untyped-def]
    """The key of a voxel by its position; it repeats after 2^20 voxels."""
    return (
        ((column + HALF & AXIS) << 2 * AXIS_BITS) | ((row + HALF & AXIS) << AXIS_BITS) | (layer + HALF & AXIS)
    )


@kernel(inline="always")
def key_of(x, y, z, size_m):  # type: ignore[no-untyped-def]
    """The key of the voxel of a point."""
    return key_of_cell(math.floor(x / size_m), math.floor(y / size_m), math.floor(z / size_m))


@kernel(inline="always")
def slot_of(key, table, keys):  # type: ignore[no-untyped-def]
    """The slot of a key; an empty one if it has no entry."""
    mask = table.shape[0] - 1
    slot = (key * _GOLDEN >> 32) & mask
    while table[slot] >= 0 and keys[table[slot]] != key:
        slot = (slot + 1) & mask
    return slot


@kernel(inline="always")
def entry_of(key, table, keys):  # type: ignore[no-untyped-def]
    """The index of a key's entry; -1 if there is none."""
    return np.int64(table[slot_of(key, table, keys)])


@kernel
def index_keys(keys, table):  # type: ignore[no-untyped-def]
    """Insert the indices of distinct keys (V,) into empty slots."""
    for i in range(keys.shape[0]):
        table[slot_of(keys[i], table, keys)] = i


@kernel(nogil=True)
def entries_at(points, size_m, table, keys, entries):  # type: ignore[no-untyped-def]
    """Write indices (N,) of the entries of the voxels of points (N, 3); -1 if there is none."""
    for i in range(points.shape[0]):
        entries[i] = entry_of(key_of(points[i, 0], points[i, 1], points[i, 2], size_m), table, keys)


@kernel(nogil=True)
def first_in_voxels(points, size_m, step, table, keys, first):  # type: ignore[no-untyped-def]
    """Write the index of the first point (N, 3) of each voxel into ``first`` (N,); return their number.

    Parameters
    ----------
    step
        Stride between visited points, cyclic; coprime to N.
    table, keys
        Empty slots for N entries, and a buffer (N,) for their keys.
    """
    count = i = ZERO
    for _ in range(points.shape[0]):
        key = key_of(points[i, 0], points[i, 1], points[i, 2], size_m)
        slot = slot_of(key, table, keys)
        if table[slot] < 0:
            table[slot] = count
            keys[count] = key
            first[count] = i
            count += 1
        i += step
        if i >= points.shape[0]:
            i -= points.shape[0]
    return count
