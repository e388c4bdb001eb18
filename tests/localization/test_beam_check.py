"""Every beam is explained, crossing, in free space or silent, by a grid drawn by hand."""

import gtsam
import numpy as np
import pytest

from slam.localization.beam_check import check_beams, in_clear_space, known_space
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import compose, transform_points
from slam.matching.surfel_map import build_surfel_maps
from slam.measurements import FloatArray

CELL_M = 0.1
FREE, WALL = -3.0, 3.0


def world(frame: FloatArray):  # type: ignore[no-untyped-def]
    """Free space 4 x 2 m, a wall at x = 3 all the way up, unknown beyond it."""
    log_odds = np.zeros((20, 60), np.float32)
    log_odds[:, :30] = FREE
    log_odds[:, 30] = WALL
    grid = OccupancyGrid.of_log_odds(log_odds, CELL_M, gtsam.Pose2(*frame))
    wall = np.column_stack([np.full(60, 3.05), np.linspace(0.0, 2.0, 60)])
    normals = np.tile([-1.0, 0.0], (60, 1))
    turn = np.array([0.0, 0.0, frame[2]])
    surfels = build_surfel_maps(transform_points(wall, frame), transform_points(normals, turn), (CELL_M,))[0]
    return known_space(grid), surfels


@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (-7.0, 12.0, 0.9)])
def test_each_kind_of_beam(frame: tuple[float, ...]) -> None:
    base = np.array(frame)
    space, surfels = world(base)
    pose = compose(base, np.array([1.0, 1.0, 0.0]))
    ends = np.array([[2.05, 0.0], [2.05, 0.3], [1.0, 0.0], [4.0, 0.0], [-3.0, 0.0]])
    normals = np.array([[-1.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0], [1.0, 0.0]])
    points = OrientedPoints(ends.astype(np.float32), normals.astype(np.float32))
    kinds = []
    for n in range(len(ends)):
        one = OrientedPoints(points.points[n : n + 1], points.normals[n : n + 1])
        kinds.append(tuple(check_beams(space, surfels, pose, np.zeros(2), one)))
    explained, crossing, in_free, silent = np.eye(4, 3, dtype=int).tolist()
    # On the wall; on it, but facing away; before it; behind it; beyond the map on the other side.
    assert [list(kind) for kind in kinds] == [explained, silent, in_free, crossing, silent]
    total = check_beams(space, surfels, pose, np.zeros(2), points)
    assert tuple(total) == (1, 1, 1)


def test_only_the_midst_of_free_space_is_clear() -> None:
    space, _ = world(np.zeros(3))
    points = np.array([[1.0, 0.0], [1.95, 0.0], [2.05, 0.0], [3.0, 0.0], [90.0, 0.0]])
    clear = in_clear_space(space, np.array([1.0, 1.0, 0.0]), points)
    assert clear.tolist() == [True, False, False, False, False]


def test_free_by_a_single_glance_contradicts_nothing() -> None:
    log_odds = np.full((10, 30), -0.8, np.float32)
    space = known_space(OccupancyGrid.of_log_odds(log_odds, CELL_M))
    point = OrientedPoints(np.array([[1.0, 0.0]], np.float32), np.array([[-1.0, 0.0]], np.float32))
    none = build_surfel_maps(np.zeros((0, 2)), np.zeros((0, 2)), (CELL_M,))[0]
    counts = check_beams(space, none, np.array([0.5, 0.5, 0.0]), np.zeros(2), point)
    assert not any(counts)


def test_a_wall_that_nothing_has_met_may_stand_where_free_space_ends() -> None:
    """Beams along a corridor clear its cells up to a wall that they only brush."""
    log_odds = np.zeros((20, 60), np.float32)
    log_odds[:10] = FREE
    space = known_space(OccupancyGrid.of_log_odds(log_odds, CELL_M))
    none = build_surfel_maps(np.zeros((0, 2)), np.zeros((0, 2)), (CELL_M,))[0]
    ends = np.array([[2.0, 0.42], [2.0, 0.1]], np.float32)
    points = OrientedPoints(ends, np.tile(np.float32([0.0, -1.0]), (2, 1)))
    counts = check_beams(space, none, np.array([1.0, 0.5, 0.0]), np.zeros(2), points)
    assert tuple(counts) == (0, 0, 1)
