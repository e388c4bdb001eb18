"""The ray caster against triangles whose distances are known, and what a user reads where it cannot load."""

import sys

import numpy as np
import pytest

from slam.errors import ScanweaveError
from slam.simulation.ray_caster import RayCaster

CORNERS = np.float32([[0, 0, 2], [1, 0, 2], [0, 1, 2], [0, 0, 3], [1, 0, 3], [0, 1, 3]])
# Seen from below: the nearer by the right hand upwards, the farther downwards.
FLOORS = np.int32([[0, 1, 2], [3, 5, 4]])


def rays(*rows):
    return np.array(rows, dtype=np.float32).reshape(-1, 6)


def test_the_nearest_triangle_in_lengths_of_the_direction():
    up, fast, aside = (0.2, 0.2, 0, 0, 0, 1), (0.2, 0.2, 0, 0, 0, 4), (2, 2, 0, 0, 0, 1)
    between, down = (0.2, 0.2, 2.5, 0, 0, 0.5), (0.2, 0.2, 2.5, 0, 0, -1)
    range_m, triangle, normal = RayCaster(CORNERS, FLOORS).cast(rays(up, fast, aside, between, down))
    np.testing.assert_array_equal(triangle, [0, 0, -1, 1, 0])
    np.testing.assert_allclose(range_m, [2.0, 0.5, np.inf, 1.0, 0.5], rtol=1e-6)
    # By the right hand about the corners, from whichever side the ray comes.
    np.testing.assert_array_equal(np.sign(normal[:, 2]), [1, 1, 0, -1, 1])


def test_no_rays_and_no_triangles_are_no_hits():
    assert [part.shape for part in RayCaster(CORNERS, FLOORS).cast(rays())] == [(0,), (0,), (0, 3)]
    range_m, triangle, _ = RayCaster(CORNERS, FLOORS[:0]).cast(rays((0, 0, 0, 0, 0, 1)))
    assert range_m[0] == np.inf and triangle[0] == -1


def test_no_ray_slips_through_the_edge_that_triangles_share():
    side, rng = 60, np.random.default_rng(1)
    number = np.arange(side * side).reshape(side, side)
    corners = np.column_stack([number.ravel() % side, number.ravel() // side, rng.uniform(size=side * side)])
    corners[:, :2] = 0.1 * corners[:, :2] + 0.02 * rng.uniform(size=(side * side, 2))
    a, b, c, d = (
        part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:])
    )
    caster = RayCaster(corners, np.vstack([np.column_stack([a, b, c]), np.column_stack([b, d, c])]))
    inner = number[2:-2, 2:-2].ravel()
    for other in (1, side):
        ends = corners[inner] + rng.uniform(size=(inner.size, 1)) * (corners[inner + other] - corners[inner])
        eye = np.array([3.1, 2.9, 20.0])
        looking = np.hstack([np.tile(eye, (inner.size, 1)), ends - eye]).astype(np.float32)
        assert np.isfinite(caster.cast(looking)[0]).all()


def test_without_the_library_one_line_says_where_it_works(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(ScanweaveError, match=r"embreex does not load .* maps anywhere") as raised:
        RayCaster(CORNERS, FLOORS)
    assert "\n" not in str(raised.value)
