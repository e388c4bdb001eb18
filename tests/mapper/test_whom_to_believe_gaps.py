"""Whom the mapper believes after a blind gap, when keyframes in between were guessed, judged by the map.

A garden full of boxes, and a lidar that sees 2.5 or 3 m of it all around: places apart share nothing. In a
gap the lidar is blind, or sees a single post, which matches nothing.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_worlds import box, moved
from memory_drives import errors, mapped_drive, scans_along, way, worst_m

from slam.comparison.methods import ODOMETRIES
from slam.mapper.map_result import MapResult
from slam.measurements import FloatArray, LaserScan
from slam.odometry import STANDARD, Odometries

ODOM = (5.0, 1.0, -2.0)  # where the wheels' frame happens to begin
BEAMS = 361


def garden(path: FloatArray) -> FloatArray:
    """Boxes anywhere within 8 m, none nearer to the path than 0.6 m, and a wall around."""
    rng = np.random.default_rng(1)
    found = [box(-8, -8, 8, 8)]
    for _ in range(420):
        x, y, width, depth = rng.uniform([-8, -8, 0.15, 0.15], [8, 8, 0.6, 0.6])
        corners = moved(box(0, 0, width, depth), (x, y, rng.uniform(0.0, 2.0 * np.pi)))
        if np.hypot(*(path[:, :2] - corners[:, :2].mean(axis=0)).T).min() > 0.6:
            found.append(corners)
    return np.concatenate(found)


def seen_along(truth: FloatArray, range_m: float) -> list[LaserScan]:
    """What the lidar sees on a clear day, as far as it sees."""
    walls = garden(truth)
    away_m = np.hypot(*(walls[:, None, :2] - truth[None, :, :2]).transpose(2, 0, 1))
    worlds = [walls[(near < range_m + 1.0) | (np.arange(len(walls)) < 4)] for near in away_m.T]
    scans = scans_along(truth, worlds, fov_rad=2.0 * np.pi, beams=BEAMS)
    return [with_ranges(scan, np.where(scan.ranges_m < range_m, scan.ranges_m, np.inf)) for scan in scans]


def with_ranges(scan: LaserScan, ranges_m: FloatArray) -> LaserScan:
    return replace(scan, ranges_m=ranges_m.astype(np.float32))


def a_post(scan: LaserScan) -> LaserScan:
    """In thick fog: eight beams of one thing, no two alike in where they were taken."""
    return with_ranges(scan, np.where(np.abs(np.arange(BEAMS) - 154) < 4, 1.0, np.inf))


def nothing(scan: LaserScan) -> LaserScan:
    return with_ranges(scan, np.full(BEAMS, np.inf))


ROUND_STEPS = np.tile([0.1, 0.0, 0.04], (190, 1))
ROUND = way((2.5, 0.0, 0.5 * np.pi), list(ROUND_STEPS))


@pytest.fixture(scope="module")
def clear() -> list[LaserScan]:
    """The scans of the way around."""
    return seen_along(ROUND, 3.0)


class TestAroundTheGarden:
    """Once around 2.5 m from the middle, and a bit; from scan 60 a gap in which the wheels drift."""

    BEGIN = 60

    def around(
        self,
        clear: list[LaserScan],
        gap: int,
        drift_rad: float,
        *overrides: str,
        crowded: int = 0,
        beams: int = 0,
    ) -> MapResult:
        """The map; in so many scans after the gap people hide so many beams."""
        by_wheels, scans, rng = ROUND_STEPS.copy(), list(clear), np.random.default_rng(7)
        by_wheels[self.BEGIN : self.BEGIN + gap, 2] += drift_rad / gap
        for n in range(self.BEGIN, self.BEGIN + gap):
            scans[n] = a_post(scans[n])
        for n in range(self.BEGIN + gap, self.BEGIN + gap + crowded):
            people_m = np.repeat(rng.uniform(0.4, 1.2, beams // 6 + 1), 6)[:beams]
            scans[n] = with_ranges(scans[n], np.concatenate([people_m, scans[n].ranges_m[beams:]]))
        return mapped_drive(scans, way(ODOM, list(by_wheels)), *overrides)

    def test_without_a_gap(self, clear: list[LaserScan]) -> None:
        result = self.around(clear, 1, 0.0)
        assert worst_m(result, ROUND) < 0.03
        assert sum(loop.accepted for loop in result.map.loops) >= 3

    @pytest.mark.parametrize("gap", [4, 8])
    def test_a_match_to_what_was_seen_before_a_short_gap_bridges_it(
        self, clear: list[LaserScan], gap: int
    ) -> None:
        """No loop can mend it here: the gap is as exact as the match, not as the wheels."""
        result = self.around(clear, gap, 0.15, "loops.enabled=false")
        assert worst_m(result, ROUND) < 0.06

    @pytest.mark.parametrize("drift_rad", [0.15, 0.3])
    @pytest.mark.parametrize("gap", [25, 40])
    def test_after_a_long_gap_a_match_is_to_what_was_guessed(
        self, clear: list[LaserScan], gap: int, drift_rad: float
    ) -> None:
        """It agrees with the wheels, since they made the guess; the loop is right, and is to be believed."""
        result = self.around(clear, gap, drift_rad)
        assert worst_m(result, ROUND) < 0.08
        assert any(loop.accepted for loop in result.map.loops)

    @pytest.mark.parametrize(("gap", "beams"), [(10, 100), (12, 100), (12, 140)])
    def test_a_doubtful_match_after_a_gap_yields_to_the_loop(
        self, clear: list[LaserScan], gap: int, beams: int
    ) -> None:
        """People hide a third of the view when the robot sees again."""
        result = self.around(clear, gap, 0.3, crowded=24 - gap, beams=beams)
        assert errors(result, ROUND).max(axis=0) == pytest.approx([0.0, 0.0], abs=0.1)


class TestWheelsThatHadLostTheirSign:
    """The wheels count backward for 50 scans, and are right in the gap and after it; the robot is in a turn.

    So the pose after the gap is guessed from the last velocity. What is seen then matches nothing of before,
    but the next scan matches this one, and surely: a motion that is true, from a place that is not.
    """

    BEFORE, GAP, AFTER = 50, 12, 30

    @pytest.mark.parametrize(
        ("odometries", "step_m", "turn_rad"),
        [
            (STANDARD, 0.12, 1.2),
            (STANDARD, 0.12, 1.6),
            (STANDARD, 0.15, 1.6),
            (ODOMETRIES["kiss_matching"], 0.12, 1.2),
            (ODOMETRIES["kiss_matching"], 0.12, 1.6),
        ],
    )
    def test_the_wheels_show_the_gap(self, odometries: Odometries, step_m: float, turn_rad: float) -> None:
        steps = np.tile([step_m, 0.0, 0.0], (self.BEFORE + self.GAP + self.AFTER, 1))
        steps[self.BEFORE : self.BEFORE + self.GAP, 2] = turn_rad / self.GAP
        by_wheels = steps.copy()
        by_wheels[: self.BEFORE, 0] *= -1.0
        truth = way((-6.0, -3.0, 0.0), list(steps))
        scans = seen_along(truth, 2.5)
        for n in range(self.BEFORE + 1, self.BEFORE + self.GAP):
            scans[n] = nothing(scans[n])
        result = mapped_drive(scans, way(ODOM, list(by_wheels)), odometries=odometries)
        assert worst_m(result, truth) < 0.1
