"""The spectrum of a place is the same however it is shifted, and is found again however it is turned."""

import numpy as np
import pytest
from flat_worlds import points_at, room

from slam.matching.hough_spectrum import SpectrumBank, hough_spectrum
from slam.matching.local_map import OrientedPoints
from slam.simulation.floor_plan import walls

BIN_M = 0.3


def seen(x: float, y: float) -> OrientedPoints:
    return OrientedPoints.from_scan(points_at(walls(), (x, y, 0.3)))


def spectrum(points: OrientedPoints) -> np.ndarray:
    return hough_spectrum(points.points, points.normals, BIN_M)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7, 2.0, np.pi])
def test_neither_a_shift_nor_a_turn_matters(yaw_rad: float) -> None:
    place = seen(1.0, 4.0)
    again = place.moved(np.array([2.15, -1.4, yaw_rad]))
    others = [seen(9.0, 1.5), OrientedPoints.from_scan(points_at(room(), (0.5, 0.2, 0.0)))]
    bank = SpectrumBank([spectrum(one) for one in (again, place, *others)])
    likeness = bank.likeness(0, np.arange(1, 4))
    assert likeness[0] > 0.9
    assert likeness[0] > likeness[1:].max() + 0.05


@pytest.mark.parametrize("yaw_rad", [0.0, 0.7, 2.0, np.pi])
def test_the_turn_of_a_place_seen_again_is_among_the_likest(yaw_rad: float) -> None:
    place = seen(1.0, 4.0)
    bank = SpectrumBank([spectrum(place), spectrum(place.moved(np.array([2.15, -1.4, yaw_rad])))])
    turns, exact_rad = bank.turns(0, 1)
    off_rad = np.abs((turns - yaw_rad + np.pi) % (2.0 * np.pi) - np.pi)
    assert len(turns) <= 4
    assert off_rad.min() <= 0.5 * exact_rad


def test_the_likeness_is_a_correlation() -> None:
    bank = SpectrumBank([spectrum(seen(1.0, 4.0)), spectrum(OrientedPoints.none())])
    assert bank.likeness(0, np.arange(2)) == pytest.approx([1.0, 0.0])
