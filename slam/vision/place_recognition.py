"""Place recognition: which earlier keyframes show the same place, by an inverted file of ORB descriptors.

A vocabulary from the log itself only selects which descriptors to compare; the score is their Hamming
distance, as in Hamming embedding (Jegou et al. 2008). Plain words (tf-idf) need a vocabulary that has seen
the place: with one from the first 20 of 100 keyframes they rank views much worse. Normalisation by the
neighbouring keyframe and grouping: Galvez-Lopez and Tardos (2012), Eq. (2), section V-B.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.measurements import FloatArray
from slam.vision.place_recognition_lists import WordLists
from slam.vision.place_recognition_vocabulary import (
    BinaryVocabulary,
    BitRows,
    Descriptors,
    Words,
    bit_rows,
    train_vocabulary,
)

# 32 branches with 32 words each: a descriptor is compared with about 1/1000 of the others.
_BRANCHING = 32
_TRAINING_DESCRIPTORS = 40000
# The vocabulary is retrained when the keyframes have grown by this factor: new places need new words, and few
# words for many descriptors make long lists.
_RETRAINING = 8


@dataclass(frozen=True, slots=True)
class PlaceMatch:
    """A keyframe that may show the same place.

    Attributes
    ----------
    key
        Key from `PlaceIndex.add`.
    score
        0..1, mean nearness of the query's descriptors to similar ones in the keyframe: 1 for the same image,
        0.01 to 0.1 for the same place from elsewhere, up to 0.04 for another place: only geometry decides.
    relative_score
        The score over that of the keyframes just before the query, which certainly show the same place. NaN
        if no keyframe was excluded, or the neighbours have nothing in common with the query.
    """

    key: int
    score: float
    relative_score: float


class PlaceIndex:
    """Keyframes by their descriptors; about 36 kB per thousand descriptors.

    Parameters
    ----------
    training_keyframes
        The vocabulary is trained at this number, and again at each factor of eight; before, all descriptors
        are compared.
    queried, kept
        Number of descriptors used of a query, and of a keyframe, evenly sampled.
    group
        Candidates at most so many keys apart are one place; the best is reported.
    """

    def __init__(
        self, seed: int, training_keyframes: int = 20, queried: int = 400, kept: int = 1000, group: int = 3
    ) -> None:
        self._rng = np.random.default_rng(seed)
        self._next_training = training_keyframes
        self._queried, self._features_kept, self._group = queried, kept, group
        self._vocabulary: BinaryVocabulary | None = None
        self._lists = WordLists(1)

    def __len__(self) -> int:
        return self._lists.keys

    def add(self, descriptors: Descriptors) -> int:
        """Add a keyframe's (N, 32) descriptors, N may be 0; return its key: 0, 1, 2, ..."""
        key = self._lists.keys
        own = _spread(descriptors, self._features_kept)
        self._lists.append(self._words(own), own)
        if len(self) >= self._next_training:
            self._train()
        return key

    def query(self, descriptors: Descriptors, exclude_from: int, best: int) -> list[PlaceMatch]:
        """Return keyframes with key below `exclude_from` similar to these descriptors, best first.

        Parameters
        ----------
        descriptors
            (N, 32) of a keyframe that is not yet added, so that the last key is its neighbour.
        exclude_from
            Keys from here on are too recent to be a loop.
        """
        own = _spread(descriptors, self._queried)
        eligible = min(max(exclude_from, 0), len(self))
        if eligible == 0 or len(own) == 0:
            return []
        scores = self._lists.scores(self._words(own), own)
        neighbours = scores[max(eligible, len(scores) - self._group) :]
        expected = float(neighbours.max()) if neighbours.size else 0.0
        return [
            PlaceMatch(
                key=int(key),
                score=float(scores[key]),
                relative_score=float(scores[key]) / expected if expected > 0.0 else float("nan"),
            )
            for key in _places(scores[:eligible], self._group)[:best]
        ]

    def _words(self, rows: BitRows) -> Words:
        """Return the words of descriptors; before there is a vocabulary, all are one word."""
        if self._vocabulary is None:
            return np.zeros(len(rows), dtype=np.int32)
        return self._vocabulary.words(rows)

    def _train(self) -> None:
        """Train words on a sample of the descriptors so far, and rebuild the lists."""
        self._next_training *= _RETRAINING
        keys, rows = self._lists.everything()
        if len(rows) < _BRANCHING:
            return
        sample = np.sort(self._rng.permutation(len(rows))[:_TRAINING_DESCRIPTORS])
        self._vocabulary = train_vocabulary(rows[sample], _BRANCHING, self._rng)
        ends = np.cumsum(np.bincount(keys, minlength=len(self)))
        self._lists = WordLists(self._vocabulary.size)
        for own in np.split(rows, ends[:-1]):
            self._lists.append(self._vocabulary.words(own), own)


def _spread(descriptors: Descriptors, count: int) -> BitRows:
    """Return (n, 4) at most `count` of (N, 32), evenly sampled: ORB sorts them by level."""
    rows = bit_rows(np.asarray(descriptors, dtype=np.uint8).reshape(-1, 32))
    if len(rows) <= count:
        return rows
    return rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]


def _places(scores: FloatArray, group: int) -> Words:
    """Return keys that are the best within `group` keys on either side, best first."""
    padded = np.pad(scores, group)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * group + 1)
    peaks = np.flatnonzero((scores >= windows.max(axis=1)) & (scores > 0.0))
    return np.asarray(peaks[np.argsort(-scores[peaks], kind="stable")], dtype=np.int32)
