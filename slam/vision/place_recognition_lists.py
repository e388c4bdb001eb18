"""The inverted file: for each word its descriptors, keyframe after keyframe.

A list is a chain of blocks, newest first; all blocks are in arrays that double when full.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import FloatArray
from slam.vision.place_recognition_vocabulary import BitRows, Words, ones

_Entry = TypeVar("_Entry", bound=np.generic)

# Two descriptors of one point differ in fewer bits than this; nearer ones count more.
_SAME_BITS = 50


class WordLists:
    """Descriptors of keyframes by word."""

    def __init__(self, words: int) -> None:
        self.keys = 0
        block = 64
        self._heads = np.full(words, -1, dtype=np.int32)
        self._fills = np.full(words, block, dtype=np.int32)
        self._blocks = 0
        self._nexts = np.empty(block, dtype=np.int32)
        self._owners = np.empty((block, block), dtype=np.int32)
        self._rows = np.empty((block, block, 4), dtype=np.uint64)

    def append(self, words: Words, rows: BitRows) -> None:
        """Add the next keyframe: (N,) words of (N, 4) descriptors."""
        needed = self._blocks + len(words)
        if needed > len(self._nexts):
            size = max(needed, 2 * len(self._nexts))
            self._nexts = _longer(self._nexts, size)
            self._owners = _longer(self._owners, size)
            self._rows = _longer(self._rows, size)
        file = (self._heads, self._fills, self._nexts, self._owners, self._rows)
        self._blocks = _append(words, rows, self.keys, self._blocks, *file)
        self.keys += 1

    def everything(self) -> tuple[Words, BitRows]:
        """Return (N,) keys, ascending, and (N, 4) descriptors."""
        block = self._owners.shape[1]
        used = np.ones((self._blocks, block), dtype=np.bool_)
        opened = self._heads >= 0
        used[self._heads[opened]] = np.arange(block) < self._fills[opened, None]
        keys, rows = self._owners[: self._blocks][used], self._rows[: self._blocks][used]
        order = np.argsort(keys, kind="stable")
        return keys[order], rows[order]

    def scores(self, words: Words, rows: BitRows) -> FloatArray:
        """Return (K,) keyframe scores: mean nearness of (N, 4) descriptors to the nearest of their word."""
        file = (self._heads, self._fills, self._nexts, self._owners, self._rows)
        # The last contribution to a keyframe's score, and its descriptor.
        scores, best, best_row = np.zeros(self.keys), np.zeros(self.keys), np.full(self.keys, -1)
        _add_scores(words, rows, *file, scores, best, best_row)
        return scores / max(len(words), 1)


def _longer(array: NDArray[_Entry], length: int) -> NDArray[_Entry]:
    """Return the array extended to `length` rows."""
    grown = np.empty((length, *array.shape[1:]), dtype=array.dtype)
    grown[: len(array)] = array
    return grown


@kernel
def _append(
    words: Words,
    rows: BitRows,
    key: int,
    blocks: int,
    heads: Words,
    fills: Words,
    nexts: Words,
    owners: Words,
    entries: BitRows,
) -> int:
    """Append to the block of each word, or to a new block if that is full; return the blocks used."""
    for i in range(words.size):
        word = words[i]
        if fills[word] == owners.shape[1]:
            nexts[blocks] = heads[word]
            heads[word], fills[word] = blocks, 0
            blocks += 1
        place = fills[word]
        owners[heads[word], place] = key
        for part in range(4):
            entries[heads[word], place, part] = rows[i, part]
        fills[word] += 1
    return blocks


@kernel
def _add_scores(words, rows, heads, fills, nexts, owners, entries, scores, best, best_row):  # type: ignore[no-untyped-def]
    """Search the list of each descriptor's word; only the nearest entry of a keyframe counts."""
    for i in range(words.size):
        a, b, c, d = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
        block = heads[words[i]]
        fill = fills[words[i]]
        while block >= 0:
            for place in range(fill):
                bits = ones(a ^ entries[block, place, 0]) + ones(b ^ entries[block, place, 1])
                bits += ones(c ^ entries[block, place, 2]) + ones(d ^ entries[block, place, 3])
                if bits < _SAME_BITS:
                    owner = owners[block, place]
                    nearness = 1.0 - bits / _SAME_BITS
                    known = best[owner] if best_row[owner] == i else 0.0
                    if nearness > known:
                        scores[owner] += nearness - known
                        best[owner] = nearness
                        best_row[owner] = i
            block = nexts[block]
            fill = np.int32(owners.shape[1])
