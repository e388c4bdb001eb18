"""An object is one witness: a walker in a corridor against the walls of a room."""

import numpy as np
from flat_worlds import box, corridor, moved, points_at, room

from slam.config.stages import MatchConfig
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.motion import Motion
from slam.matching.planar import compose
from slam.matching.visibility import RangeImage
from slam.measurements import FloatArray

HOME = np.array([0.0, 0.1, 0.05])


class Told:
    """A local map of what was seen at home, and what a scan of now says for a pose against another."""

    def __init__(self, before: FloatArray, at: FloatArray = HOME) -> None:
        scan = points_at(before, at)
        self.local_map = LocalMap.build([OrientedPoints.from_scan(scan).moved(at)], MatchConfig())
        self.images = [RangeImage.of(scan.points_base, at, scan.points_base)]

    def evidence(
        self, scan: OrientedPoints, pose: FloatArray, other: FloatArray, sigma: float = 0.0
    ) -> FloatArray:
        """(2, K) by known ground, and by what only the first pose knows; ``other`` is known to a sigma."""
        rival = Motion(other, np.diag([0.0, 0.0, sigma**2]))
        return self.local_map.evidence(scan, pose, rival, self.images)


def evidence(before: FloatArray, now: FloatArray, pose: FloatArray, other: FloatArray) -> FloatArray:
    """What the objects of a scan of ``now``, taken at ``pose``, say against ``other``, (K,)."""
    scan = OrientedPoints.from_scan(points_at(now, pose))
    return np.asarray(Told(before).evidence(scan, pose, other).sum(axis=0))


def test_a_walker_is_one_object() -> None:
    """He walks as the robot drives: all his points speak for a robot that stands, and nothing else does."""
    walker = box(1.5, -0.25, 1.9, 0.25)
    ahead = np.array([0.1, 0.0, 0.0])
    before = np.concatenate([corridor(), walker])
    now = np.concatenate([corridor(), moved(walker, ahead)])
    driven = compose(HOME, ahead)
    scan = OrientedPoints.from_scan(points_at(now, driven))
    says = Told(before).evidence(scan, HOME, driven).sum(axis=0)
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
    scan = OrientedPoints.from_scan(points_at(room(), driven))
    back = Told(room()).evidence(scan, HOME, driven).sum(axis=0)
    np.testing.assert_allclose(back / back.sum(), forth / forth.sum(), atol=1e-9)
    assert back.sum() < 0.0 < forth.sum(), "how many points are a witness is told at the first pose"


def test_no_points_say_nothing() -> None:
    assert Told(room()).evidence(OrientedPoints.none(), HOME, HOME).size == 0
