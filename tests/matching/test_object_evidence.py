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


class Stated:
    """A local map of what was seen at home, and what a scan of now says for a pose against another."""

    def __init__(self, before: FloatArray, at: FloatArray = HOME) -> None:
        scan = points_at(before, at)
        image = RangeImage.of(scan.points_base, at, scan.points_base)
        points = OrientedPoints.from_scan(scan).moved(at)
        self.local_map = LocalMap.build([points], MatchConfig(), [lambda: image])

    def evidence(
        self, scan: OrientedPoints, pose: FloatArray, other: FloatArray, sigma: float = 0.0
    ) -> FloatArray:
        """(2, K) by known ground, and by what only the first pose knows; ``other`` is known to a sigma."""
        rival = Motion(other, np.diag([0.0, 0.0, sigma**2]))
        return self.local_map.evidence(scan, pose, rival)


def evidence(before: FloatArray, now: FloatArray, pose: FloatArray, other: FloatArray) -> FloatArray:
    """What the objects of a scan of ``now``, taken at ``pose``, say against ``other``, (K,)."""
    scan = OrientedPoints.from_scan(points_at(now, pose))
    return np.asarray(Stated(before).evidence(scan, pose, other).sum(axis=0))


def test_a_walker_is_one_object() -> None:
    """He walks as the robot drives: all his points speak for a robot that stands, and nothing else does."""
    walker = box(1.5, -0.25, 1.9, 0.25)
    ahead = np.array([0.1, 0.0, 0.0])
    before = np.concatenate([corridor(), walker])
    now = np.concatenate([corridor(), moved(walker, ahead)])
    driven = compose(HOME, ahead)
    scan = OrientedPoints.from_scan(points_at(now, driven))
    says = Stated(before).evidence(scan, HOME, driven).sum(axis=0)
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
    back = Stated(room()).evidence(scan, HOME, driven).sum(axis=0)
    np.testing.assert_allclose(back / back.sum(), forth / forth.sum(), atol=1e-9)
    assert back.sum() < 0.0 < forth.sum(), "how many points are a witness is counted at the first pose"


def test_no_points_say_nothing() -> None:
    assert Stated(room()).evidence(OrientedPoints.none(), HOME, HOME).size == 0


def hall(begin_m: float, end_m: float) -> FloatArray:
    """Walls 2 m apart, and a pillar every 4 m: a stretch looks like the next."""
    walls = [np.array([[begin_m, y, end_m, y]]) for y in (-1.0, 1.0)]
    return np.concatenate([*walls, *(box(x, 0.7, x + 0.4, 1.0) for x in np.arange(begin_m, end_m, 4.0))])


class TestGroundThatNobodySaw:
    """The robot looks ahead along a hall, and the next scan is taken 6 m beyond the end of what was seen."""

    HERE, BEYOND = np.array([1.0, 0.0, 0.0]), np.array([19.0, 0.0, 0.0])
    LOOK_ALIKE = np.array([3.0, 0.0, 0.0])

    def stated(self, at: FloatArray = HERE) -> Stated:
        return Stated(np.concatenate([hall(0.0, 12.0), [[12.0, -1.0, 12.0, 1.0]]]), at)

    def scan(self, segments: FloatArray, pose: FloatArray) -> OrientedPoints:
        return OrientedPoints.from_scan(points_at(segments, pose, fov_rad=np.pi, beams=181))

    def test_a_look_alike_gains_no_certainty_from_it(self) -> None:
        known, by_chance = self.stated().evidence(
            self.scan(hall(12.0, 24.0), self.BEYOND), self.LOOK_ALIKE, self.BEYOND
        )
        assert by_chance.sum() > 5.0, "much fits there"
        assert known.sum() < 0.1 * by_chance.sum()

    def test_what_scans_have_looked_through_contradicts(self) -> None:
        """A post stands where nothing stood at the look-alike."""
        post = box(20.9, -0.1, 21.1, 0.1)
        scan = self.scan(np.concatenate([hall(12.0, 24.0), post]), self.BEYOND)
        known, _ = self.stated().evidence(scan, self.LOOK_ALIKE, self.BEYOND)
        assert known.min() < -1.0

    def test_what_a_beam_would_have_crossed_contradicts(self) -> None:
        """Held at a pose before the end wall, the scan looks far through it."""
        before = np.array([10.0, 0.0, 0.0])
        scan = self.scan(hall(12.0, 24.0), self.BEYOND)
        known, _ = self.stated(np.array([9.0, 0.0, 0.0])).evidence(scan, before, self.BEYOND)
        assert known.sum() < -1.0

    def test_who_is_not_sure_where_he_is_is_not_contradicted(self) -> None:
        """Turned wrongly by 20 degrees, the rival's points stand in the hall, unless it may be so wrong."""
        scan, turned = self.scan(hall(0.0, 12.0), self.HERE), compose(self.HERE, np.array([0.0, 0.0, 0.35]))
        sure, unsure = (
            self.stated().evidence(scan, self.HERE, turned, sigma)[0].sum() for sigma in (0.0, 1.0)
        )
        assert sure > 5.0
        assert unsure < 0.3 * sure
