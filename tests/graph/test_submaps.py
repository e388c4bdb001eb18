"""Submaps: the neighbours by way and by number, in the place's own frame, and a cache that stays small."""

import numpy as np
import pytest
from flat_worlds import points_at, room

from slam.config.stages import LoopConfig, MatchConfig
from slam.graph.stretches import Stretches
from slam.graph.submaps import SubmapStore
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import compose, transform_points


def one_point(x: float, y: float) -> OrientedPoints:
    return OrientedPoints(np.array([[x, y]], dtype=np.float32), np.array([[1.0, 0.0]], dtype=np.float32))


def store_of(count: int, spacing_m: float = 1.0, **settings: object) -> SubmapStore:
    """Keyframes in a row along x, each of which sees one point, 5 m to its left."""
    store = SubmapStore(LoopConfig(**settings), MatchConfig())
    for n in range(count):
        store.add(one_point(0.0, 5.0), np.array([spacing_m * n, 0.0, 0.0]), spacing_m * n)
    return store


def seen_x(store: SubmapStore, key: int) -> list[float]:
    return store.submap(key).local_map.points.points[:, 0].tolist()


def test_the_neighbours_by_number() -> None:
    store = store_of(30, 0.1, half_keyframes=2)
    np.testing.assert_allclose(seen_x(store, 10), [-0.2, -0.1, 0.0, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(seen_x(store, 0), [0.0, 0.1, 0.2], atol=1e-6)
    np.testing.assert_allclose(seen_x(store, 29), [-0.2, -0.1, 0.0], atol=1e-6)


def test_the_neighbours_by_way() -> None:
    store = store_of(30, 1.0, half_keyframes=8, least_path_m=5.0)
    np.testing.assert_allclose(seen_x(store, 10), [-2.0, -1.0, 0.0, 1.0, 2.0], atol=1e-6)


def test_scans_far_apart_are_joined_over_a_longer_way() -> None:
    """Mean spacing over the way, the first metre of which has no keyframe behind it: 7.7 m."""
    store = store_of(30, 8.0)
    np.testing.assert_allclose(seen_x(store, 10), [-16.0, -8.0, 0.0, 8.0, 16.0], atol=1e-6)
    np.testing.assert_allclose(np.unique(store.run(10).points[:, 0]), [-8.0, 0.0, 8.0], atol=1e-6)


def test_surroundings_are_drawn_by_the_newest_estimate_and_few_are_kept() -> None:
    store = store_of(30, 0.5)
    for scale in (0.5, 0.6):
        store.lay(np.outer(scale * np.arange(30.0), [1.0, 0.0, 0.0]), [])
        around = store.surroundings(10).points.points[:, 0]
        np.testing.assert_allclose(np.ptp(around), 12.0 * scale, atol=1e-6)
        for key in range(20, 9, -1):
            store.surroundings(key)
        assert len(store._surroundings) == LoopConfig().near


def test_no_submap_is_drawn_across_an_unmeasured_step() -> None:
    """Three keyframes before such a step, or in a session, and three after it."""
    store = store_of(3)
    for n in range(3):
        store.add(one_point(0.0, 5.0), np.array([2.0 + n, 0.0, 0.0]), 2.0 + n, begun=n == 0)
    np.testing.assert_allclose(seen_x(store, 1), [-1.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(seen_x(store, 3), [0.0, 1.0, 2.0], atol=1e-6)


def test_a_submap_is_in_the_places_frame() -> None:
    """Three sweeps of a room from three poses, seen from the middle one: they draw the same walls."""
    store = SubmapStore(LoopConfig(), MatchConfig())
    start = np.array([80.0, -9.0, 2.0])  # odometry frame and room have nothing to do with each other
    poses = [np.array([0.0, 0.0, 0.0]), np.array([0.3, 0.1, 0.4]), np.array([0.5, -0.2, -0.3])]
    for n, pose in enumerate(poses):
        store.add(OrientedPoints.from_scan(points_at(room(), pose)), compose(start, pose), 0.3 * n)
    world = transform_points(store.submap(1).local_map.points.points, poses[1])
    assert len(world) > 900
    off_wall = np.abs(np.abs(world).max(axis=1) - 3.0)
    assert (off_wall < 1e-3).mean() > 0.6
    assert np.abs(world).max() < 3.001
    assert store.submap(1).field.levels[0].any()


def test_the_cache_is_bounded_and_keeps_what_was_used_last() -> None:
    store = store_of(60, half_keyframes=1, near=4)
    first = [store.submap(key) for key in range(4)]
    assert store.submap(0) is first[0]
    store.submap(4)  # 1 is now the one that was not used for longest
    assert len(store._cache) == 4
    assert store.submap(0) is first[0]
    assert store.submap(2) is first[2]
    assert store.submap(1) is not first[1]
    for key in range(60):
        store.submap(key)
        assert len(store._cache) <= 4


def test_surroundings_are_kept_of_a_few_places() -> None:
    store = store_of(60, spacing_m=6.0, near=1, half_keyframes=2)
    for key in range(60):
        surroundings = store.surroundings(key)
        assert store.surroundings(key) is surroundings
        assert store.field(key) is store.field(key)
    assert len(store._surroundings) == len(store._fields) == 5


def test_the_field_is_drawn_once() -> None:
    submap = store_of(3).submap(1)
    assert submap.field is submap.field


def test_what_was_added_comes_back() -> None:
    store = store_of(3, 2.0)
    assert store.travelled_m(2) == 4.0
    assert len(store.scan(2)) == 1
    with pytest.raises(IndexError):
        store.scan(3)


def test_what_is_seen_along_a_stretch_is_joined_where_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    joined, run, store = list[int](), SubmapStore.run, store_of(200)
    monkeypatch.setattr(SubmapStore, "run", lambda store, key: joined.append(key) or run(store, key))
    stretches = Stretches(store, LoopConfig(), MatchConfig())
    everywhere = np.ones(len(stretches.keys), np.bool_)
    for _ in range(2):
        assert not stretches.between(50.0, 70.0)  # nothing but a line of points
    assert not stretches.candidates(len(everywhere) - 1, ~everywhere, np.zeros(len(everywhere)))
    assert joined == sorted(set(joined)) and min(joined) >= 50 and max(joined) <= 70


def test_a_place_between_unmeasured_steps_has_its_own_scan() -> None:
    """Of surroundings only every few scans are used; this one alone may not be among them."""
    store = store_of(200, 0.05)
    for key in range(50, 60):
        store.lay([np.array([0.05 * n, 0.0, 0.0]) for n in range(200)], [key, key + 1])
        assert len(store.surroundings(key, own=True).points) == 1
