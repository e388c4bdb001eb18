"""Vocabulary of binary descriptors, trained from the log itself: k-majority in two levels.

Grana et al., A fast approach for integrating ORB descriptors in the bag of words model (2013): the centre of
a cluster has each bit as most of its members have it. Two levels, as the tree of Galvez-Lopez and Tardos
(2012).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import ROUNDS
from fusion.kernel import kernel

Descriptors: TypeAlias = NDArray[np.uint8]
Words: TypeAlias = NDArray[np.int32]
BitRows: TypeAlias = NDArray[np.uint64]

# A descriptor near the border of two branches may have its word in either.
_PROBES = 2


@dataclass(frozen=True, slots=True)
class BinaryVocabulary:
    """Words in a two-level tree.

    Attributes
    ----------
    branches
        (B, 4) centres of the branches, 256 bits each.
    leaves
        (W, 4) the words, branch by branch.
    starts
        (B + 1,) the words of branch b are starts[b] to starts[b + 1].
    """

    branches: BitRows
    leaves: BitRows
    starts: Words

    @property
    def size(self) -> int:
        """Return the number of words."""
        return len(self.leaves)

    def words(self, rows: BitRows) -> Words:
        """Return (N,) the word of each of (N, 4) descriptors: the nearest in the two nearest branches."""
        return _words(rows, self.branches, self.leaves, self.starts)


def bit_rows(descriptors: Descriptors) -> BitRows:
    """Return an (N, 4) view of (N, 32) descriptors, copied only if they are not contiguous."""
    return np.ascontiguousarray(descriptors).view(np.uint64)


def train_vocabulary(rows: BitRows, branching: int, rng: np.random.Generator) -> BinaryVocabulary:
    """Train up to branching squared words from (N, 4) descriptors, N > 0; `rng` selects initial centres."""
    rows = np.unique(rows, axis=0)
    branches, branch = _k_majority(rows, min(branching, len(rows)), rng)
    leaves = []
    for number in range(len(branches)):
        members = rows[branch == number]
        leaves.append(_k_majority(members, min(branching, len(members)), rng)[0])
    starts = np.cumsum([0, *(len(own) for own in leaves)]).astype(np.int32)
    return BinaryVocabulary(branches, np.concatenate(leaves), starts)


def _k_majority(rows: BitRows, count: int, rng: np.random.Generator) -> tuple[BitRows, Words]:
    """Return the centres and the nearest centre of each row."""
    centres = rows[rng.permutation(len(rows))[:count]]
    nearest = nearest_rows(rows, centres)[0]
    for _ in range(ROUNDS):
        _majority(rows, nearest, centres)
        before, (nearest, _) = nearest, nearest_rows(rows, centres)
        if np.array_equal(before, nearest):
            break
    return centres, nearest


@kernel
def nearest_rows(rows: BitRows, centres: BitRows) -> tuple[Words, Words]:
    """Return (N,) index and Hamming distance of the nearest centre of each row."""
    index, distance = np.zeros(len(rows), np.int32), np.zeros(len(rows), np.int32)
    for i in range(len(rows)):
        index[i], distance[i] = _nearest(rows[i], centres, 0, len(centres), -1)
    return index, distance


@kernel
def _words(rows: BitRows, branches: BitRows, leaves: BitRows, starts: Words) -> Words:
    """Descend the tree with `_PROBES` probes."""
    words = np.zeros(len(rows), np.int32)
    for i in range(len(rows)):
        best, skipped = 64 * rows.shape[1] + 1, -1
        for _ in range(_PROBES):
            branch, _ = _nearest(rows[i], branches, 0, len(branches), skipped)
            word, distance = _nearest(rows[i], leaves, starts[branch], starts[branch + 1], -1)
            if distance < best:
                words[i], best = word, distance
            skipped = branch
    return words


@kernel
def _nearest(row: BitRows, centres: BitRows, start: int, stop: int, skipped: int) -> tuple[int, int]:
    """Return index and distance of the nearest centre in [start, stop); the first of equals."""
    best, index = 64 * row.size + 1, start
    for j in range(start, stop):
        distance = _hamming(row, centres[j])
        if distance < best and j != skipped:
            best, index = distance, j
    return index, best


@kernel
def _hamming(a: BitRows, b: BitRows) -> int:
    """Return the number of different bits of two rows of four 64-bit words."""
    return ones(a[0] ^ b[0]) + ones(a[1] ^ b[1]) + ones(a[2] ^ b[2]) + ones(a[3] ^ b[3])


@kernel
def ones(x: np.uint64) -> int:
    """Return the number of set bits; this compiles to one instruction."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    count: int = np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))  # type: ignore[assignment]
    return count


@kernel
def _majority(rows: BitRows, nearest: Words, centres: BitRows) -> None:
    """Set each bit of a centre to the majority of its members, in place; without members it stays."""
    set_bits = np.zeros((len(centres), 64 * centres.shape[1]), np.int32)
    members = np.zeros(len(centres), np.int32)
    for i in range(len(rows)):
        members[nearest[i]] += 1
        for part in range(4):
            for bit in range(64):
                set_bits[nearest[i], 64 * part + bit] += np.int32(
                    (rows[i, part] >> np.uint64(bit)) & np.uint64(1)
                )
    for j in range(len(centres)):
        if members[j] == 0:
            continue
        for part in range(4):
            value = np.uint64(0)
            for bit in range(64):
                if 2 * set_bits[j, 64 * part + bit] > members[j]:
                    value |= np.uint64(1) << np.uint64(bit)
            centres[j, part] = value
