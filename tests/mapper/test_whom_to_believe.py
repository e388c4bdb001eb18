"""Whom the mapper believes where lidar and wheels contradict each other, judged by what becomes of the map.

Each drive goes wrong in one way, and the truth is known. Nothing here knows how the mapper judges.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_worlds import box
from memory_drives import mapped_drive, scans_along, steps_of, way, worst_m
from numpy.typing import ArrayLike

from slam.matching.planar import compose
from slam.measurements import FloatArray, LaserScan

AHEAD = np.array([1.0, 0.0, 0.0])
ODOM = (5.0, 1.0, -2.0)  # where the wheels' frame happens to begin


def corridor() -> FloatArray:
    """2 m wide along x, too long to see its end; its first 9 m have boxes at both walls."""
    rng = np.random.default_rng(3)
    walls = [np.array([[-4, -1, 80, -1], [-4, 1, 80, 1], [-4, -1, -4, 1]], float)]
    for x in np.arange(1.0, 9.0, 1.3):
        side, depth, width = rng.choice([-1, 1]), rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.6)
        walls.append(box(x, min(side, side - side * depth), x + width, max(side, side - side * depth)))
    return np.concatenate(walls)


def hall() -> FloatArray:
    """16 x 12 m with boxes scattered, so that every view shows position and heading."""
    rng = np.random.default_rng(6)
    walls = [box(-8, -6, 8, 6)]
    for _ in range(14):
        x, y, width, depth = rng.uniform([-7, -5, 0.2, 0.2], [7, 5, 0.8, 0.8])
        if abs(y) > 1.0:
            walls.append(box(x, y, x + width, y + depth))
    return np.concatenate(walls)


def with_person(walls: FloatArray, x_m: float) -> FloatArray:
    """Somebody stands in the corridor at x."""
    return np.concatenate([walls, box(x_m, -0.25, x_m + 0.3, 0.25)])


class TestSomebodyWalksAhead:
    """Along bare walls the lidar shows the way by the person alone; the wheels are right within 1 %."""

    BEFORE = 100

    @pytest.mark.parametrize("pace", [1.0, 0.9])
    @pytest.mark.parametrize(("step_m", "scans"), [(0.1, 20), (0.03, 70), (0.01, 150)])
    def test_the_wheels_are_believed(self, step_m: float, scans: int, pace: float) -> None:
        """Fast, each match is a surprise; creeping, no single one is, but the way of a while."""
        walls, after = corridor(), 15
        begins_m = 9.0 - self.BEFORE * step_m
        truth = way((begins_m, 0.0, 0.0), [step_m * AHEAD] * (self.BEFORE + scans + after))
        person_m = 10.0 + pace * step_m * np.arange(scans + 1)
        alone = [walls] * self.BEFORE, [walls] * after
        worlds = [*alone[0], *(with_person(walls, x) for x in person_m), *alone[1]]
        wheels = way(ODOM, steps_of(truth) * [1.01, 1.0, 1.0])
        assert scans * step_m * pace > 1.3, "so far the person would lead the map astray"
        assert worst_m(mapped_drive(scans_along(truth, worlds), wheels), truth) < 0.2


def seeing(scan: LaserScan, range_m: float, half_fov_rad: float) -> LaserScan:
    """What is left of a scan in fog, or where much is hidden."""
    kept = (scan.ranges_m < range_m) & (np.abs(scan.bearings_rad()) < half_fov_rad)
    return replace(scan, ranges_m=np.where(kept, scan.ranges_m, np.nan).astype(np.float32))


class TestSlippingWheels:
    """The wheels were exact for 6 s, then they slip; the walls say so."""

    BEFORE, AFTER, LITTLE = 60, 20, 10
    STEP = 0.03 * AHEAD

    def drive(self, slip: ArrayLike, scans: int) -> tuple[FloatArray, FloatArray]:
        """True poses, and those of wheels that turn a slip (3,) too far at each of so many scans."""
        steps = np.tile(self.STEP, (self.BEFORE + scans + self.AFTER, 1))
        by_wheels = steps.copy()
        by_wheels[self.BEFORE : self.BEFORE + scans] += slip
        return way((-6.0, 0.0, 0.0), list(steps)), way(ODOM, list(by_wheels))

    @pytest.mark.parametrize(
        ("slip", "scans"),
        [((0.08, 0, 0), 10), ((0, 0, 0.08), 10), ((0.4, 0, 0), 1), ((0, 0, 0.4), 1), ((0.4, 0.2, 0.3), 1)],
    )
    def test_the_scan_is_believed(self, slip: tuple[float, ...], scans: int) -> None:
        truth, wheels = self.drive(slip, scans)
        result = mapped_drive(scans_along(truth, [hall()] * len(truth)), wheels)
        assert worst_m(result, truth) < 0.02

    @pytest.mark.parametrize(
        ("slip", "scans", "range_m", "half_fov_rad"),
        [((0.4, 0, 0), 1, 5.0, 9.0), ((0, 0, 0.08), 10, 30.0, 0.5), ((0, 0, 0.08), 10, 30.0, 0.3)],
    )
    def test_a_slip_that_is_over_speaks_no_more(
        self, slip: tuple[float, ...], scans: int, range_m: float, half_fov_rad: float
    ) -> None:
        """Right after it the robot sees little: too little to overrule the slip once more."""
        truth, wheels = self.drive(slip, scans)
        seen = scans_along(truth, [hall()] * len(truth))
        first = self.BEFORE + scans + 1
        for n in range(first, first + self.LITTLE):
            seen[n] = seeing(seen[n], range_m, half_fov_rad)
        assert worst_m(mapped_drive(seen, wheels), truth) < 0.03


@pytest.mark.parametrize("step_m", [0.03, 0.06])
def test_wheels_that_lose_their_sign_are_believed_no_more(step_m: float) -> None:
    """They were exact for 60 scans, and the lidar sees the hall all along."""
    steps = np.tile(step_m * AHEAD, (120, 1))
    by_wheels = steps * np.where(np.arange(120) < 60, 1.0, -1.0)[:, None]
    truth = way((-6.0, 0.0, 0.0), list(steps))
    result = mapped_drive(scans_along(truth, [hall()] * len(truth)), way(ODOM, list(by_wheels)))
    assert worst_m(result, truth) < 0.02


@pytest.mark.parametrize("axle_m", [0.1, 0.2])
def test_wheels_that_proved_exact_on_the_straight_may_swing_in_a_turn(axle_m: float) -> None:
    """The base sits beside the axle: turns on the spot take it aside, which the wheels do not measure."""
    straight, turn = [0.03 * AHEAD] * 10, 0.1
    steps, by_wheels = straight * 6, straight * 6
    axle = np.array([0.0, axle_m, 0.0])
    for sign in (1, -1) * 3:
        spin = np.array([0.0, 0.0, sign * turn])
        steps += [compose(compose(-axle, spin), axle)] * 10 + straight
        by_wheels += [spin] * 10 + straight
    truth = way((-6.0, 0.0, 0.0), steps)
    scans = scans_along(truth, [hall()] * len(truth))
    ahead = [scan if n <= 60 else seeing(scan, 30.0, 0.5) for n, scan in enumerate(scans)]
    assert worst_m(mapped_drive(ahead, way(ODOM, by_wheels)), truth) < 0.05
