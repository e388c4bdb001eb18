"""A claim that one wrong step explains is distinguished from one that none does."""

from collections.abc import Sequence
from types import SimpleNamespace

import numpy as np
import pytest

from fusion.estimation import gate
from slam.config.stages import GraphConfig, LoopConfig, MatchConfig
from slam.estimates import MotionEstimate
from slam.graph.edge import Edge, EdgeKind
from slam.graph.faulty_steps import FaultySteps, believed_edges
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.place_search import PlaceSearch
from slam.mapper.planar_chain import edges_of
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row
from tests.drawn_chain import BY_WHEELS, COUNT, GAP, POSES, STEP, SURE, chain, step, walked


def judge(edges: list[Edge], stamps_s: FloatArray) -> FaultySteps:
    kept = np.ones(len(edges), np.bool_)
    return FaultySteps(edges, kept, POSES, stamps_s, GraphConfig(), LoopConfig(), MatchConfig())


def squares(
    gaps: tuple[int, ...],
    claimed: FloatArray,
    loops: Sequence[tuple[int, int]] = (),
    gap_s: float = 30.0,
) -> float:
    edges = chain(gaps)
    for n, (place, key) in enumerate(loops):
        stated = pose2_from_row(between(POSES[place], POSES[key]))
        edges.append(Edge(place, key, stated, SURE, EdgeKind.LOOP, trusted=False, loop=n))
    stamps_s = np.arange(float(COUNT))
    for key in gaps:
        stamps_s[key + 1 :] += gap_s
    faulty = judge(edges, stamps_s)
    known = Motion(between(POSES[5], POSES[70]), np.diag([0.3, 0.3, 0.03]) ** 2)
    return faulty.explain(5, 70, known, Motion(claimed, SURE))[2]


def bent(*turns: tuple[int, float]) -> FloatArray:
    """The claim where some steps have turned otherwise."""
    steps = [STEP.copy() for _ in range(COUNT - 1)]
    for key, turn in turns:
        steps[key][2] += turn
    poses = walked(steps)
    return between(poses[5], poses[70])


OPEN = np.diag([900.0, 1e-6, 1e-6])


def test_of_ends_that_nothing_joins_no_fault_shows_anything() -> None:
    faulty, nowhere = judge(chain(), np.arange(float(COUNT))), Motion(np.zeros(3), np.full((3, 3), np.inf))
    assert faulty.shared(5, 70, nowhere, Motion(bent(), SURE))[0] == np.inf


def test_faults_that_cost_more_than_is_asked_for_are_not_sought() -> None:
    gaps, claimed = (GAP, 60), Motion(bent((GAP, 1.2), (60, -0.9)), SURE)
    faulty = judge(chain(gaps), np.arange(float(COUNT)) + 30.0 * (np.arange(COUNT) > GAP))
    known = Motion(between(POSES[5], POSES[70]), np.diag([0.3, 0.3, 0.03]) ** 2)
    cost, led = faulty.shared(5, 70, known, claimed)
    assert gate(3) < cost < 2.0 * gate(3)
    again = faulty.shared(5, 70, known, claimed, cost + 1e-6)
    assert again[0] == cost and np.array_equal(again[1], led)
    assert faulty.shared(5, 70, known, claimed, cost - 1e-6)[0] >= cost - 1e-6
    assert faulty.shared(5, 70, known, claimed, 0.5 * gate(3))[0] == np.inf


def test_a_turn_in_the_gap_explains_a_claim_however_far_that_leads() -> None:
    assert np.hypot(*(bent((GAP, 1.2)) - bent())[:2]) > 15.0
    assert squares((GAP,), bent((GAP, 1.2))) < 4.0
    assert squares((20,), bent((GAP, 1.2))) > gate(3)
    assert squares((), bent()) == np.inf


