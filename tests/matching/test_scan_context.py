"""Scan contexts: the same however the robot is turned, unlike elsewhere; and the planes that add up."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_world import base, look

from slam.config.clouds import CloudOdometryConfig
from slam.matching.cloud_points import base_points
from slam.matching.plane_voxels import PlaneVoxels
from slam.matching.scan_context import SECTORS, ContextBank, dissimilarity, ring_key, scan_context
from slam.measurements import Float32Array, FloatArray

VOXEL_M = 0.1


def points_at(x: float, y: float, yaw: float, seed: int = 0) -> FloatArray:
    return base_points(look(base(x, y, yaw), seed=seed), np.zeros(6), CloudOdometryConfig())


def context_at(x: float, y: float, yaw: float, seed: int = 0) -> Float32Array:
    return scan_context(points_at(x, y, yaw, seed), VOXEL_M)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0, 3.0])
def test_a_turn_is_found(yaw: float) -> None:
    found, turn = dissimilarity(context_at(0.5, 0.5, 0.2), context_at(0.5, 0.5, 0.2 + yaw, seed=1))
    assert found < 0.2
    assert abs(np.angle(np.exp(1j * (turn - yaw)))) < np.radians(6.5)


def test_another_place_looks_less_alike() -> None:
    here, there = context_at(0.5, 0.5, 0.0), context_at(-4.0, -3.0, 0.0)
    again = context_at(0.6, 0.5, 1.0, seed=1)
    assert dissimilarity(here, again)[0] < 0.5 * dissimilarity(here, there)[0]
    keys = [ring_key(context) for context in (here, again, there)]
    assert np.linalg.norm(keys[0] - keys[1]) < np.linalg.norm(keys[0] - keys[2])


def test_nothing_looks_like_nothing() -> None:
    empty = scan_context(np.zeros((0, 3)), VOXEL_M)
    assert not empty.any()
    assert dissimilarity(empty, empty)[0] == 1.0
    assert dissimilarity(context_at(0.5, 0.5, 0.0), empty)[0] == 1.0


def test_a_bank_shows_what_the_pairs_show() -> None:
    empty = scan_context(np.zeros((0, 3)), VOXEL_M)
    contexts = [context_at(0.5, 0.5, 0.0), context_at(-4.0, -3.0, 1.0), empty]
    here = context_at(0.6, 0.5, 1.0, seed=1)
    found = ContextBank(contexts).dissimilarity(here)
    assert found.shape == (3, SECTORS)
    for context, row in zip(contexts, found, strict=True):
        least, turn = dissimilarity(context, here)
        assert row.min() == pytest.approx(least, abs=1e-6)
        if least < 1.0:
            assert 2.0 * np.pi * row.argmin() / SECTORS == pytest.approx(turn % (2.0 * np.pi))


def test_planes_of_clouds_add_up() -> None:
    """Two halves together show the planes of the whole, and every plane lies on a wall or the floor."""
    points = points_at(-1.0, 0.3, 0.4)
    whole = PlaneVoxels.build(points, 0.2, 0.06)
    parts, newest = (points[::3] + 1.0, points[::2], points[1::2]), PlaneVoxels(0.2, 0.06)
    for part, gone in zip(parts, (None, None, parts[0]), strict=True):
        newest.add(part, gone)
    one, two = whole.pairs(points), newest.pairs(points)
    np.testing.assert_array_equal(one.found, two.found)
    np.testing.assert_allclose(one.centers, two.centers, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", one.normals, two.normals)), 1.0, atol=1e-6)
    far = PlaneVoxels.build(points + np.array([500.0, -300.0, 20.0]), 0.2, 0.06)
    assert len(far) == pytest.approx(len(whole), rel=0.3)


def test_a_line_is_no_plane() -> None:
    line = np.column_stack([np.linspace(0.0, 5.0, 2000), np.zeros(2000), np.zeros(2000)])
    assert len(PlaneVoxels.build(line, 0.2, 0.06)) == 0
    assert len(PlaneVoxels.build(np.zeros((0, 3)), 0.2, 0.06)) == 0
