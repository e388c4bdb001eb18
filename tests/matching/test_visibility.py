"""What a scan has looked through, and what a beam would have crossed, in a room of 6 m."""

import numpy as np
import pytest
from flat_worlds import points_at, room

from slam.matching.planar import between, transform_points
from slam.matching.visibility import RangeImage, RangeImages, standing_before

HOME = np.array([0.3, -0.2, 0.1])
# In the middle of the floor, just before the west wall, behind it, and behind a cupboard's front.
PLACES = np.array([[-1.5, 0.5], [-2.95, 0.0], [-3.5, 0.0], [2.6, -2.0]])


@pytest.mark.parametrize("beams", [91, 361, 1441])
def test_floor_is_seen_through_and_no_wall_is_however_fine_the_scan(beams: int) -> None:
    points = points_at(room(), HOME, beams=beams).points_base
    image = RangeImage.of(points, HOME, points)
    images = RangeImages.of([image])
    assert images.less_far(PLACES, np.full(4, 0.15), 1).tolist() == [True, False, False, False]
    assert not images.less_far(PLACES, np.full(4, 2.0), 1).any(), "within what is uncertain is a wall"
    there = transform_points(PLACES, between(HOME, np.zeros(3)))
    assert image.less_far(there, np.full(4, 0.15), -1).tolist() == [False, False, True, True]


def test_nobody_has_seen_what_is_behind_the_robot() -> None:
    points = points_at(room(), HOME, fov_rad=np.pi).points_base
    images = RangeImages.of([RangeImage.of(points, HOME, points)])
    seen = images.less_far(np.array([[1.5, 0.0], [-1.5, 0.0]]), np.zeros(2), 1)
    assert seen.tolist() == [True, False]
    nothing = points[:0]
    blind = RangeImages.of([RangeImage.of(nothing, HOME, nothing)])
    assert not blind.less_far(PLACES, np.zeros(4), 1).any()


@pytest.mark.parametrize("seed", range(5))
def test_what_stands_before_a_scan_is_as_if_every_point_were_looked_at(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, pose = rng.uniform(-4.0, 4.0, (800, 2)), np.array([0.5, -0.3, 0.4])
    scan, margins_m = points_at(room(), pose, beams=181).points_base, rng.uniform(0.05, 0.8, 181)
    images = RangeImages.of(RangeImage.of(scan, home, scan) for home in (HOME, np.array([-0.7, 0.3, 0.8])))
    stand = points[~images.less_far(points, np.full(800, 0.1), 1)]
    assert 0 < len(stand) < 800
    seen = transform_points(stand, between(pose, np.zeros(3)))
    expected = RangeImage.of(seen, pose, scan).less_far(scan, margins_m, -1)
    found = standing_before(points, images, 0.1, pose, scan, margins_m).less_far(scan, margins_m, -1)
    np.testing.assert_array_equal(found, expected)
    assert 0 < found.sum() < len(found)


def test_two_beams_back_to_back_are_two_bearings() -> None:
    beams = np.array([[2.0, 0.0], [-2.0, -0.1]])
    images = RangeImages.of(RangeImage.of(seen, HOME, beams) for seen in (beams[:0], beams))
    near, far = transform_points(0.5 * beams, HOME), transform_points(2.0 * beams, HOME)
    assert images.less_far(near, np.full(2, 0.1), 1).all()
    assert not images.less_far(far, np.full(2, 0.1), 1).any()
