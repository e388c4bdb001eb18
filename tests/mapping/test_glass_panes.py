"""A pane of glass throws back only what meets it head on, and is in the map for that."""

import math
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy import ndimage

from fusion.depth_model import RangeNoise
from slam.mapping.glass_panes import head_on, in_straight_runs, straight_runs
from slam.mapping.occupancy_grid import OCCUPIED
from slam.measurements import LaserScan
from tools.layer_building import build_layers

NOISE = RangeNoise(0.01, share=0.005)
BEARINGS = np.linspace(-math.pi, math.pi, 721)[:-1]
PANE_Y = 1.02


def scan_at(x, heading=0.0, pane=(-1.0, 1.0), noise_m=0.0):
    """A room of 8 x 6 m with a pane across it, which is met within 8 degrees of the right angle only."""
    ways = np.column_stack([np.cos(BEARINGS + heading), np.sin(BEARINGS + heading)])
    with np.errstate(divide="ignore"):
        far = np.minimum(*((np.array([4.0, 3.0]) - np.sign(ways) * [x, 0.0]) / np.abs(ways)).T)
        to_pane = PANE_Y / ways[:, 1]
    meets = (to_pane > 0) & (ways[:, 1] > math.cos(math.radians(8.0)))
    meets &= (x + to_pane * ways[:, 0] > pane[0]) & (x + to_pane * ways[:, 0] < pane[1])
    ranges = np.where(meets, to_pane, far) + noise_m * np.random.default_rng(1).standard_normal(far.size)
    step = float(BEARINGS[1] - BEARINGS[0])
    return LaserScan(x, ranges.astype(np.float32), -math.pi, step, 12.0)


def driven(pane, heading=0.0):
    """The lidar's cells after a drive past the pane, and then away from it, where all beams go through."""
    at = [*np.arange(-1.5, 1.6, 0.1), *np.arange(-3.9, -2.5, 0.05), *np.arange(2.5, 3.9, 0.05)]
    poses = [gtsam.Pose2(x, 0.0, heading) for x in at]
    built = build_layers([scan_at(x, heading, pane) for x in at], poses)
    cells = built.lidar.cells_of(np.array([[x, PANE_Y] for x in np.arange(-0.95, 1.0, 0.05)]))
    return built.states("decision")[tuple(cells.T)] == OCCUPIED


@pytest.mark.parametrize("heading", [0.0, 1.0])
def test_a_pane_stands_though_most_beams_pass_it(heading):
    assert driven((-1.0, 1.0), heading).mean() > 0.9


def test_what_is_shorter_than_a_pane_goes_as_before():
    assert not driven((-0.15, 0.15))[5:-5].any()


def test_head_on_beams_are_those_that_meet_a_wall_at_a_right_angle():
    for noise_m in (0.0, 0.01):
        met = np.isfinite(head_on(scan_at(0.0, pane=(0.0, 0.0), noise_m=noise_m), NOISE, 0.055).ranges_m)
        to_wall = np.abs(np.remainder(BEARINGS + math.pi / 4, math.pi / 2) - math.pi / 4)
        across = np.abs(np.sin(BEARINGS)) > 0.9  # the walls 3 m away; the others are farther
        assert met[(to_wall < math.radians(8.0)) & across].all()
        assert not met[(to_wall > math.radians(14.0)) | ~across].any()
    lost = scan_at(0.0, pane=(0.0, 0.0))
    assert not np.isfinite(head_on(replace(lost, ranges_m=np.full(720, np.inf)), NOISE, 0.055).ranges_m).any()
    # A bush is not flat.
    rough_m = np.where(np.arange(720) % 2, 1.0, 1.2).astype(np.float32)
    assert not np.isfinite(head_on(replace(lost, ranges_m=rough_m), NOISE, 0.055).ranges_m).any()


@pytest.mark.parametrize("slope", [0.0, 0.4, 1.0, -0.4])
def test_runs_are_straight_and_long(slope):
    cells = np.zeros((60, 60), dtype=bool)
    columns = np.arange(10, 50)
    cells[np.rint(30 + slope * (columns - 30)).astype(int), columns] = True
    assert straight_runs(cells, 0.05).sum() >= 0.8 * cells.sum()
    cells[:, ::5] = False  # cut into pieces of 0.2 m
    assert not straight_runs(cells, 0.05).any()


def test_a_run_across_is_what_opening_by_it_leaves():
    rows = np.random.default_rng(5).random((41, 30)) < 0.7
    wide = ndimage.binary_dilation(rows, np.ones((3, 1)))
    assert not (rows & ndimage.binary_opening(wide, np.ones((1, 9))) & ~straight_runs(rows, 0.05)).any()
    lone = np.zeros((9, 40), np.bool_)
    lone[4, 2:11] = lone[0, 20:29] = True  # no longer than they must be, one at the rim
    assert (straight_runs(lone, 0.05) == lone).all()


def test_runs_are_found_band_by_band_as_in_the_whole_grid():
    rng = np.random.default_rng(3)
    cells = rng.random((700, 90)) < 0.05
    for row, column in rng.integers(0, (690, 80), (80, 2)):
        cells[row : row + 10, column] = True
    cells[250:263, 40] = cells[508:516, 7] = True  # across the seams of the bands
    numbers = np.flatnonzero(cells)
    found = in_straight_runs(numbers, cells.shape, 0.05)
    assert 500 < found.sum() < len(found)
    assert (found == straight_runs(cells, 0.05).ravel()[numbers]).all()
    assert not len(in_straight_runs(numbers[:0], cells.shape, 0.05))
