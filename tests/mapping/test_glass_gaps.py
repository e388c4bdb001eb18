"""Gaps in walls in which beams are lost are glass; doorways and what is dark behind them are not."""

import math

import numpy as np
import pytest

from slam.config import Config
from slam.mapping.glass_gaps import glass_gaps, with_glass
from slam.mapping.keyframe_grid import grid_of_keyframes
from slam.mapping.occupancy_grid import OCCUPIED
from slam.measurements import LaserScan

BEARINGS = np.linspace(-math.pi, math.pi, 721)[:-1]
# Rows of x1, y1, x2, y2: a room, and a wall of 0.1 m across it with a gap of 1.2 m.
ROOM = [(-4.0, -1.5, 4.0, -1.5), (4.0, -1.5, 4.0, 4.0), (4.0, 4.0, -4.0, 4.0), (-4.0, 4.0, -4.0, -1.5)]
ACROSS = [(side * 4.0, y, side * 0.6, y) for side in (-1, 1) for y in (1.0, 1.1)]
JAMBS = [(side * 0.6, 1.0, side * 0.6, 1.1) for side in (-1, 1)]
WALLS = np.array([*ROOM, *ACROSS, *JAMBS])
DARK = [(-0.2, 1.3, 0.2, 1.3)]
WAY = np.array([[x, 0.0, 0.3] for x in np.arange(-2.5, 2.6, 0.25)])


def scan_at(pose, lost_in_gap=0.0, lost_behind=0.0, from_x=-1.0, dark=(), rough_m=0.005):
    """A sweep that loses a share of the beams through the gap, from there on, and of all that end behind.

    Behind, ranges scatter by ``rough_m``; dark things, rows as of walls, lose three quarters of the beams.
    """
    x, y, heading = pose
    along = np.column_stack([np.cos(BEARINGS + heading), np.sin(BEARINGS + heading)])
    walls = np.array([*WALLS, *dark])
    way = walls[:, 2:] - walls[:, :2]
    to = walls[:, :2] - (x, y)
    across = along[:, :1] * way[:, 1] - along[:, 1:] * way[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (to[:, 0] * way[:, 1] - to[:, 1] * way[:, 0]) / across
        share = (to[:, 0] * along[:, 1:] - to[:, 1] * along[:, :1]) / across
    far[~((far > 0.0) & (share >= 0.0) & (share <= 1.0))] = np.inf
    ranges = far.min(axis=1)
    in_gap = (y < 1.0) & (along[:, 1] > 0.0) & (y + ranges * along[:, 1] > 1.2)
    random = np.random.default_rng(int(100 * (x + 10.0 * y) + 5000))
    with np.errstate(divide="ignore", invalid="ignore"):
        in_gap &= x + (1.0 - y) / along[:, 1] * along[:, 0] > from_x
    lost = in_gap & (random.random(ranges.size) < lost_in_gap)
    lost |= (y + ranges * along[:, 1] > 1.2) & (random.random(ranges.size) < lost_behind)
    noisy = ranges + np.where(y + ranges * along[:, 1] > 1.2, rough_m, 0.005) * random.standard_normal(
        ranges.size
    )
    lost |= (far.argmin(axis=1) >= len(WALLS)) & (random.random(ranges.size) < 0.75)
    scan = np.where(lost, np.inf, noisy).astype(np.float32)
    return LaserScan(x + 10.0 * y, scan, -math.pi, float(BEARINGS[1] - BEARINGS[0]), 12.0)


def mapped(way=WAY, **lost):
    """The grid of a drive, its scans and the gaps of glass."""
    config = Config()
    scans = [scan_at(pose, **lost) for pose in way]
    grid = grid_of_keyframes(scans, way, config)
    assert grid is not None
    return grid, scans, glass_gaps(grid, scans, way, config)


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_a_gap_that_loses_beams_all_along_is_closed(share):
    grid, scans, gaps = mapped(lost_in_gap=share)
    assert gaps
    for gap in gaps:
        ends = sorted([gap.begin_m, gap.end_m], key=lambda end: end[0])
        np.testing.assert_allclose([ends[0][0], ends[1][0]], [-0.6, 0.6], atol=0.1)
    middle = np.column_stack([np.arange(-0.5, 0.55, 0.05), np.full(21, 1.02)])
    cells = tuple(grid.cells_of(middle).T)
    assert not (grid.states()[cells] == OCCUPIED).any()
    assert (with_glass(grid, scans, WAY, Config()).states()[cells] == OCCUPIED).all()


def test_glass_is_found_where_no_straight_wall_is_seen_behind_it():
    assert mapped(lost_in_gap=0.4, rough_m=0.1)[2]
    assert mapped(rough_m=0.1)[2] == []


def test_a_doorway_stays_open():
    grid, scans, gaps = mapped()
    assert gaps == []
    assert with_glass(grid, scans, WAY, Config()) is grid


def test_lone_losses_are_no_glass():
    assert mapped(lost_in_gap=0.05)[2] == []


def test_what_is_dark_behind_a_doorway_is_no_glass():
    # It loses as many beams that do not come through the door.
    behind = np.array([[x, 2.0, 0.3] for x in np.arange(3.4, 2.0, -0.1)])
    assert mapped(np.concatenate([WAY, behind]), lost_behind=0.5)[2] == []


def test_one_dark_thing_that_is_seen_through_a_doorway_alone_is_no_glass():
    assert mapped(dark=DARK)[2] == []


def test_what_is_lost_in_a_part_of_it_is_no_glass():
    assert mapped(lost_in_gap=0.9, from_x=0.0)[2] == []


def test_what_was_driven_through_is_open():
    through = np.array([[0.0, y, 1.3] for y in np.arange(0.2, 2.0, 0.2)])
    assert mapped(np.concatenate([WAY, through]), lost_in_gap=0.6)[2] == []
