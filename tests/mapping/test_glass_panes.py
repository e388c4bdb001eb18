"""A pane of glass comes back near its normal only, and stays in the grid when later scans pass it."""

import math

import gtsam
import numpy as np
import pytest

from fusion.bayes import FREE, OCCUPIED
from slam.mapping.glass_panes import find_panes
from slam.mapping.layer_builder import build_layers
from slam.measurements import LaserScan

STEP = math.radians(0.35)
BEARINGS = -math.pi + STEP * np.arange(1028)
SEEN_RAD = math.radians(8.0)
WALL_M = 2.02  # within a row of cells


def sweep(stamp, x, lost=0.5, right_m=-0.8, left_m=0.8, glass=True, person=False):
    """From (x, 0): a wall in the plane y = WALL_M with a pane in it, a wall at y = 5 behind, nothing else.

    Beams meet the pane where it returns them, else they are lost or go through.
    """
    rng = np.random.default_rng(int(stamp))
    with np.errstate(divide="ignore", invalid="ignore"):
        near = np.where(np.sin(BEARINGS) > 0.05, WALL_M / np.sin(BEARINGS), np.inf)
        at = x + near * np.cos(BEARINGS)
        through = (
            (right_m < at) & (at < left_m) & (abs(BEARINGS - math.pi / 2) > (SEEN_RAD if glass else 0.0))
        )
        ranges = np.where(through, np.where(rng.random(at.size) < lost, np.inf, 2.5 * near), near)
    if person:
        off = BEARINGS - math.pi / 2
        chord = np.where(abs(off) < 0.14, 1.5 - np.sqrt(np.maximum(0.2**2 - (1.5 * off) ** 2, 0.0)), np.inf)
        ranges = np.minimum(ranges, chord)
    ranges = ranges + rng.normal(0.0, 0.004, at.size)
    return LaserScan(stamp, ranges.astype(np.float32), -math.pi, STEP, 12.0)


def test_a_pane_is_found_and_followed_to_its_frame():
    (pane,) = find_panes(sweep(0.0, 0.2))
    assert pane.bearing_rad == pytest.approx(math.pi / 2, abs=0.02)
    assert pane.distance_m == pytest.approx(WALL_M, abs=0.01)
    # Counter-clockwise from the foot is towards smaller x.
    assert (pane.left_m, pane.right_m) == pytest.approx((1.0, -0.6), abs=0.06)
    points = pane.points(0.05)
    assert np.allclose(points[:, 1], WALL_M, atol=0.04) and points[:, 0].min() == pytest.approx(
        -1.0, abs=0.06
    )


def test_a_clockwise_sweep_finds_the_same():
    scan = sweep(0.0, 0.2)
    turned = LaserScan(0.0, scan.ranges_m[::-1].copy(), float(BEARINGS[-1]), -STEP, 12.0)
    assert np.allclose(find_panes(scan)[0], find_panes(turned)[0])


def test_an_open_door_beside_it_is_not_closed_and_no_wall_or_person_is_a_pane():
    (pane,) = find_panes(sweep(0.0, 0.2, lost=0.02))
    assert pane.left_m == pytest.approx(WALL_M * math.tan(SEEN_RAD), abs=0.05)
    assert find_panes(sweep(0.0, 0.2, left_m=-0.8)) == []  # wall throughout
    assert find_panes(sweep(0.0, 0.2, glass=False)) == []  # an open door
    assert find_panes(sweep(0.0, 0.2, glass=False, person=True)) == []


def state(scans, poses, x):
    built = build_layers(scans, poses)
    row, col = built.grid("lidar").cells_of(np.array([[x, WALL_M]]))[0]
    return built.states("lidar")[row, col]


@pytest.mark.parametrize("order", [1, -1])
def test_a_pane_stays_when_others_pass_it_at_a_slant(order):
    away = [-1.6 + 0.02 * k for k in range(20)]
    xs = [0.0, *away]
    scans = [sweep(float(k), x) for k, x in enumerate(xs)][::order]
    poses = [gtsam.Pose2(x, 0.0, 0.0) for x in xs][::order]
    for at in (-0.5, 0.0, 0.5):
        assert state(scans, poses, at) == OCCUPIED
    scans = [sweep(float(k), x, glass=False) for k, x in enumerate(xs)][::order]
    assert state(scans, poses, 0.0) == FREE