@pytest.mark.parametrize("gaps", [(GAP,), ()])
def test_two_sets_do_not_contradict_where_a_gap_between_their_places_may_be_wrong(
    gaps: tuple[int, ...],
) -> None:
    closer = type("NoSubmaps", (), {"submaps": None})()
    search = PlaceSearch(closer, LoopConfig(), MatchConfig(), GraphConfig())  # type: ignore[arg-type]
    edges, stamps_s = chain(gaps), np.arange(float(COUNT))
    stamps_s[GAP + 1 :] += 30.0 * len(gaps)
    search._faulty = judge(edges, stamps_s)

    def known(start: int, end: int) -> Motion:
        return Motion(between(POSES[start], POSES[end]), np.diag([0.3, 0.3, 0.03]) ** 2)

    entailed = 5, 70, Motion(bent((GAP, 1.2)), SURE)
    assert (search._contradiction(entailed, known) < 2.0 * gate(3)) == bool(gaps)
    assert search._contradiction(None, known) == 0.0


@pytest.mark.parametrize("lone", [True, False])
def test_what_wheels_claim_of_a_lone_step_may_be_wrong_at_a_gate(lone: bool) -> None:
    """It is off by twelve of the sigmas that they claim, where a match says so by as many of its own."""
    claim, free = np.diag([0.1, 0.1, 0.1]) ** 2, np.diag([1.0, 1.0, 0.5]) ** 2
    edges = [edge for edge in chain() if edge.source != GAP]
    if lone:
        edges.append(step(GAP, 0.01 * claim, EdgeKind.WHEEL, trusted=False))
        edges.append(step(GAP, claim, EdgeKind.ASSUMED, trusted=False))
        edges.append(step(GAP, claim + free, EdgeKind.ASSUMED, trusted=True))
    else:
        edges.append(step(GAP, claim, EdgeKind.LIDAR, trusted=True))
    known = Motion(between(POSES[5], POSES[70]), np.diag([0.3, 0.3, 0.03]) ** 2)
    faulty = judge(edges, np.arange(float(COUNT)) + 30.0 * (np.arange(COUNT) > GAP))
    left = faulty.explain(5, 70, known, Motion(bent((GAP, 1.2)), SURE))[2]
    assert (gate(3) < left < 3.0 * gate(3)) if lone else left > 10.0 * gate(3)


def test_a_step_is_not_wrong_where_loops_on_both_sides_show_it() -> None:
    """Were it wrong, so were the second gap."""
    gaps, claimed = (GAP, 60), bent((GAP, 1.2))
    assert squares(gaps, claimed) < 4.0
    assert squares(gaps, claimed, [(30 - n, 75 - n) for n in range(4)]) > 20.0
    assert squares(gaps, claimed, [(30, 38), (45, 58)]) < 4.0


@pytest.mark.parametrize(("far_m", "gap_s"), [(20.0, 15.0), (5.0, 0.2)])
def test_no_step_is_farther_than_a_robot_goes_in_its_time(far_m: float, gap_s: float) -> None:
    """However long the gap, nothing else is uncertain enough for the rest."""
    claimed = bent() + np.array([far_m, 0.0, 0.0])
    assert squares((GAP,), claimed, gap_s=gap_s) == np.inf
    assert squares((GAP,), claimed, gap_s=2.0 * far_m) < np.inf


def test_a_match_past_a_gap_may_have_missed_a_corner_but_that_is_not_free() -> None:
    """Of 25 s; as wrong as in a second alone it would be asked 62."""
    match, wheels = Motion(STEP, SURE), Motion(STEP, BY_WHEELS)
    edges = chain()[:GAP] + chain()[GAP + 1 :]
    edges += edges_of(GAP + 1, STEP, match, wheels, [], GraphConfig(), 25.0, match_doubtful=True)
    went = walked([STEP] * GAP + [np.array([6.0, 6.0, 1.2])] + [STEP] * (COUNT - GAP - 2))
    faulty = judge(edges, np.arange(float(COUNT)) + 25.0 * (np.arange(COUNT) > GAP))
    known = Motion(between(POSES[5], POSES[70]), np.diag([0.3, 0.3, 0.03]) ** 2)
    asked = faulty.explain(5, 70, known, Motion(between(went[5], went[70]), SURE))[2]
    assert 5.0 < asked < gate(3)


