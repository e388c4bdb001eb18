"""What stood for a while and was passed before or since is not in the grid, but beside it; the rest stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flat_worlds import box, room, sweep
from scipy import ndimage
from test_glass_panes import PANE_Y, scan_at

from slam.config import Config
from slam.mapping.keyframe_grid import lidar_grids
from slam.mapping.layered_map import OCCUPANCY, PASSED_BY
from slam.mapping.occupancy_grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from slam.mapping.passers_by import components_of
from slam.measurements import FloatArray, LaserScan

PERSON = box(0.8, 0.8, 1.2, 1.2)
# Round and round a ring of half a metre, once with something there and once without.
RING = [np.array([0.5 * np.cos(at), 0.5 * np.sin(at), at]) for at in np.linspace(0, 2 * np.pi, 24)]


def seen(*worlds: FloatArray) -> dict[str, OccupancyGrid]:
    """Grids of a round in each world after the other."""
    scans = [
        sweep(world, pose, beams=721, sigma_m=0.005, seed=number, stamp_s=float(number))
        for number, (world, pose) in enumerate((world, pose) for world in worlds for pose in RING)
    ]
    return lidar_grids(scans, np.array(RING * len(worlds)), Config())


def states_in(grid: OccupancyGrid, area: FloatArray) -> set[int]:
    """States of the cells of a square, and of those beside."""
    low, high = (
        grid.cells_of(area.reshape(-1, 2)).min(axis=0) - 1,
        grid.cells_of(area.reshape(-1, 2)).max(axis=0) + 2,
    )
    return set(grid.states()[low[0] : high[0], low[1] : high[1]].ravel().tolist())


def with_(thing: FloatArray) -> FloatArray:
    return np.concatenate([room(), thing])


def test_who_stood_and_went_is_not_in_the_grid_but_beside_it() -> None:
    grids = seen(with_(PERSON), room())
    assert states_in(grids[OCCUPANCY], PERSON) == {FREE}
    assert OCCUPIED in states_in(grids[PASSED_BY], PERSON)
    empty = seen(room(), room())[OCCUPANCY].states() == OCCUPIED
    assert (grids[OCCUPANCY].states() == OCCUPIED)[empty].mean() > 0.95


def test_what_stands_stays() -> None:
    grids = seen(*(with_(PERSON),) * 2)
    assert PASSED_BY not in grids
    assert OCCUPIED in states_in(grids[OCCUPANCY], PERSON)


def test_who_came_last_is_not_in_the_grid_and_nobody_knows_whether_he_is_still_there() -> None:
    grids = seen(room(), with_(PERSON))
    stood = grids[PASSED_BY].states() == OCCUPIED
    assert stood.any()
    assert set(grids[OCCUPANCY].states()[stood].tolist()) == {UNKNOWN}
    assert OCCUPIED not in states_in(grids[OCCUPANCY], PERSON)


@pytest.mark.parametrize(
    ("there", "gone"),
    [
        ([1] * 12 + [0] * 10, True),
        ([0] * 10 + [1] * 12, True),
        ([0] * 5 + [1] * 12 + [0] * 5, True),
        ([1] * 12 + [0] * 3, False),  # too few to decide
        ([1, 0] * 12 + [0] * 6, False),  # as a thin leg is met
    ],
)
def test_passes_count_against_the_share_of_hits(there: list[int], gone: bool) -> None:
    scans: list[LaserScan | None] = [
        sweep(with_(PERSON) if one else room(), np.zeros(3), beams=721, stamp_s=float(number))
        for number, one in enumerate(there)
    ]
    grids = lidar_grids(scans, np.zeros((len(scans), 3)), Config())
    assert (PASSED_BY in grids) is gone
    assert (OCCUPIED in states_in(grids[OCCUPANCY], PERSON)) is not gone


def test_a_pane_stays_that_most_beams_pass() -> None:
    at = [*np.arange(-1.5, 1.6, 0.1), *np.arange(2.5, 3.9, 0.05), *np.arange(-3.9, -2.5, 0.05)]
    scans: list[LaserScan | None] = [replace(scan_at(x), stamp_s=float(n)) for n, x in enumerate(at)]
    grids = lidar_grids(scans, np.array([[x, 0.0, 0.0] for x in at]), Config())
    grid = grids[OCCUPANCY]
    cells = grid.cells_of(np.array([[x, PANE_Y] for x in np.arange(-0.9, 0.9, 0.05)]))
    assert (grid.states()[tuple(cells.T)] == OCCUPIED).mean() > 0.8


def test_an_empty_log_has_no_grid() -> None:
    assert lidar_grids([None, None], np.zeros((2, 3)), Config()) == {}


def test_things_are_those_of_a_labelled_picture() -> None:
    occupied = np.random.default_rng(1).random((80, 50)) < 0.3
    cells = np.flatnonzero(occupied)
    labels = ndimage.label(occupied, np.ones((3, 3)))[0].ravel()[cells]
    pairs = set(zip(labels.tolist(), components_of(cells, 50).tolist(), strict=True))
    assert len(pairs) == len(set(labels.tolist())) == len({thing for _, thing in pairs}) > 20
