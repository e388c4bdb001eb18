"""A person ahead of the robot: he holds a match only as far as what else is seen confirms him."""

from itertools import pairwise

import numpy as np
import pytest
from flat_worlds import box, corridor, points_at, room

from slam.config import Config
from slam.config.stages import MatchConfig, PredictionConfig
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.lone_object import confirmed
from slam.matching.match_covariance import weak_direction
from slam.measurements import FloatArray
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.surfel_odometry import SurfelOdometry
from slam.odometry.tracked_scan import TrackedScan

CONFIG = MatchConfig()
STILL, AHEAD = np.zeros(3), np.array([0.2, 0.0, 0.0])


def doors() -> FloatArray:
    """A corridor 2 m wide with doors, recessed by 0.25 m."""
    rows = []
    for side in (-1.0, 1.0):
        ends = [-30.0, *(x for door in (-3.0, 1.0, 4.5) for x in (door, door + 0.9)), 30.0]
        for n, (x0, x1) in enumerate(pairwise(ends)):
            y = side * (1.0 + 0.25 * (n % 2))
            rows += [[x0, y, x1, y], [x1, side, x1, 1.25 * side]]
    return np.array(rows)


def person(x_m: float, *, legs: bool = False) -> FloatArray:
    """Somebody 1 m in front of a robot at ``x_m``: a body, or two legs."""
    if not legs:
        return box(x_m + 1.0, -0.2, x_m + 1.4, 0.2)
    return np.concatenate([box(x_m + 1.0, y - 0.06, x_m + 1.12, y + 0.06) for y in (-0.18, 0.18)])


def scan_at(walls: FloatArray, x_m: float, legs: bool = False) -> OrientedPoints:
    world = np.concatenate([walls, person(x_m, legs=legs)])
    return OrientedPoints.from_scan(points_at(world, (x_m, 0.0, 0.0), beams=1440, sigma_m=0.01))


def check(walls: FloatArray, guess: FloatArray, *, legs: bool = False) -> tuple[FloatArray, bool]:
    """Pose (3,) of a robot that went 0.2 m behind a person, and whether it is open; first without a check."""
    before = [OrientedPoints.from_scan(points_at(walls, (x, 0, 0), beams=1440, seed=1)) for x in (-0.4, -0.2)]
    parts = [part.moved(np.array([x, 0.0, 0.0])) for part, x in zip(before, (-0.4, -0.2), strict=True)]
    local_map = LocalMap.build([*parts, scan_at(walls, 0.0, legs)], CONFIG)
    scan = scan_at(walls, 0.2, legs)
    found = local_map.align(scan, STILL)
    assert abs(found.pose[0]) < 0.05, "he keeps the robot where it was"
    assert weak_direction(found, CONFIG.degenerate_share) is None
    held = confirmed(local_map, scan, found, guess)
    return held.pose, weak_direction(held, CONFIG.degenerate_share) is not None


@pytest.mark.parametrize("legs", [False, True])
def test_in_a_bare_corridor_a_person_leaves_the_direction_open(legs: bool) -> None:
    for guess in (STILL, AHEAD):
        pose, is_open = check(corridor(), guess, legs=legs)
        np.testing.assert_allclose(pose, guess, atol=0.03)
        assert is_open


def test_doors_overrule_him() -> None:
    pose, is_open = check(doors(), np.array([0.17, 0.0, 0.0]))
    np.testing.assert_allclose(pose, AHEAD, atol=0.03)
    assert not is_open


def test_what_a_room_confirms_stays() -> None:
    local_map, scan = LocalMap.build([scan_at(room(), 0.0)], CONFIG), scan_at(room(), 0.1)
    found = local_map.align(scan, STILL)
    assert confirmed(local_map, scan, found, STILL) is found


def test_nothing_but_a_narrow_object_stays_as_it_was_found() -> None:
    nothing = np.zeros((0, 4))
    local_map, scan = LocalMap.build([scan_at(nothing, 0.0)], CONFIG), scan_at(nothing, 0.0)
    found = local_map.align(scan, STILL)
    assert confirmed(local_map, scan, found, AHEAD) is found


def follow(walls: FloatArray, speed_m_s: float = 0.4) -> list[TrackedScan]:
    """A robot without wheels that stands for a second, and then follows a person for five."""
    odometry = SurfelOdometry(Config())
    tracker = MotionTracker(odometry, None, PredictionConfig(), CONFIG)
    tracked, kept = list[TrackedScan](), -1.0
    for n in range(60):
        x = speed_m_s * 0.1 * max(n - 10, 0)
        world = np.concatenate([walls, person(x)])
        points = points_at(world, (x, 0.0, 0.0), beams=720, sigma_m=0.01, seed=n)
        tracked.append(tracker.track(points, 0.1 * n))
        if tracked[-1].pose[0] - kept > 0.2:
            kept = tracked[-1].pose[0]
            tracker.add_keyframe(points, tracked[-1])
    return tracked


def test_a_robot_that_follows_a_person_past_doors_goes_as_far_as_he_does() -> None:
    tracked = follow(doors())
    assert tracked[-1].pose[0] == pytest.approx(1.96, abs=0.1)


def test_in_a_bare_corridor_it_does_not_claim_how_far_it_went() -> None:
    assert all(scan.open for scan in follow(corridor())[1:])