@pytest.mark.parametrize("turn", [0.0, 0.9])
@pytest.mark.parametrize("by_wheels", [True, False])
def test_wheels_count_where_a_match_leaves_the_corridor_open(by_wheels: bool, turn: float) -> None:
    """Campus 105: of a corridor that looks the same 35 m before, past a gap of 21 s, 5 was asked in all.

    A heading that slips in the gap also leads elsewhere, and costs little (campus 61).
    """
    edges = [edge for edge in chain() if edge.source != GAP]
    edges.append(step(GAP, np.diag([30.0, 1.0, 0.01]) ** 2, EdgeKind.LIDAR, trusted=False))
    edges.append(step(GAP, np.diag([21.0, 21.0, 10.0]) ** 2, EdgeKind.ASSUMED, trusted=True))
    edges += [step(GAP, np.diag([2.3, 11.0, 1.0]) ** 2, EdgeKind.WHEEL, trusted=False)] * by_wheels
    off = np.array([-6.0, 4.0, turn] if turn else [-15.0, 0.0, 0.0])
    went = walked([STEP] * GAP + [STEP + off] + [STEP] * (COUNT - GAP - 2))
    faulty = judge(edges, np.arange(float(COUNT)) + 21.0 * (np.arange(COUNT) > GAP))
    known = Motion(between(POSES[5], POSES[70]), np.diag([0.3, 0.3, 0.03]) ** 2)
    asked = faulty.explain(5, 70, known, Motion(between(went[5], went[70]), SURE))[2]
    assert asked > gate(3) if by_wheels and not turn else asked < gate(3)


def test_that_a_step_was_wrong_costs_what_such_steps_have_shown() -> None:
    """However far that throws what lies behind; were it as certain as wheels are, hundreds of nats."""
    tight = step(GAP, SURE, EdgeKind.WHEEL, trusted=False)
    edges, loose = chain(), step(GAP, BY_WHEELS, EdgeKind.ASSUMED, trusted=True)
    edges[GAP] = loose
    edges.append(tight)
    stamps_s = np.arange(float(COUNT)) + 30.0 * (np.arange(COUNT) > GAP)
    faulty = judge(edges, stamps_s)
    assert np.flatnonzero(faulty.lone.unseen).tolist() == [GAP]
    assert faulty.lone.share == pytest.approx(0.5), "no wheel step has shown anything"
    known, claimed = Motion(bent(), np.diag([0.1, 0.1, 0.02]) ** 2), bent((GAP, 1.2))
    assert -8.0 < faulty.likelihood(5, 70, known, Motion(claimed, SURE)) < 0.0
    assert known.squared_mahalanobis(claimed) > 1000.0
    far = claimed + np.array([100.0, 0.0, 0.0])
    assert faulty.likelihood(5, 70, known, Motion(far, SURE)) == -np.inf


