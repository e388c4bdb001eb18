"""What has changed between two visits of tiny rooms: what moved is found, and nothing else is."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from flat_worlds import box, clearance_m, room, sweep

from slam.config import Config
from slam.errors import ScanweaveError
from slam.measurements import FloatArray
from slam.sessions.changes import Change, Comparison, Visit, compare
from slam.sessions.moved_things import ChangedThing, changed_things

CHAIR = box(0.8, 0.6, 1.2, 1.0)
ELSEWHERE = box(-1.7, -1.4, -1.3, -1.0)
CONFIG = Config()


def visit(
    *worlds: FloatArray, sigma_m: float = 0.0, seed: int = 0, off: tuple[float, float] = (0.0, 0.0)
) -> Visit:
    """Sweeps from 24 places of the room, as many of each world; the stated poses are off by as much."""
    rng = np.random.default_rng(seed)
    everything = np.concatenate(worlds)
    poses: list[FloatArray] = []
    while len(poses) < 24:
        pose = rng.uniform((-2.5, -2.5, -math.pi), (2.5, 2.2, math.pi))
        # The first and the last worlds take turns, so that each is seen from everywhere.
        inside = min(pose[0] - 2.2, -1.5 - pose[1]) > -0.1
        if not inside and clearance_m(everything, pose[None, :2])[0] > 0.3:
            poses.append(pose)
    scans = [
        sweep(worlds[k % len(worlds)], pose, sigma_m=sigma_m, seed=rng, stamp_s=float(k))
        for k, pose in enumerate(poses)
    ]
    return Visit(scans, np.array(poses) + np.array([*off, 0.0]))


def compared(before: Visit, after: Visit, sigma_m: float = 0.01) -> Comparison:
    """Two visits whose poses are certain to a sigma."""
    return compare(before, after, lambda *_: np.diag([sigma_m**2, sigma_m**2]), CONFIG)


def likely(found: Comparison) -> list[Change]:
    """What is likelier than not."""
    return [change for change in found.changes if change.probability > 0.5]


def things(found: Comparison) -> list[ChangedThing]:
    """As text for people."""
    return changed_things(likely(found), found.resolution_m)


def with_(*more: FloatArray) -> FloatArray:
    """The room and things in it."""
    return np.concatenate([room(), *more])


def test_a_box_that_moved_is_one_thing_reported_with_its_way() -> None:
    found = things(compared(visit(with_(CHAIR)), visit(with_(ELSEWHERE), seed=1)))
    (thing,) = found
    assert thing.what == "moved"
    np.testing.assert_allclose(thing.places_m, [[1.0, 0.8], [-1.5, -1.2]], atol=0.05)
    np.testing.assert_allclose(thing.size_m, (0.4, 0.4), atol=0.051)
    assert thing.moved_m == pytest.approx(math.hypot(2.5, 2.0), abs=0.1)
    assert 0.5 < thing.probability < 1.0


@pytest.mark.parametrize(("before", "after", "what"), [((CHAIR,), (), "went"), ((), (CHAIR,), "appeared")])
def test_a_box_that_is_there_once_only(
    before: tuple[FloatArray, ...], after: tuple[FloatArray, ...], what: str
) -> None:
    (thing,) = things(compared(visit(with_(*before)), visit(with_(*after), seed=1)))
    assert thing.what == what
    assert (thing.after_m is None) == (what == "went")
    np.testing.assert_allclose(thing.places_m, [[1.0, 0.8]], atol=0.05)


def test_the_other_way_round_what_went_has_appeared() -> None:
    one, other = visit(with_(CHAIR)), visit(with_(), seed=1)
    (went,), (came,) = likely(compared(one, other)), likely(compared(other, one))
    assert (went.appeared, came.appeared) == (False, True)
    assert went.probability == pytest.approx(came.probability)
    np.testing.assert_array_equal(went.cells_m, came.cells_m)


@pytest.mark.parametrize("sigma_m", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("seed", range(3))
def test_noise_of_ranges_is_no_change(seed: int, sigma_m: float) -> None:
    world = with_(CHAIR)
    before, after = (visit(world, sigma_m=sigma_m, seed=10 * seed + n) for n in range(2))
    assert likely(compared(before, after)) == []


def test_a_wall_that_lies_elsewhere_by_the_error_of_poses_is_no_change() -> None:
    before, after = visit(with_(CHAIR)), visit(with_(CHAIR), seed=1, off=(0.12, -0.12))
    assert likely(compared(before, after, sigma_m=0.1)) == []
    # Poses that claim to be certain to a millimetre leave no other explanation.
    assert likely(compared(before, after, sigma_m=0.001)) != []


def test_what_the_other_visit_could_not_see_is_no_change() -> None:
    screen = np.array(
        [[0.3, 0.2, 0.3, 1.5], [0.3, 1.5, 1.6, 1.5], [1.6, 1.5, 1.6, 0.2], [1.6, 0.2, 0.3, 0.2]]
    )
    found = compared(visit(with_(CHAIR)), visit(with_(screen), seed=1))
    assert [change for change in found.changes if not change.appeared] == []
    assert found.seen_m2()[1] > 0.1


def test_somebody_who_walked_by_is_not_reported() -> None:
    found = compared(visit(with_(CHAIR), with_(), with_()), visit(with_(), seed=1))
    assert likely(found) == []
    # Where more than half of the scans met it, the grid has it, and it is known for what it is.
    found = compared(visit(with_(CHAIR), with_()), visit(with_(), seed=1))
    assert likely(found) == []
    assert [change.standing < 0.5 for change in found.changes] == [True]


def test_what_was_met_for_seconds_only_may_have_been_somebody() -> None:
    before, after = visit(with_(CHAIR)), visit(with_(), seed=1)
    brief = [replace(scan, stamp_s=0.5 * scan.stamp_s) for scan in before.scans if scan is not None]
    (change,) = compared(Visit(brief, before.poses), after).changes
    assert change.standing == 0.0
    # Nobody is that wide.
    sofa = visit(with_(box(-2.0, -2.5, -1.4, -1.0)))
    brief = [replace(scan, stamp_s=0.5 * scan.stamp_s) for scan in sofa.scans if scan is not None]
    (change,) = likely(compared(Visit(brief, sofa.poses), after))
    assert not change.appeared


def test_a_thing_that_returns_no_beam_has_not_gone() -> None:
    seen, black = visit(with_(CHAIR)), visit(with_(CHAIR), seed=1)
    scans = []
    for scan, pose in zip(black.scans, black.poses, strict=True):
        assert scan is not None
        met = scan.ranges_m < sweep(with_(), pose).ranges_m - 0.01
        scans.append(replace(scan, ranges_m=np.where(met, np.float32(np.inf), scan.ranges_m)))
    assert compared(seen, Visit(scans, black.poses)).changes == []


def test_what_fills_a_single_cell_is_noise() -> None:
    speck = box(0.81, 0.61, 0.84, 0.64)
    assert compared(visit(with_(speck)), visit(with_(), seed=1)).changes == []


def test_without_a_way_between_the_visits_nothing_is_reported() -> None:
    found = compared(visit(with_(CHAIR)), visit(with_(), seed=1), sigma_m=math.inf)
    assert [change.probability for change in found.changes] == [0.0]


def test_things_of_another_size_have_not_moved() -> None:
    sofa = box(-2.0, -2.5, -1.4, -1.0)
    found = things(compared(visit(with_(CHAIR)), visit(with_(sofa), seed=1)))
    assert sorted(thing.what for thing in found) == ["appeared", "went"]


def test_of_two_alike_each_has_moved_as_little_as_may_be() -> None:
    def at(x: float, y: float) -> FloatArray:
        return box(x - 0.2, y - 0.2, x + 0.2, y + 0.2)

    before = visit(with_(at(-1.8, 1.0), at(1.2, -0.8)))
    found = things(compared(before, visit(with_(at(-1.8, -0.5), at(1.2, 1.0)), seed=1)))
    assert [thing.what for thing in found] == ["moved", "moved"]
    assert max(thing.moved_m for thing in found) < 2.0


def test_a_visit_without_scans_is_refused() -> None:
    with pytest.raises(ScanweaveError, match="without lidar scans"):
        compared(visit(with_()), Visit([None], np.zeros((1, 3))))
