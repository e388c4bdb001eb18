"""Who comes, stands and goes is taken out of the keyframes' scans; what is fixed stays in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from flat_worlds import box, room, sweep

from slam.config import Config
from slam.mapping.keyframe_grid import lidar_grids
from slam.mapping.layered_map import OCCUPANCY, PASSED_BY
from slam.mapping.moving_things import MovingThings
from slam.mapping.occupancy_grid import OCCUPIED
from slam.measurements import FloatArray, LaserScan

STAND = 1.0, 1.0
CHAIR = box(-1.2, 0.8, -0.9, 1.2)
# He walks a metre in a second, ten scans a second.
COMING = [(1.0, 2.5 - 0.1 * n) for n in range(15)]
STANDING = [STAND] * 30
GOING = [(1.0 + 0.1 * n, 1.0) for n in range(15)]


def seen(way: Sequence[tuple[float, float] | None], gap: int = -1) -> tuple[list[LaserScan], list[LaserScan]]:
    """Keyframes' scans while he is where a way says, None for away, as measured and without what moves.

    The robot goes a tenth of the way that he does; a keyframe every half second. Before the scan number
    ``gap`` it is lost.
    """
    moving, scans = MovingThings(20.0), []
    for number, at in enumerate(way):
        world = np.concatenate([room(), CHAIR])
        if at is not None:
            x, y = at
            world = np.concatenate([world, box(x - 0.2, y - 0.2, x + 0.2, y + 0.2)])
        pose = np.array([-0.01 * number, 0.0, 0.002 * number])
        scan = sweep(world, pose, beams=721, sigma_m=0.005, seed=number, stamp_s=0.1 * number)
        if number == gap:
            moving.lose()
        moving.add(scan, pose)
        if number % 5 == 0:
            moving.keep(scan)
            scans.append(scan)
    return scans, moving.taken_from(scans)  # type: ignore[return-value]


def on_him(scan: LaserScan, number: int, at: tuple[float, float]) -> FloatArray:
    """(N,) whether beams of the scan of that number end on him."""
    far = np.abs(scan.ranges_m)
    bearings = scan.bearings_rad() + 0.002 * number
    x, y = far * np.cos(bearings) - 0.01 * number - at[0], far * np.sin(bearings) - at[1]
    return np.maximum(np.abs(x), np.abs(y)) < 0.25


@pytest.mark.parametrize(
    ("way", "found"),
    [
        ([*COMING, *STANDING], True),
        ([*STANDING, *GOING], True),
        ([*COMING, *STANDING, *GOING], True),
        (STANDING, False),
        ([None] * 20, False),
        ([*[None] * 10, STAND, *[None] * 10], False),  # but one scan shows it
    ],
)
def test_who_comes_or_goes_is_taken_out_wherever_he_stood_and_nothing_else(
    way: list[tuple[float, float] | None], found: bool
) -> None:
    measured, left = seen(way)
    for key, (scan, without) in enumerate(zip(measured, left, strict=True)):
        at = way[5 * key]
        his = on_him(scan, 5 * key, at) if at is not None else np.zeros(scan.ranges_m.size, np.bool_)
        gone = without.ranges_m < 0.0
        assert not gone[~his].any()
        assert (np.abs(without.ranges_m) == scan.ranges_m).all()
        if at == STAND:
            assert (gone[his].mean() > 0.8) == found
    if not found:
        assert all(one is other for one, other in zip(measured, left, strict=True))


def test_nobody_is_followed_past_a_moment_that_was_lost() -> None:
    measured, left = seen([*COMING, *STANDING], gap=20)
    assert (left[3].ranges_m < 0.0).any()
    assert all(one is other for one, other in zip(measured[4:], left[4:], strict=True))


def test_a_thing_too_wide_for_a_person_never_moves() -> None:
    wall = [np.concatenate([room(), box(x, -0.7, x + 0.1, 0.7)]) for x in np.arange(2.2, 0.5, -0.1)]
    moving, scans = MovingThings(20.0), []
    for number, world in enumerate(wall):
        scans.append(sweep(world, np.zeros(3), beams=721, stamp_s=0.1 * number))
        moving.add(scans[-1], np.zeros(3))
        moving.keep(scans[-1])
    assert all(one is other for one, other in zip(scans, moving.taken_from(scans), strict=True))


def test_a_keyframe_without_a_scan_or_lost_is_left_as_it_is() -> None:
    scan = sweep(room(), np.zeros(3), beams=721)
    moving = MovingThings(20.0)
    moving.keep(None)
    moving.keep(scan)
    assert moving.taken_from([None, scan]) == [None, scan]


def test_it_is_not_in_the_grid_but_beside_it_unless_a_person_has_erased_it() -> None:
    way = [*COMING, *STANDING]
    measured, left = seen(way)
    poses = np.array([[-0.05 * key, 0.0, 0.01 * key] for key in range(len(left))])
    grids = lidar_grids(left, poses, Config(), measured)
    cells = grids[OCCUPANCY].cells_of(np.array([[0.8, 0.8], [1.2, 1.2]]))
    his = (slice(*cells[:, 0]), slice(*cells[:, 1]))
    assert not (grids[OCCUPANCY].states()[his] == OCCUPIED).any()
    assert (grids[PASSED_BY].states()[his] == OCCUPIED).any()
    erased = [replace(scan, ranges_m=without.ranges_m) for scan, without in zip(measured, left, strict=True)]
    assert PASSED_BY not in lidar_grids(left, poses, Config(), erased)
