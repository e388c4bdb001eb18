"""Evidence: a surface counts once, doubt comes quickly, and a robot that is carried off is believed so."""

import math

import numpy as np
import pytest
from flat_worlds import points_at, room

from slam.config.localization import LocalizationConfig
from slam.localization.evidence import Hypothesis, is_correction, is_same_place, pruned
from slam.localization.loss_test import LossTest
from slam.localization.scan_view import ScanView, first_in_cells
from slam.localization.stations import StationLog
from slam.matching.local_map import OrientedPoints
from slam.measurements import FloatArray

CONFIG = LocalizationConfig()


def view_from(pose: FloatArray, stamp_s: float = 0.0) -> ScanView:
    points = points_at(room(), pose)
    return ScanView(stamp_s, points, OrientedPoints.from_scan(points), np.zeros(2))


def test_a_surface_is_news_only_once() -> None:
    log = StationLog(CONFIG)
    log.add(view_from(np.zeros(3)), np.zeros(3))
    first = len(log.stations[0].news)
    assert first > 30
    for n in range(1, 6):
        pose = np.array([0.05 * n, 0.0, 0.1 * n])
        log.add(view_from(pose), pose)
    assert sum(len(station.news) for station in log.stations[1:]) < 0.1 * first


def test_what_has_left_the_window_is_news_again() -> None:
    config = LocalizationConfig(window_m=2.0)
    log = StationLog(config)
    view = view_from(np.zeros(3))
    log.add(view, np.zeros(3))
    first = len(log.stations[0].news)
    # The odometry drives away and back while the laser sees the same from the same place.
    far = np.array([1.5, 0.0, 0.0])
    empty = ScanView(
        0.0, view.only(np.zeros(len(view.points), bool)).points, OrientedPoints.none(), view.laser
    )
    assert log.add(empty, far) == 0
    assert log.add(view, np.zeros(3)) == 1
    assert len(log.stations[-1].news) == first


def test_stations_are_due_by_travel_or_turn() -> None:
    log = StationLog(CONFIG)
    assert log.due(np.zeros(3))
    log.add(view_from(np.zeros(3)), np.zeros(3))
    assert not log.due(np.array([0.9 * CONFIG.station_m, 0.0, 0.0]))
    assert log.due(np.array([1.1 * CONFIG.station_m, 0.0, 0.0]))
    assert log.due(np.array([0.0, 0.0, -1.1 * CONFIG.station_rad]))


def test_cells_keep_their_first_point() -> None:
    points = np.array([[0.05, 0.05], [-0.05, 0.05], [0.07, 0.02], [0.31, 0.0]])
    numbers, cells = first_in_cells(points, 0.1)
    assert numbers.tolist() == [0, 1, 3]
    assert cells.tolist() == [[0, 0], [-1, 0], [3, 0]]


@pytest.mark.parametrize(
    ("evidence", "expected"),
    [
        ([2.0, 3.0], 5.0),
        ([-5.0, 4.0, 4.0], 5.0),  # all the way 3, its end alone 8 less the 3 for being carried off
        ([-1.0, 4.0], 3.0),
        ([], 0.0),
    ],
)
def test_the_end_of_the_way_may_count_alone_at_a_price(evidence: list[float], expected: float) -> None:
    assert Hypothesis(np.zeros(3), evidence, None).total(kidnap_nats=3.0) == pytest.approx(expected)
    assert Hypothesis(np.zeros(3), evidence, None, 1.5).total(3.0) == pytest.approx(expected + 1.5)


def test_doubles_the_hopeless_and_too_many_are_dropped() -> None:
    members = [
        Hypothesis(np.array([x, 0.0, 0.0]), [nats], None) for x, nats in ((0, 1), (1, 9), (1.1, 8), (5, -7))
    ]
    for most, kept in ((9, [1.0, 0.0]), (1, [1.0])):
        left = pruned(members, most, 30.0, lambda one, other: is_same_place(abs(one[0] - other[0]), 0.0))
        assert [member.pose[0] for member in left] == kept


def test_an_alignment_that_moves_far_is_another_place() -> None:
    assert is_correction(0.29, 0.14)
    assert not is_correction(0.31, 0.0) and not is_correction(0.0, 0.16)


def test_a_contradicted_pose_is_lost_and_a_passer_by_is_not_enough() -> None:
    test = LossTest(CONFIG)
    for n in range(50):
        test.add(0.1 * n, 5.0)
    assert not test.lost and test.confidence > 0.99
    before = test.confidence
    for n in range(50, 56):  # six scans in half a second
        test.add(0.1 * n, -5.0)
    assert not test.lost and test.confidence < before
    for n in range(56, 65):
        test.add(0.1 * n, -5.0)
    assert test.lost and test.confidence <= 0.5


def test_one_scan_is_enough_to_doubt() -> None:
    test = LossTest(CONFIG)
    test.add(0.0, 5.0)
    test.add(0.1, -6.0)
    assert test.confidence < 0.1 and not test.lost
    test.add(0.2, 5.0)
    assert test.confidence > 0.99


def test_long_soundness_does_not_delay_the_loss() -> None:
    counts = []
    for sound in (10, 10_000):
        test = LossTest(CONFIG)
        for n in range(sound):
            test.add(float(n), 1.0)
        bad = 0
        while not test.lost:
            bad += 1
            test.add(sound + 0.4 * bad, -2.0)
        counts.append(bad)
    assert counts[0] == counts[1] == math.ceil(CONFIG.lost_nats / 2.0)