@pytest.mark.parametrize("repeats", [True, False])
def test_a_fault_is_not_believed_where_places_look_like_their_neighbours(repeats: bool) -> None:
    """Claims across the gap agree that it was wrong; what follows from them fits within a matched run."""
    edges, steps = chain(), [STEP.copy() for _ in range(COUNT - 1)]
    steps[GAP][2] += 1.2
    turned = walked(steps)

    def claim(place: int, key: int, pose: FloatArray) -> LoopCandidate:
        motion = MotionEstimate(pose2_from_row(pose), SURE, 0.9, 0.9, 0.01, True, False, np.zeros(3))
        return LoopCandidate(place, key, 0.0, 0.0, 1.0, motion, True, "")

    across = [claim(key - 12, key, between(turned[key - 12], turned[key])) for key in range(42, 54)]
    members, entailed = across[::2], across[1::2]
    if repeats:
        entailed = [claim(key - 12, key, np.zeros(3)) for key in range(12, 40)]
    search = PlaceSearch(SimpleNamespace(submaps=None), LoopConfig(), MatchConfig(), GraphConfig())  # type: ignore[arg-type]
    search._submaps = SimpleNamespace(travelled_m=float)  # type: ignore[assignment]
    search._stretches = SimpleNamespace(spacing_m=1.5)  # type: ignore[assignment]
    search._sets = SimpleNamespace(largest=lambda: [members], remove=len)  # type: ignore[assignment]
    search._trial = SimpleNamespace(hold=lambda _: (entailed, 0), contradicted=lambda _: 0.0)  # type: ignore[assignment]
    stamps_s = np.arange(float(COUNT)) + 30.0 * (np.arange(COUNT) > GAP)
    search._faulty = judge(edges, stamps_s)
    believed = search._believed(POSES, search._faulty.known)
    assert believed == ([] if repeats else [*members, *entailed])


def stated_by(turned: Sequence[FloatArray], keys: range) -> list[LoopCandidate]:
    """Claims at 32 keyframes before, true where the way went so."""

    def claim(key: int) -> LoopCandidate:
        pose = pose2_from_row(between(turned[key - 32], turned[key]))
        motion = MotionEstimate(pose, SURE, 0.9, 0.9, 0.01, True, False, np.zeros(3))
        return LoopCandidate(key - 32, key, 0.0, 0.0, 1.0, motion, True, "")

    return [claim(key) for key in keys]


TURNS = {30: 0.9, 50: -0.9}


@pytest.mark.parametrize(
    ("gaps", "long", "borne", "contradicted"),
    [
        ((30, 50), 1, 0, 0.0),
        ((30, 50), 0, 0, 0.0),
        ((30, 50), 0, 1, 0.0),
        ((30, 50), 1, 0, 0.028),
        ((50,), 1, 0, 0.0),
    ],
)
def test_faults_that_add_up_are_believed_of_a_set_that_is_so_much_longer(
    gaps: tuple[int, ...], long: int, borne: int, contradicted: float
) -> None:
    """One gap turned left and one right; were one of them matched, the other would not explain it.

    As good as longer is a set that another one confirms, by keyframes of its own. Its ends must also
    contradict each other in proportion less than the 3 % of other sets.
    """
    turned = walked([STEP + np.array([0.0, 0.0, TURNS.get(key, 0.0)]) for key in range(COUNT - 1)])
    members, entailed = stated_by(turned, range(52, 56)), stated_by(turned, range(56, 56 + 4 * long))
    search = PlaceSearch(SimpleNamespace(submaps=None), LoopConfig(), MatchConfig(), GraphConfig())  # type: ignore[arg-type]
    search._submaps = SimpleNamespace(travelled_m=lambda key: 2.0 * key)  # type: ignore[assignment]
    search._stretches = SimpleNamespace(spacing_m=1.5)  # type: ignore[assignment]
    sets = [members, stated_by(turned, range(56, 60))][: 1 + borne]

    def between_places(one: list[LoopCandidate], other: list[LoopCandidate]) -> tuple[int, int, Motion]:
        first, last = sorted((one[0].place, other[0].place))
        return first, last, Motion(between(POSES[first], POSES[last]), SURE)

    search._sets = SimpleNamespace(largest=lambda: sets, remove=len, entailed=between_places)  # type: ignore[assignment]
    trial = SimpleNamespace(hold=lambda _: (entailed, 0), contradicted=lambda _: contradicted)
    search._trial = trial  # type: ignore[assignment]
    stamps_s, edges = np.arange(float(COUNT)), chain(())
    for gap in gaps:
        stamps_s[gap + 1 :] += 30.0
        edges[gap] = step(gap, BY_WHEELS, EdgeKind.ASSUMED, trusted=True)
        edges.append(step(gap, SURE, EdgeKind.WHEEL, trusted=False))
    search._faulty = judge(edges, stamps_s)
    found = search._believed(POSES, search._faulty.known)
    assert bool(found) == (bool(long + borne) and not contradicted and len(gaps) == 2), search._cost(
        members, lambda a, b: search._faulty.known.motion(a, b, POSES)
    )[:2]


