"""ORB features with depth: what a rim and a speck are given, and which descriptors are a pair."""

from __future__ import annotations

import numpy as np
import pytest
from room_world import MIDDLE, SMALL, blind, furnished, in_world, looking, off_surfaces, prepared, render

from slam.vision.features import (
    _KEPT,
    _MOST_KEPT,
    Matches,
    depth_at,
    extract_features,
    gray_of,
    match_features,
)


def around(values: list[list[float]]) -> np.ndarray:
    """A depth image of 5 x 5 whose middle 3 x 3 is given."""
    depth = np.zeros((5, 5), np.float32)
    depth[1:4, 1:4] = values
    return depth


MIDDLE_PIXEL = np.array([[2.0, 2.0]], np.float32)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([[2, 2, 2], [2, 2, 2], [2, 2, 2]], 2.0),
        ([[2, 2.03, 2.06], [2, 2.03, 2.06], [2, 2.03, 2.06]], 2.03),
        ([[1, 1, 3], [1, 3, 3], [3, 3, 3]], 1.0),  # a rim: the nearer side
        ([[1, 3, 3], [1, 3, 3], [0, 3, 3]], 0.0),  # two specks are no surface, and what lies behind is hidden
        ([[0, 0, 0], [0, 2, 2], [0, 2, 0]], 2.0),  # holes do not pull
        ([[0, 0, 0], [0, 2, 0], [0, 0, 0]], 0.0),
        ([[0, 0, 0], [0, 0, 0], [0, 0, 0]], 0.0),
    ],
)
def test_depth_at_a_pixel(values: list[list[float]], expected: float) -> None:
    np.testing.assert_allclose(depth_at(around(values), MIDDLE_PIXEL), [expected], atol=1e-6)


def test_depth_at_the_border_stays_in_the_image() -> None:
    depth = np.full((4, 6), 1.5, np.float32)
    corners = np.array([[0.0, 0.0], [5.4, 3.4], [-0.4, 3.0]], np.float32)
    np.testing.assert_allclose(depth_at(depth, corners), 1.5)
    assert depth_at(depth, np.zeros((0, 2), np.float32)).shape == (0,)


def test_features_lie_on_the_surfaces_they_show() -> None:
    """Every point lies on a wall, the floor or a cupboard."""
    room = furnished()
    pose = looking(0.2, -0.1, 1.3, 0.4, 0.1)
    frame = render(room, pose, MIDDLE)
    features = extract_features(gray_of(frame), frame.depth_m, 500)
    assert 300 < len(features) <= 500
    known = features.where(features.depth_m > 0.0)
    assert len(known) > 0.95 * len(features)
    off_m = off_surfaces(room, in_world(known.points_camera(MIDDLE), pose))
    assert np.median(off_m) < 0.003
    assert np.quantile(off_m, 0.9) < 0.02
    assert set(np.round(np.log(features.sigma_px) / np.log(1.2), 3)) <= set(range(8))


def test_no_depth_means_a_point_at_the_camera() -> None:
    frame = render(furnished(), looking(0, 0, 1.3, 0.4))
    features = extract_features(gray_of(frame), np.zeros_like(frame.depth_m), 100)
    assert len(features) > 20
    assert not features.points_camera(SMALL).any()


def test_a_black_image_has_no_features() -> None:
    frame = blind(render(furnished(), looking(0, 0, 1.3, 0.0)))
    features = extract_features(gray_of(frame), frame.depth_m, 100)
    assert len(features) == 0
    assert features.descriptors.shape == (0, 32)
    assert features.points_camera(SMALL).shape == (0, 3)


def rows(*ones: int) -> np.ndarray:
    """Descriptors that begin with so many ones: their distance is the difference of the counts."""
    bits = np.zeros((len(ones), 256), np.uint8)
    for row, count in zip(bits, ones, strict=True):
        row[:count] = 1
    return np.packbits(bits, axis=1)


def pairs(matches: Matches) -> list[tuple[int, int]]:
    return list(zip(matches.first.tolist(), matches.second.tolist(), strict=True))


