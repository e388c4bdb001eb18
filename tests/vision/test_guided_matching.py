"""Matching where features are expected."""

from __future__ import annotations

import numpy as np
import pytest

from slam.vision.features import Features
from slam.vision.guided_matching import match_near


def features(pixels: np.ndarray, descriptors: np.ndarray) -> Features:
    count = len(pixels)
    ones = np.ones(count, np.float32)
    return Features(pixels.astype(np.float32), descriptors, ones, ones)


@pytest.fixture
def scene() -> tuple[Features, np.ndarray, Features, np.ndarray]:
    """60 features, and the same in another order, each moved by (5, -3) and with a few bits changed."""
    rng = np.random.default_rng(1)
    pixels = rng.uniform(20.0, 300.0, (60, 2))
    descriptors = rng.integers(0, 256, (60, 32), np.uint8)
    order = rng.permutation(60)
    moved = descriptors[order].copy()
    moved[:, 0] ^= 0b101
    expected = pixels + np.array([5.0, -3.0])
    return features(pixels, descriptors), expected, features(expected[order], moved), order


def test_every_feature_is_found_where_it_is_expected(scene) -> None:  # type: ignore[no-untyped-def]
    known, expected, seen, order = scene
    pairs = match_near(known, expected, seen, 10.0, 0.8)
    assert len(pairs) == 60
    np.testing.assert_array_equal(order[pairs.second], pairs.first)


def test_nothing_is_found_elsewhere(scene) -> None:  # type: ignore[no-untyped-def]
    known, expected, seen, _ = scene
    pairs = match_near(known, expected + 2000.0, seen, 10.0, 0.8)
    assert len(pairs) == 0


def test_unexpected_features_are_left_out(scene) -> None:  # type: ignore[no-untyped-def]
    known, expected, seen, _ = scene
    expected[:10] = np.nan
    assert match_near(known, expected, seen, 10.0, 0.8).first.min() == 10


def test_descriptors_that_differ_too_much_do_not_match(scene) -> None:  # type: ignore[no-untyped-def]
    known, expected, seen, _ = scene
    assert len(match_near(known, expected, seen, 10.0, 0.8, 1)) == 0


def test_two_that_claim_one_feature_leave_it_to_the_nearer(scene) -> None:  # type: ignore[no-untyped-def]
    known, expected, seen, order = scene
    descriptors = known.descriptors.copy()
    descriptors[1] = descriptors[0]
    descriptors[1, 5] ^= 0b111
    twins = features(known.pixels, descriptors)
    expected[1] = expected[0]
    pairs = match_near(twins, expected, seen, 3.0, 0.8)
    claimed = int(np.flatnonzero(order == 0)[0])
    assert pairs.first[pairs.second == claimed].tolist() == [0]


def test_an_empty_image_gives_no_pairs(scene) -> None:  # type: ignore[no-untyped-def]
    known, expected, _, _ = scene
    none = features(np.zeros((0, 2)), np.zeros((0, 32), np.uint8))
    assert len(match_near(known, expected, none, 10.0, 0.8)) == 0


def test_the_pairs_are_those_of_looking_at_every_feature() -> None:
    rng = np.random.default_rng(4)
    known, seen = (
        features(rng.uniform(0.0, (320.0, 240.0), (400, 2)), rng.integers(0, 256, (400, 32), np.uint8))
        for _ in range(2)
    )
    expected = rng.uniform((-60.0, -60.0), (380.0, 300.0), (400, 2))
    found = match_near(known, expected, seen, 25.0, 0.95, 256)
    apart = np.hypot(*(expected.astype(np.float32)[:, None] - seen.pixels).transpose(2, 0, 1))
    bits = np.unpackbits(known.descriptors[:, None] ^ seen.descriptors, axis=2).sum(axis=2, dtype=np.int64)
    bits[apart > 25.0] = 257
    best, second = np.sort(bits, axis=1)[:, :2].T
    good = (best < 257) & (best < 0.95 * second)
    nearest = np.argmin(bits, axis=1)
    wanted = {}
    for i in np.flatnonzero(good):
        other = wanted.get(nearest[i])
        if other is None or best[i] < best[other]:
            wanted[nearest[i]] = i
    assert len(wanted) > 50
    assert {(int(a), int(b)) for b, a in wanted.items()} == {
        (int(a), int(b)) for a, b in zip(found.first, found.second, strict=True)
    }
