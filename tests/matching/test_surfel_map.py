"""Surfels: means per cell and facing side, found from a point that faces the same way."""

import math

import numpy as np
import pytest

from slam.matching.surfel_map import build_surfel_maps, nearest_surfel

OFFSETS = [(0.0, 0.0), (123.4, -56.7)]
TURNS = [0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi]


def arrays(points: list[list[float]], normals: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    return np.array(points, dtype=float).reshape(-1, 2), np.array(normals, dtype=float).reshape(-1, 2)


def turned(rows: np.ndarray, angle: float) -> np.ndarray:
    cos, sin = math.cos(angle), math.sin(angle)
    return rows @ np.array([[cos, sin], [-sin, cos]])


@pytest.mark.parametrize("offset", OFFSETS)
def test_a_surfel_is_the_mean_of_its_cell(offset: tuple[float, float]) -> None:
    points, normals = arrays([[0.0, 0.0], [0.04, 0.02], [5.0, 5.0]], [[1.0, 0.0], [0.8, 0.6], [1.0, 0.0]])
    surfels = build_surfel_maps(points + offset, normals, (1.0,))[0].surfels
    assert len(surfels) == 2
    mean = math.atan2(0.6, 1.8)
    np.testing.assert_allclose(
        surfels[0, :4], [0.02 + offset[0], 0.01 + offset[1], math.cos(mean), math.sin(mean)], atol=1e-9
    )


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("offset", OFFSETS)
def test_the_sides_of_a_thin_wall_are_not_mixed(offset: tuple[float, float], turn: float) -> None:
    """Two faces 4 cm apart in one cell of 30 cm: each face is found only by who faces it."""
    along = np.linspace(0.0, 2.0, 41)
    near = np.column_stack([np.full(41, 0.00), along])
    far = np.column_stack([np.full(41, 0.04), along])
    normals = np.repeat([[-1.0, 0.0], [1.0, 0.0]], 41, axis=0)
    points = turned(np.concatenate([near, far]), turn) + offset
    surfel_map = build_surfel_maps(points, turned(normals, turn), (0.3,))[0]
    sides = turned(surfel_map.surfels[:, :2] - offset, -turn)[:, 0]
    facing = turned(surfel_map.surfels[:, 2:4], -turn)[:, 0]
    np.testing.assert_allclose(sides, np.where(facing < 0.0, 0.0, 0.04), atol=1e-9)
    for x, normal in ((0.0, -1.0), (0.04, 1.0)):
        # Asked from the wrong face, the answer is still one's own.
        for asked in (0.0, 0.04):
            spot = turned(np.array([[asked, 1.0]]), turn)[0] + offset
            way = turned(np.array([[normal, 0.0]]), turn)[0]
            found = nearest_surfel(*surfel_map, *spot, *way)
            assert found >= 0
            assert sides[found] == pytest.approx(x, abs=1e-9)


def test_the_nearest_of_several_is_found() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(0.0, 3.0, (400, 2))
    normals = np.tile([0.6, 0.8], (400, 1))
    surfel_map = build_surfel_maps(points, normals, (0.5,))[0]
    spots = rng.uniform(-0.4, 3.4, (300, 2))
    for spot in spots:
        distances = np.hypot(*(surfel_map.surfels[:, :2] - spot).T)
        found = nearest_surfel(*surfel_map, *spot, 0.6, 0.8)
        # The 3 x 3 cells reach one cell at least.
        if distances.min() < 0.5:
            assert found == distances.argmin()
        elif found >= 0:
            assert distances[found] < 0.75


@pytest.mark.parametrize(
    ("angle_deg", "found"), [(0, True), (50, True), (-50, True), (56, False), (180, False)]
)
def test_a_surfel_is_found_only_by_who_faces_alike(angle_deg: float, found: bool) -> None:
    surfel_map = build_surfel_maps(*arrays([[1.0, 1.0]], [[1.0, 0.0]]), (0.2,))[0]
    angle = math.radians(angle_deg)
    assert (nearest_surfel(*surfel_map, 1.0, 1.0, math.cos(angle), math.sin(angle)) == 0) is found


def test_nothing_is_found_far_away() -> None:
    surfel_map = build_surfel_maps(*arrays([[1.0, 1.0]], [[1.0, 0.0]]), (0.2,))[0]
    assert nearest_surfel(*surfel_map, 1.19, 1.0, 1.0, 0.0) == 0
    for x, y in ((1.31, 1.0), (1.0, 0.69), (1e6, 1e6), (-1e6, -1e6), (math.inf, 0.0)):
        assert nearest_surfel(*surfel_map, x, y, 1.0, 0.0) == -1


def test_an_empty_map_answers() -> None:
    surfel_map = build_surfel_maps(np.zeros((0, 2)), np.zeros((0, 2)), (0.1,))[0]
    assert len(surfel_map.surfels) == 0
    assert nearest_surfel(*surfel_map, 0.0, 0.0, 1.0, 0.0) == -1


def test_points_at_the_maps_edge() -> None:
    """The highest point of a map whose size is a whole number of cells has a cell of its own."""
    points, normals = arrays([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0]], [[1.0, 0.0]] * 3)
    surfel_map = build_surfel_maps(points, normals, (0.25,))[0]
    assert len(surfel_map.surfels) == 3
    assert (surfel_map.cells >= 0).sum() == 3
