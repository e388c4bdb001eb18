"""What a scan has looked through, and what a beam would have crossed, in a room of 6 m."""

import numpy as np
import pytest
from flat_worlds import points_at, room

from slam.matching.planar import between, transform_points
from slam.matching.visibility import RangeImage, seen_through

HOME = np.array([0.3, -0.2, 0.1])
# In the middle of the floor, just before the west wall, behind it, and behind a cupboard's front.
PLACES = np.array([[-1.5, 0.5], [-2.95, 0.0], [-3.5, 0.0], [2.6, -2.0]])


@pytest.mark.parametrize("beams", [91, 361, 1441])
def test_floor_is_seen_through_and_no_wall_is_however_fine_the_scan(beams: int) -> None:
    points = points_at(room(), HOME, beams=beams).points_base
    images = [RangeImage.of(points, HOME, points)]
    assert seen_through(PLACES, images, np.full(4, 0.15)).tolist() == [True, False, False, False]
    assert not seen_through(PLACES, images, np.full(4, 2.0)).any(), "within what is uncertain is a wall"
    there = transform_points(PLACES, between(HOME, np.zeros(3)))
    assert images[0].less_far(there, np.full(4, 0.15), -1).tolist() == [False, False, True, True]


def test_nobody_has_seen_what_is_behind_the_robot() -> None:
    points = points_at(room(), HOME, fov_rad=np.pi).points_base
    seen = seen_through(
        np.array([[1.5, 0.0], [-1.5, 0.0]]), [RangeImage.of(points, HOME, points)], np.zeros(2)
    )
    assert seen.tolist() == [True, False]
    nothing = points[:0]
    assert not seen_through(PLACES, [RangeImage.of(nothing, HOME, nothing)], np.zeros(4)).any()