@pytest.mark.parametrize("slips", [True, False])
def test_a_heading_that_slips_in_a_gap_bends_the_way_and_does_not_shorten_it(slips: bool) -> None:
    """Measured: 20 m straight on, to a few decimetres and degrees: it turned halfway, or it stood."""
    steps = [STEP * (20.0 if key == GAP else 1.0) for key in range(COUNT - 1)]
    went = [one.copy() for one in steps]
    halfway = STEP * [10.0, 0.0, 10.0]
    went[GAP] = (
        compose(compose(halfway, np.array([0.0, 0.0, 1.2])), halfway) if slips else STEP * [0.0, 0.0, 20.0]
    )
    stated, turned = walked(steps), walked(went)
    edges = chain(())
    edges[GAP] = Edge(
        GAP, GAP + 1, pose2_from_row(steps[GAP]), BY_WHEELS / 10.0, EdgeKind.WHEEL, trusted=True
    )
    stamps_s = np.arange(float(COUNT)) + 30.0 * (np.arange(COUNT) > GAP)
    kept = np.ones(len(edges), np.bool_)
    faulty = FaultySteps(edges, kept, stated, stamps_s, GraphConfig(), LoopConfig(), MatchConfig())
    known = faulty.known.motion(5, 70, stated)
    asked = faulty.explain(5, 70, known, Motion(between(turned[5], turned[70]), SURE))[1]
    assert (asked < 40.0) is slips
    assert slips or asked > 1000.0


@pytest.mark.parametrize("count", [1, 4])
def test_a_loop_alone_makes_no_gap_known(count: int) -> None:
    """It may be at a place that looks the same; more loops than a pose has numbers may not."""
    edges = chain()
    for n in range(count):
        stated = pose2_from_row(between(POSES[GAP - n], POSES[GAP + 5]))
        edges.append(Edge(GAP - n, GAP + 5, stated, SURE, EdgeKind.LOOP, trusted=False, loop=n))
    known = judge(edges, np.arange(float(COUNT))).known.motion(GAP, GAP + 5, POSES)
    assert (known.covariance[2, 2] < 0.1 * BY_WHEELS[2, 2]) == (count > 3)


def test_a_gap_of_several_steps_is_one_fault() -> None:
    turned = bent(*((key, 0.5) for key in (GAP, GAP + 1, GAP + 2)))
    assert squares((GAP, GAP + 1, GAP + 2), turned) < 0.5 * squares((GAP, GAP + 2), turned)


def test_where_measurements_contradict_each_other_both_are_in_doubt() -> None:
    match = step(0, SURE, EdgeKind.LIDAR, trusted=False)
    other = Edge(0, 1, pose2_from_row(np.array([1.0, 3.0, 1.0])), SURE, EdgeKind.WHEEL, trusted=False)
    poses = np.array([np.zeros(3), STEP])
    held = believed_edges([match, other], np.array([True, False]), poses)
    assert len(held) == 2
    assert all(np.sqrt(edge.covariance[2, 2]) > 0.9 for edge in held)
    assert believed_edges([match], np.array([True]), poses) == [match]


def test_where_wheels_alone_show_no_step_none_is_looser_than_known() -> None:
    matched, by_wheels = (judge(edges, np.arange(float(COUNT))) for edges in (chain(()), chain()))
    assert matched.loose is matched.known
    assert by_wheels.loose is not by_wheels.known
