"""Place recognition on synthetic places: sets of descriptors, seen in part and with flipped bits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.vision.place_recognition import PlaceIndex
from slam.vision.place_recognition_lists import WordLists
from slam.vision.place_recognition_vocabulary import Descriptors, bit_rows, nearest_rows, train_vocabulary

PLACES = 60
SEEN = 300


def flipped(descriptors: Descriptors, bits: int, rng: np.random.Generator) -> Descriptors:
    """Each row with so many different bits flipped."""
    own = np.unpackbits(descriptors, axis=1)
    columns = rng.permuted(np.tile(np.arange(256), (len(own), 1)), axis=1)[:, :bits]
    np.put_along_axis(own, columns, 1 - np.take_along_axis(own, columns, axis=1), axis=1)
    return np.packbits(own, axis=1)


KINDS = np.random.default_rng(0).integers(0, 256, (150, 32), dtype=np.uint8)


def place(number: int) -> Descriptors:
    """Corners come in kinds; two of one kind differ in some 60 bits."""
    rng = np.random.default_rng([7, number])
    return flipped(KINDS[rng.integers(0, len(KINDS), SEEN)], 34, rng)


def visit(number: int, seed: int, bits: int = 10) -> Descriptors:
    """Two thirds of a place, as many others, and features of the next place: neighbours overlap."""
    rng = np.random.default_rng([seed, number])
    own = flipped(place(number)[rng.permutation(SEEN)[:200]], bits, rng)
    ahead = flipped(place(number + 1)[rng.permutation(SEEN)[:60]], bits, rng)
    return np.concatenate([own, ahead, flipped(KINDS[rng.integers(0, len(KINDS), 100)], 34, rng)])


def walked(seed: int = 0, training_keyframes: int = 20) -> PlaceIndex:
    index = PlaceIndex(seed, training_keyframes=training_keyframes)
    assert [index.add(visit(number, seed=1)) for number in range(PLACES)] == list(range(PLACES))
    return index


@pytest.mark.parametrize("training_keyframes", [10, 20, 1000])
def test_every_place_is_found_again_before_and_after_training(training_keyframes: int) -> None:
    index = walked(training_keyframes=training_keyframes)
    for number in range(PLACES):
        first, *others = index.query(visit(number, seed=2), exclude_from=PLACES, best=3)
        assert first.key == number
        assert all(other.score < 0.3 * first.score for other in others)


def strangers(seed: int) -> Descriptors:
    return np.random.default_rng([8, seed]).integers(0, 256, (200, 32), dtype=np.uint8)


def test_all_descriptors_compared_give_the_score_by_hand() -> None:
    index = PlaceIndex(0, training_keyframes=1000)
    rng = np.random.default_rng(0)
    index.add(strangers(0))
    index.add(np.concatenate([flipped(strangers(0), 10, rng), flipped(strangers(0), 30, rng)]))
    # Random rows: no two are near by chance. Half of the query is not there.
    (same,) = index.query(np.concatenate([strangers(0), strangers(1)]), exclude_from=1, best=5)
    assert (same.key, same.score) == (0, pytest.approx(0.5))
    # Of the next keyframe 10 bits of 50 differ; the farther copy of each descriptor adds nothing.
    assert same.relative_score == pytest.approx(1.0 / 0.8)


def test_the_same_image_again_scores_one() -> None:
    index = walked()
    (match, *_) = index.query(visit(33, seed=1), exclude_from=PLACES, best=1)
    assert (match.key, match.score) == (33, pytest.approx(1.0))


def test_recent_keyframes_are_left_out_and_serve_as_the_measure() -> None:
    index = walked()
    again = index.query(visit(PLACES - 1, seed=3), exclude_from=PLACES - 10, best=5)
    assert all(match.key < PLACES - 10 for match in again)
    assert all(match.relative_score < 0.2 for match in again)
    # The query sees place 5 as well as the last keyframe sees its own: as alike as a neighbour.
    both = np.concatenate([visit(PLACES - 1, seed=3), visit(5, seed=3)])
    (match,) = index.query(both, exclude_from=PLACES - 10, best=1)
    assert match.key == 5 and match.relative_score == pytest.approx(1.0, abs=0.25)
    (alone,) = index.query(visit(5, seed=3), exclude_from=PLACES, best=1)
    assert math.isnan(alone.relative_score)


def test_another_scene_is_refused() -> None:
    index = walked()
    strangers = [index.query(visit(1000 + number, seed=2), PLACES, 1) for number in range(20)]
    own = [index.query(visit(number, seed=2), PLACES, 1)[0].score for number in range(20)]
    assert max((match[0].score for match in strangers if match), default=0.0) < 0.1 * min(own)


def test_neighbouring_candidates_are_one_place() -> None:
    index = PlaceIndex(0, training_keyframes=12, group=3)
    for key, number in enumerate([0, 1, 2, 2, 2, 3, 4, 5, 6, 7, 8, 9, 10, 2, 11]):
        index.add(visit(number, seed=key))
    first, second = (match.key for match in index.query(visit(2, seed=99), exclude_from=15, best=2))
    assert 13 in (first, second)
    assert {first, second} & {2, 3, 4}


def test_images_without_features_are_kept_in_count_and_never_found() -> None:
    nothing = np.empty((0, 32), dtype=np.uint8)
    index = PlaceIndex(0, training_keyframes=4)
    assert index.query(place(0), 0, 5) == []
    for key in range(6):
        assert index.add(nothing if key % 2 else place(key)) == key
    assert index.query(nothing, 6, 5) == []
    assert [match.key for match in index.query(place(4), 6, 5)] == [4]
    empty = PlaceIndex(0, training_keyframes=2)
    assert [empty.add(nothing) for _ in range(5)] == [0, 1, 2, 3, 4]
    assert empty.query(place(0), 5, 5) == []


def test_the_same_seed_gives_the_same_answers() -> None:
    one, two = walked(seed=4), walked(seed=4)
    for number in range(0, PLACES, 7):
        first, second = (index.query(visit(number, 2), 50, 5) for index in (one, two))
        assert first and [(m.key, m.score) for m in first] == [(m.key, m.score) for m in second]


def test_lists_give_back_what_they_took_over_many_blocks() -> None:
    rng = np.random.default_rng(0)
    lists = WordLists(5)
    taken = [bit_rows(rng.integers(0, 256, (n, 32), dtype=np.uint8)) for n in (400, 0, 3, 900)]
    for rows in taken:
        lists.append(rng.integers(0, 4, len(rows)).astype(np.int32), rows)
    keys, rows = lists.everything()
    for key, own in enumerate(taken):
        assert sorted(map(tuple, rows[keys == key])) == sorted(map(tuple, own))
    assert np.all(np.diff(keys) >= 0)


def test_a_word_is_the_nearest_centre_and_a_centre_the_majority() -> None:
    # Four clumps far apart, four branches: each centre is its clump's middle, as few flip a bit.
    rng = np.random.default_rng(1)
    middles = rng.integers(0, 256, (4, 32), dtype=np.uint8)
    members = np.concatenate([flipped(np.repeat(middles[i : i + 1], 100, axis=0), 12, rng) for i in range(4)])
    one_each = [
        train_vocabulary(bit_rows(members), branching=4, rng=np.random.default_rng(seed)).branches
        for seed in range(6)
    ]
    found = [np.isin(bit_rows(middles)[:, 0], branches[:, 0]).sum() for branches in one_each]
    assert max(found) == 4
    index, distance = nearest_rows(bit_rows(flipped(middles, 9, rng)), bit_rows(middles))
    np.testing.assert_array_equal(index, [0, 1, 2, 3])
    np.testing.assert_array_equal(distance, 9)


def test_the_word_is_nearly_always_the_nearest_of_all() -> None:
    rows = bit_rows(np.concatenate([place(number) for number in range(10)]))
    vocabulary = train_vocabulary(rows, branching=16, rng=np.random.default_rng(0))
    assert vocabulary.size == vocabulary.starts[-1] <= 256
    assert np.mean(vocabulary.words(rows) == nearest_rows(rows, vocabulary.leaves)[0]) > 0.95
