"""A street round a block, driven twice by a robot that loses its way: places are found wherever they seem.

The lidar sees 3 m of what stands along the street. In a gap it sees one post or nothing, and the wheels turn
too far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flat_worlds import box, moved
from memory_drives import errors, mapped, mapped_drive, scans_along, way, wheels_at, worst_m

from slam.graph.place_search import PlaceSearch
from slam.graph.submaps import SubmapStore
from slam.mapper.map_result import MapResult
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, LaserScan, row_from_pose2

SIGHT_M, SIDE_STEPS, CORNER_STEPS, STEP_M = 3.0, 120, 10, 0.15
SIDE = [[STEP_M, 0.0, 0.0]] * SIDE_STEPS
CORNER = [[STEP_M, 0.0, 0.5 * np.pi / CORNER_STEPS]] * CORNER_STEPS
ROUND = [*SIDE, *CORNER] * 4
# From here the robot is blind for 6 m, in the middle of the second side.
GAP = slice(170, 210)


def boxes(seed: int, first_m: float, last_m: float) -> FloatArray:
    """What stands on both sides of a piece of a street along x, (N, 4) segments."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(int(6 * (last_m - first_m))):
        x, y = rng.uniform(first_m, last_m), rng.choice([-1.0, 1.0]) * rng.uniform(1.0, 2.5)
        width, depth = rng.uniform([0.15, 0.15], [0.6, 0.6])
        found.append(moved(box(0, 0, width, depth), (x, y, rng.uniform(0.0, 2.0 * np.pi))))
    return np.concatenate(found)


def streets(seeds: Sequence[Sequence[int]], truth: FloatArray) -> FloatArray:
    """Walls of the four sides, each in three pieces; pieces of the same seed look the same."""
    length_m, found = STEP_M * SIDE_STEPS, []
    for side, pieces in enumerate(seeds):
        start = truth[side * (SIDE_STEPS + CORNER_STEPS)]
        for n, seed in enumerate(pieces):
            piece = boxes(seed, 0.0, length_m / 3.0)
            found.append(moved(piece, compose(start, np.array([n * length_m / 3.0, 0.0, 0.0]))))
    return np.concatenate(found)


def seen_along(
    seeds: Sequence[Sequence[int]], steps: Sequence[Sequence[float]]
) -> tuple[list[LaserScan], FloatArray]:
    """The scans, and the true poses."""
    truth = way((0.0, 0.0, 0.0), steps)
    walls = streets(seeds, truth)
    near = [walls[np.hypot(*(walls[:, :2] - pose[:2]).T) < SIGHT_M + 1.0] for pose in truth]
    scans = [within_sight(scan) for scan in scans_along(truth, near, fov_rad=2.0 * np.pi, beams=361)]
    for n in range(GAP.start, GAP.stop):
        scans[n] = a_post(scans[n])
    return scans, truth


def within_sight(scan: LaserScan) -> LaserScan:
    return replace(scan, ranges_m=np.where(scan.ranges_m < SIGHT_M, scan.ranges_m, np.inf).astype(np.float32))


def a_post(scan: LaserScan) -> LaserScan:
    ranges_m = np.where(np.abs(np.arange(len(scan.ranges_m)) - 154) < 4, 1.0, np.inf)
    return replace(scan, ranges_m=ranges_m.astype(np.float32))


ALL_DIFFERENT = np.arange(12).reshape(4, 3).tolist()
# Twelve metres of the fourth side look as those of the first, to the last box.
LOOK_ALIKE = [[0, 1, 2], [3, 4, 5], [6, 7, 8], [1, 2, 11]]


def wrong_loops(result: MapResult, truth: FloatArray) -> list[float]:
    """By how far the accepted loops are off."""
    at = truth[result.map.readings]
    off = []
    for loop in result.map.loops:
        if loop.accepted and loop.motion is not None:
            claimed = row_from_pose2(loop.motion.T_reference_base)
            off.append(float(np.hypot(*between(between(at[loop.place], at[loop.keyframe]), claimed)[:2])))
    return [one for one in off if one > 0.3]


def test_a_chain_that_was_bent_closes_in_the_second_round(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [*ROUND, *ROUND[:SIDE_STEPS]]
    scans, truth = seen_along(ALL_DIFFERENT, steps)
    turned = np.array(steps)
    turned[GAP, 2] -= 0.7 / (GAP.stop - GAP.start)
    by_wheels = way((5.0, 1.0, -2.0), turned.tolist())
    stated = [(wheels_at(n, pose), scan) for n, (pose, scan) in enumerate(zip(by_wheels, scans, strict=True))]
    drive = [one for both in [*stated[: GAP.start], *stated[GAP.stop :]] for one in both]
    result = mapped(drive)
    assert worst_m(result, truth) < 0.7
    assert np.median(errors(result, truth)[:, 0]) < 0.1
    assert wrong_loops(result, np.delete(truth, GAP, axis=0)) == []
    monkeypatch.setattr(PlaceSearch, "search", lambda *_: [])
    alone = worst_m(mapped(drive), truth)
    assert alone > 5.0, "the estimate alone finds the place, too"


def test_places_are_drawn_apart_where_scans_matched_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scans, truth = seen_along(ALL_DIFFERENT[:2], ROUND[: GAP.stop + 20])
    apart, add = list[bool](), SubmapStore.add

    def spied(store: SubmapStore, *stated: Any, begun: bool) -> None:
        apart.append(begun)
        add(store, *stated, begun=begun)

    monkeypatch.setattr(SubmapStore, "add", spied)
    readings = mapped_drive(scans, truth).map.readings
    unmatched = {int(reading) for reading, begun in zip(readings, apart, strict=True) if begun}
    assert unmatched <= {0, *range(GAP.start, GAP.stop + 1)} and len(unmatched) > 3


def test_a_street_that_looks_like_another_closes_nothing() -> None:
    scans, truth = seen_along(LOOK_ALIKE, ROUND[:-40])
    assert wrong_loops(mapped_drive(scans, None), truth) == []


def test_who_may_have_turned_unseen_is_asked_which_way_the_corridor_is() -> None:
    """A bare corridor looks the same ahead and behind; the wheels have not counted what happened there."""
    ahead, unseen = 110, range(111, 191)
    turning = [[0.0, 0.0, np.pi / len(unseen)]] * len(unseen)
    truth = way((0.0, 0.0, 0.0), [*SIDE[:ahead], *turning, *SIDE[:ahead]])
    by_wheels = way((5.0, 1.0, -2.0), [*SIDE[:ahead], *[[0.0, 0.0, 0.0]] * len(unseen), *SIDE[:ahead]])
    walls = np.concatenate([[[-50.0, y, 50.0, y] for y in (-1.2, 1.2)], boxes(4, 0.0, 9.0)])
    scans = [within_sight(one) for one in scans_along(truth, [walls] * len(truth), fov_rad=2.0 * np.pi)]
    stated = [(wheels_at(n, pose), scan) for n, (pose, scan) in enumerate(zip(by_wheels, scans, strict=True))]
    result = mapped([one for n, both in enumerate(stated) for one in both[: 1 if n in unseen else 2]])
    assert worst_m(result, truth) < 0.5
