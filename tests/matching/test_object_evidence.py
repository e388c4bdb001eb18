"""An object is one witness: a walker in a corridor against the walls of a room."""

import numpy as np
from flat_worlds import box, corridor, moved, points_at, room

from slam.config.stages import MatchConfig
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.planar import compose
from slam.measurements import FloatArray

HOME = np.array([0.0, 0.1, 0.05])


def evidence(before: FloatArray, now: FloatArray, pose: FloatArray, other: FloatArray) -> FloatArray:
    """What the objects of a scan of ``now``, taken at ``pose``, say against ``other``."""
    local_map = LocalMap.build([OrientedPoints.from_scan(points_at(before, HOME)).moved(HOME)], MatchConfig())
    return local_map.evidence(OrientedPoints.from_scan(points_at(now, pose)), pose, other)


def test_a_walker_is_one_object() -> None:
    """He walks as the robot drives: all his points speak for a robot that stands, and nothing else does."""
    walker = box(1.5, -0.25, 1.9, 0.25)
    ahead = np.array([0.1, 0.0, 0.0])
    before = np.concatenate([corridor(), walker])
    now = np.concatenate([corridor(), moved(walker, ahead)])
    local_map = LocalMap.build([OrientedPoints.from_scan(points_at(before, HOME)).moved(HOME)], MatchConfig())
    driven = compose(HOME, ahead)
    scan = OrientedPoints.from_scan(points_at(now, driven))
    says = local_map.evidence(scan, HOME, driven)
    assert says.max() > 1.0
    assert np.count_nonzero(says > 0.1) <= 2, "his front, and perhaps a side of him"


def test_a_room_has_many_witnesses() -> None:
    driven = compose(HOME, np.array([0.1, 0.05, 0.0]))
    says = evidence(room(), room(), driven, HOME)
    assert np.count_nonzero(says > 1.0) >= 5
    np.testing.assert_allclose(evidence(room(), room(), driven, driven), 0.0)


def test_it_turns_with_the_order() -> None:
    driven = compose(HOME, np.array([0.1, 0.05, 0.0]))
    forth = evidence(room(), room(), driven, HOME)
    local_map = LocalMap.build([OrientedPoints.from_scan(points_at(room(), HOME)).moved(HOME)], MatchConfig())
    scan = OrientedPoints.from_scan(points_at(room(), driven))
    back = local_map.evidence(scan, HOME, driven)
    np.testing.assert_allclose(back / back.sum(), forth / forth.sum(), atol=1e-9)
    assert back.sum() < 0.0 < forth.sum(), "how many points are a witness is told at the first pose"


def test_no_points_say_nothing() -> None:
    local_map = LocalMap.build([OrientedPoints.from_scan(points_at(room(), HOME)).moved(HOME)], MatchConfig())
    assert local_map.evidence(OrientedPoints.none(), HOME, HOME).size == 0
