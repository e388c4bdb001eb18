"""What beams say in a room that is known: walls explain them, free space and walls in between contradict."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_world import PILLARS, ROOM, T_BASE_LIDAR, base, look

from slam.config.clouds import CloudOdometryConfig
from slam.localization.cloud_space import CloudSpace, cloud_space, judge_beams
from slam.localization.plane_sides import SidedPlanes
from slam.matching.cloud_points import base_points
from slam.matching.local_cloud import moved
from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import FloatArray

VOXEL_M, REACH_M = 0.25, 0.1
PLACES = [base(x, y, 0.3 * x) for x, y in ((-1.5, 0.5), (0.0, -0.5), (1.5, 0.5), (2.5, -1.0))]


def placed(n: int, seed: int = 0) -> FloatArray:
    """What is seen from a place, map frame."""
    points = base_points(look(PLACES[n], seed=n + seed), np.zeros(6), CloudOdometryConfig())
    return moved(points, PLACES[n])


def lidar(n: int) -> FloatArray:
    return np.asarray(PLACES[n].compose(T_BASE_LIDAR).translation())


@pytest.fixture(scope="module")
def known() -> tuple[CloudSpace, SidedPlanes]:
    clouds = [placed(n) for n in range(len(PLACES))]
    lidars = np.array([lidar(n) for n in range(len(PLACES))])
    planes = SidedPlanes(PlaneVoxels.build(np.vstack(clouds), VOXEL_M, 0.03), lidars, clouds)
    return cloud_space(lidars, clouds, planes, VOXEL_M, 30.0), planes


def test_the_same_place_is_explained(known: tuple[CloudSpace, SidedPlanes]) -> None:
    verdicts = judge_beams(*known, lidar(1), placed(1, seed=50), REACH_M)
    assert verdicts.explained.mean() > 0.4
    assert verdicts.in_free.mean() < 0.02 and verdicts.crossing.mean() < 0.03
    assert not (verdicts.explained & (verdicts.in_free | verdicts.crossing)).any()


@pytest.mark.parametrize("offset", [(0.8, 0.0, 0.0), (-0.7, 0.6, 0.0)])
def test_another_place_is_contradicted(
    known: tuple[CloudSpace, SidedPlanes], offset: tuple[float, float, float]
) -> None:
    verdicts = judge_beams(*known, lidar(1) + offset, placed(1) + offset, REACH_M)
    assert (verdicts.in_free | verdicts.crossing).mean() > 0.12


def test_single_beams(known: tuple[CloudSpace, SidedPlanes]) -> None:
    """To a wall, into free space, through the wall, to the floor, to where nothing is known."""
    begin = np.array([0.0, 0.5, 0.7])
    ends = np.array(
        [
            [ROOM[0, 1], 0.5, 0.9],
            [2.0, 0.5, 0.7],
            [ROOM[0, 1] + 3.0, 0.6, 0.8],
            [1.5, 0.3, 0.0],
            [0.0, 0.5, 9.0],
        ]
    )
    verdicts = judge_beams(*known, begin, ends, REACH_M)
    assert verdicts.explained.tolist() == [True, False, False, False, False]
    assert verdicts.in_free.tolist() == [False, True, False, False, False]
    assert verdicts.crossing.tolist() == [False, False, True, False, False]


def test_a_wall_from_behind_is_another_wall(known: tuple[CloudSpace, SidedPlanes]) -> None:
    wall = np.array([[ROOM[0, 1], y, 1.0] for y in np.linspace(-1.0, 1.0, 9)])
    _, planes = known
    before = planes.judge(np.array([0.0, 0.0, 0.7]), wall, REACH_M)
    behind = planes.judge(np.array([9.0, 0.0, 0.7]), wall, REACH_M)
    assert before.upright.mean() > 0.7 and not before.strange.any()
    assert not behind.on.any() and behind.strange.mean() > 0.7


def test_pillars_are_in_the_way(known: tuple[CloudSpace, SidedPlanes]) -> None:
    x, y = PILLARS[0].mean(axis=1)[:2]
    begin = np.array([0.0, 0.5, 0.7])
    beyond = np.array([[x, y, 0.7]]) + 1.2 * (np.array([x, y, 0.7]) - begin) / np.hypot(x, y - 0.5)
    verdicts = judge_beams(*known, begin, beyond, REACH_M)
    assert (verdicts.crossing | verdicts.in_free).all()