@pytest.mark.parametrize(
    ("first", "second", "ratio", "bits", "expected"),
    [
        ((0, 100), (102, 3), 0.8, 64, [(0, 1), (1, 0)]),
        ((0, 100), (102, 3), 0.8, 2, [(1, 0)]),  # too far
        ((0, 100), (102, 3, 104), 0.8, 64, [(0, 1), (1, 0)]),
        ((0, 100), (102, 3, 102), 0.8, 64, [(0, 1)]),  # two as near: it shows nothing
        ((0, 100), (102, 3, 104), 0.4, 64, [(0, 1)]),
        ((0, 2, 100), (3, 104), 0.8, 64, [(1, 0), (2, 1)]),  # two want the same: the nearer has it
    ],
)
def test_ratio_and_cross_check(
    first: tuple[int, ...],
    second: tuple[int, ...],
    ratio: float,
    bits: int,
    expected: list[tuple[int, int]],
) -> None:
    assert pairs(match_features(rows(*first), rows(*second), ratio, bits)) == expected


def test_a_pair_is_the_nearest_of_both_sides() -> None:
    """The first's nearest is taken by another, which is nearer to it but has a still nearer one itself."""
    first, second = rows(0, 20), rows(15, 20, 200)
    # 0 -> 15 (distance 15, next 20), but 15's nearest is 20 (distance 5), whose own nearest is 20.
    assert pairs(match_features(first, second, 0.8)) == [(1, 1)]


@pytest.mark.parametrize(("first", "second"), [((), (1, 2)), ((1, 2), ()), ((1,), (1, 2)), ((1, 2), (1,))])
def test_too_few_to_compare(first: tuple[int, ...], second: tuple[int, ...]) -> None:
    assert len(match_features(rows(*first), rows(*second), 0.8)) == 0


def test_matched_features_see_the_same_point() -> None:
    one, other = looking(0, 0, 1.3, 0.3), looking(0.08, -0.05, 1.33, 0.36, 0.03)
    seen = [prepared(render(furnished(), pose, MIDDLE)).features for pose in (one, other)]
    matches = match_features(seen[0].descriptors, seen[1].descriptors, 0.8)
    assert len(matches) > 150
    in_room = [
        in_world(features.points_camera(MIDDLE), pose)
        for features, pose in zip(seen, (one, other), strict=True)
    ]
    apart = np.linalg.norm(in_room[0][matches.first] - in_room[1][matches.second], axis=1)
    assert np.mean(apart < 0.05) > 0.9


def test_an_image_that_is_asked_for_again_gives_the_same_keypoints_with_the_depth_of_then() -> None:
    _KEPT.clear()
    frame = render(furnished(), looking(2.0, 1.8, 1.2, 0.5), SMALL)
    plain = extract_features(gray_of(frame), frame.depth_m, 500)
    kept = extract_features(gray_of(frame), 2.0 * frame.depth_m, 500, again=True)
    assert len(_KEPT) == 1
    again = extract_features(gray_of(frame), frame.depth_m, 500)
    assert not _KEPT
    for one, other in ((plain, kept), (plain, again)):
        np.testing.assert_array_equal(one.pixels, other.pixels)
        np.testing.assert_array_equal(one.descriptors, other.descriptors)
        np.testing.assert_array_equal(one.sigma_px, other.sigma_px)
    np.testing.assert_array_equal(again.depth_m, plain.depth_m)
    np.testing.assert_allclose(kept.depth_m, 2.0 * plain.depth_m)
    extract_features(gray_of(frame), frame.depth_m, 400, again=True)
    assert len(extract_features(gray_of(frame), frame.depth_m, 500)) == len(plain)
    assert len(_KEPT) == 1
    extract_features(gray_of(frame), frame.depth_m, 400)


def test_what_nobody_asks_for_again_makes_room() -> None:
    depth_m = np.zeros((80, 80), np.float32)
    for shade in range(200):
        extract_features(np.full((80, 80), shade, np.uint8), depth_m, 10, again=True)
    for count in range(10, 10 + _MOST_KEPT // 8):
        for shade in range(10):
            extract_features(np.full((80, 80), shade, np.uint8), depth_m, count, again=True)
    assert len(_KEPT) == _MOST_KEPT
    _KEPT.clear()
