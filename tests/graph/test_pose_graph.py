"""The factor graph: optima that are known, false loops that are refused, and input that must not enter."""

import math
from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from slam.errors import GraphError
from slam.graph import pose_graph
from slam.graph.edge import Edge, EdgeKind
from slam.graph.factors import gauge, weighted
from slam.graph.pose_graph import PoseGraph
from slam.measurements import FloatArray, Pose

ORIGINS = [gtsam.Pose2(), gtsam.Pose2(100.0, -40.0, 2.0)]


def edge(
    source: int,
    target: int,
    pose: Pose,
    sigma: float | FloatArray = 0.1,
    kind: EdgeKind = EdgeKind.LIDAR,
    trusted: bool = True,
) -> Edge:
    size = 3 if isinstance(pose, gtsam.Pose2) else 6
    covariance = np.diag(np.broadcast_to(np.asarray(sigma, dtype=float), (size,)) ** 2)
    return Edge(source, target, pose, covariance, kind, trusted)


def graph_of(origin: Pose, steps: list[Pose]) -> PoseGraph:
    """A chain of trusted edges of sigma 0.1, the nodes where the steps lead."""
    graph = PoseGraph(origin)
    pose = origin
    for n, step in enumerate(steps):
        pose = pose.compose(step)
        assert graph.add_node(pose) == n + 1
        graph.add_edge(edge(n, n + 1, step))
    return graph


def assert_same(pose: Pose, expected: Pose, tolerance: float = 1e-6) -> None:
    np.testing.assert_allclose(pose.matrix(), expected.matrix(), atol=tolerance)


def straight_2d(length_m: float) -> Pose:
    return gtsam.Pose2(length_m, 0.0, 0.0)


def straight_3d(length_m: float) -> Pose:
    return gtsam.Pose3(gtsam.Rot3(), np.array([length_m, 0.0, 0.0]))


@pytest.mark.parametrize("by_isam", [False, True], ids=["optimize", "update"])
@pytest.mark.parametrize(
    ("straight", "origin"),
    [
        (straight_2d, ORIGINS[0]),
        (straight_2d, ORIGINS[1]),
        (straight_3d, gtsam.Pose3()),
        (straight_3d, gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.4, 2.0), np.array([5.0, -6.0, 7.0]))),
    ],
)
def test_a_loop_spreads_its_correction_evenly(
    straight: Callable[[float], Pose], origin: Pose, by_isam: bool
) -> None:
    """Ten steps of 1 m, and an equally sure edge that says it were 9.45 m in all: 0.05 m off each of 11."""
    graph = graph_of(origin, [straight(1.0)] * 10)
    graph.add_edge(edge(0, 10, straight(9.45), kind=EdgeKind.LOOP))
    if by_isam:
        graph.update()
    else:
        result = graph.optimize()
        assert result.kept.all()
        assert result.error == pytest.approx(0.5 * 11 * (0.05 / 0.1) ** 2, rel=1e-6)
    assert len(graph) == 11
    for n in range(11):
        assert_same(graph.pose(n), origin.compose(straight(0.95 * n)), 1e-5)


def test_the_surer_edge_wins_in_proportion() -> None:
    graph = PoseGraph(gtsam.Pose2())
    graph.add_node(gtsam.Pose2(1.0, 0.0, 0.0))
    graph.add_edge(edge(0, 1, gtsam.Pose2(1.0, 0.0, 0.0), sigma=0.1))
    graph.add_edge(edge(0, 1, gtsam.Pose2(2.0, 0.0, 0.0), sigma=0.2))
    graph.optimize()
    assert graph.pose(1).x() == pytest.approx(1.2, abs=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 0.9, -2.0])
def test_the_covariance_is_in_the_targets_frame(yaw: float) -> None:
    """Two edges into a turned node, each sure along one axis of that node."""
    graph = PoseGraph(gtsam.Pose2())
    graph.add_node(gtsam.Pose2(1.0, 0.0, yaw))
    nearer, farther = gtsam.Pose2(1.0, 0.0, yaw), gtsam.Pose2(1.0, 0.0, yaw).compose(gtsam.Pose2(0.1, 0.1, 0))
    graph.add_edge(edge(0, 1, nearer, np.array([1e-3, 1.0, 1e-3])))
    graph.add_edge(edge(0, 1, farther, np.array([1.0, 1e-3, 1e-3])))
    graph.optimize()
    assert_same(graph.pose(1), nearer.compose(gtsam.Pose2(0.0, 0.1, 0.0)), 1e-5)


def test_update_and_optimize_agree_on_a_noisy_graph() -> None:
    graph, _, _ = ring(np.random.default_rng(3), poses=60, loops=20, trusted_loops=True)
    graph.update()
    by_isam = graph.planar_poses()
    graph.optimize()
    # iSAM2 stops relinearising below a tenth.
    np.testing.assert_allclose(by_isam, graph.planar_poses(), atol=0.02)
    assert graph.planar_poses().shape == (60, 3)


def test_updates_in_pieces_end_where_one_update_does() -> None:
    steps = [gtsam.Pose2(1.0, 0.0, 0.3)] * 12
    whole = graph_of(gtsam.Pose2(), steps)
    whole.add_edge(edge(0, 12, gtsam.Pose2(0.5, 3.0, 3.5), kind=EdgeKind.LOOP))
    pieces = PoseGraph(gtsam.Pose2())
    for n, step in enumerate(steps):
        pieces.add_node(pieces.pose(n).compose(step))
        pieces.add_edge(edge(n, n + 1, step))
        pieces.update()
    pieces.add_edge(edge(0, 12, gtsam.Pose2(0.5, 3.0, 3.5), kind=EdgeKind.LOOP))
    for graph in (whole, pieces):
        for _ in range(5):  # iSAM2 makes one step an update
            graph.update()
    np.testing.assert_allclose(pieces.planar_poses(), whole.planar_poses(), atol=0.02)


def test_updates_go_on_after_an_optimisation_which_keeps_nothing_of_isam() -> None:
    graph = graph_of(gtsam.Pose2(), [gtsam.Pose2(1.0, 0.0, 0.3)] * 12)
    graph.update()
    graph.optimize()
    assert graph._isam is None
    graph.add_edge(edge(0, 12, gtsam.Pose2(0.5, 3.0, 3.5), kind=EdgeKind.LOOP))
    graph.add_node(graph.pose(12))
    graph.add_edge(edge(12, 13, gtsam.Pose2()))
    for _ in range(5):
        graph.update()
    by_isam = graph.planar_poses()
    graph.optimize()
    np.testing.assert_allclose(by_isam, graph.planar_poses(), atol=0.02)


def test_new_nodes_keep_their_guess_until_the_update() -> None:
    graph = graph_of(gtsam.Pose2(), [gtsam.Pose2(1.0, 0.0, 0.0)])
    graph.update()
    key = graph.add_node(gtsam.Pose2(9.0, 9.0, 1.0))
    assert_same(graph.pose(key), gtsam.Pose2(9.0, 9.0, 1.0))


@pytest.mark.parametrize("origin", [*ORIGINS, gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([1.0, 2.0, 3.0]))])
def test_the_prior_is_only_the_gauge(origin: Pose) -> None:
    """The first node does not move and a contradiction elsewhere costs what the edges alone cost."""
    straight = straight_2d if isinstance(origin, gtsam.Pose2) else straight_3d
    graph = graph_of(origin, [straight(1.0)] * 3)
    graph.add_edge(edge(1, 3, straight(5.0)))
    result = graph.optimize()
    assert_same(graph.pose(0), origin)
    # Three edges share the 3 m: 1 m each.
    assert result.error == pytest.approx(0.5 * 3 * (1.0 / 0.1) ** 2, rel=1e-6)


@pytest.mark.parametrize("correlated", [False, True])
@pytest.mark.parametrize("is_3d", [False, True])
def test_initialize_forgets_a_bad_start(is_3d: bool, correlated: bool) -> None:
    """The edges of a closed ring, and guesses that are nonsense: the start is made from the edges alone."""
    step: Pose = gtsam.Pose2(1.0, 0.0, math.pi / 6)
    if is_3d:
        step = gtsam.Pose3(gtsam.Rot3.Yaw(math.pi / 6), np.array([1.0, 0.0, 0.0]))
    size = 6 if is_3d else 3
    covariance = 0.01 * (np.eye(size) + 0.5 * correlated)  # as every measured one is
    nowhere = type(step)()
    graph = PoseGraph(nowhere)
    truth = [nowhere]
    for n in range(11):
        truth.append(truth[-1].compose(step))
        graph.add_node(nowhere)
        graph.add_edge(Edge(n, n + 1, step, covariance, EdgeKind.LIDAR, trusted=True))
    graph.add_edge(Edge(11, 0, step, covariance, EdgeKind.LOOP, trusted=True))
    graph.initialize()
    result = graph.optimize()
    assert result.error < 1e-9
    for n, pose in enumerate(truth):
        assert_same(graph.pose(n), pose, 1e-5)


def bad_edges() -> dict[str, Edge]:
    step, good = gtsam.Pose2(1.0, 0.0, 0.0), np.eye(3)
    lidar = EdgeKind.LIDAR
    return {
        "pose is NaN": Edge(0, 1, gtsam.Pose2(math.nan, 0.0, 0.0), good, lidar, True),
        "pose is infinite": Edge(0, 1, gtsam.Pose2(math.inf, 0.0, 0.0), good, lidar, True),
        "yaw is NaN": Edge(0, 1, gtsam.Pose2(0.0, 0.0, math.nan), good, lidar, True),
        "covariance is NaN": Edge(0, 1, step, np.full((3, 3), math.nan), lidar, True),
        "covariance is infinite": Edge(0, 1, step, np.diag([1.0, math.inf, 1.0]), lidar, True),
        "covariance has a zero": Edge(0, 1, step, np.diag([1.0, 0.0, 1.0]), lidar, True),
        "covariance is indefinite": Edge(0, 1, step, np.diag([1.0, -1.0, 1.0]), lidar, True),
        "covariance is zero": Edge(0, 1, step, np.zeros((3, 3)), lidar, True),
        "covariance has the wrong size": Edge(0, 1, step, np.eye(6), lidar, True),
        "target is unknown": Edge(0, 2, step, good, lidar, True),
        "source is unknown": Edge(2, 0, step, good, lidar, True),
        "source is negative": Edge(-1, 1, step, good, lidar, True),
        "edge to itself": Edge(1, 1, step, good, lidar, True),
        "Pose3 in a plane": Edge(0, 1, gtsam.Pose3(), np.eye(6), lidar, True),
    }


@pytest.mark.parametrize("name", bad_edges())
def test_what_must_not_enter_is_refused(name: str) -> None:
    graph = graph_of(gtsam.Pose2(), [gtsam.Pose2(1.0, 0.0, 0.0)])
    with pytest.raises(GraphError):
        graph.add_edge(bad_edges()[name])
    assert len(graph.edges) == 1
    # Nothing of it has stayed behind.
    graph.update()
    assert graph.optimize().error == pytest.approx(0.0, abs=1e-12)


def test_a_node_that_is_not_finite_is_refused() -> None:
    graph = PoseGraph(gtsam.Pose2())
    with pytest.raises(GraphError):
        graph.add_node(gtsam.Pose2(0.0, math.nan, 0.0))
    assert len(graph) == 1
    with pytest.raises(GraphError):
        PoseGraph(gtsam.Pose2(math.inf, 0.0, 0.0))


def test_the_message_names_the_edge() -> None:
    graph = PoseGraph(gtsam.Pose2())
    with pytest.raises(GraphError, match=r"loop edge 0 -> 7: .*nodes 0\.\.0"):
        graph.add_edge(edge(0, 7, gtsam.Pose2(), kind=EdgeKind.LOOP))


def ring(
    rng: np.random.Generator, poses: int, loops: int, false_loops: int = 0, trusted_loops: bool = False
) -> tuple[PoseGraph, list[gtsam.Pose2], int]:
    """Rounds of a square of 10 m with noisy steps; loops between nodes that are near, then the false ones.

    Gives the graph, the true poses and the number of chain edges.
    """
    sigmas = np.array([0.02, 0.02, 0.005])
    truth = [gtsam.Pose2()]
    while len(truth) < poses:
        turn = math.pi / 2 if len(truth) % 10 == 0 else 0.0
        truth.append(truth[-1].compose(gtsam.Pose2(1.0, 0.0, turn)))

    def measured(a: int, b: int) -> gtsam.Pose2:
        return truth[a].between(truth[b]).compose(gtsam.Pose2(*(sigmas * rng.standard_normal(3))))

    graph = PoseGraph(truth[0])
    for n in range(1, poses):
        step = measured(n - 1, n)
        graph.add_node(graph.pose(n - 1).compose(step))
        graph.add_edge(edge(n - 1, n, step, sigmas))
    added = 0
    while added < loops:
        a, b = sorted(rng.integers(0, poses, 2).tolist())
        if (
            b - a > 15
            and truth[a].between(truth[b]).translation() @ truth[a].between(truth[b]).translation() < 9
        ):
            graph.add_edge(edge(a, b, measured(a, b), sigmas, EdgeKind.LOOP, trusted_loops))
            added += 1
    added = 0
    while added < false_loops:
        a, b = sorted(rng.integers(0, poses, 2).tolist())
        if b - a > 15 and np.linalg.norm(truth[a].between(truth[b]).translation()) > 5.0:
            claim = gtsam.Pose2(*rng.normal(0.0, [0.3, 0.3, 0.1]))
            graph.add_edge(edge(a, b, claim, sigmas, EdgeKind.LOOP, trusted=False))
            added += 1
    return graph, truth, poses - 1


def error_m(graph: PoseGraph, truth: list[gtsam.Pose2]) -> float:
    """Greatest distance of a node from its true place."""
    return max(
        float(np.linalg.norm(graph.pose(n).translation() - t.translation())) for n, t in enumerate(truth)
    )


@pytest.mark.parametrize("updates", [False, True], ids=["at once", "after iSAM2"])
@pytest.mark.parametrize("seed", [0, 1])
def test_false_loops_are_refused_and_true_ones_kept(seed: int, updates: bool) -> None:
    """30 loops that say of places far apart that they are the same, among 120 true ones, on 400 poses."""
    graph, truth, chain = ring(np.random.default_rng(seed), 400, loops=120, false_loops=30)
    clean, _, _ = ring(np.random.default_rng(seed), 400, loops=120)
    clean_m = (clean.optimize(), error_m(clean, truth))[1]
    if updates:
        graph.update()
    kept = graph.optimize(0.99).kept
    assert kept.shape == (chain + 150,)
    assert kept[:chain].all(), "trusted edges are never refused"
    assert kept[chain : chain + 120].mean() > 0.97, "the gate of 99 % refuses hardly a true one"
    assert not kept[chain + 120 :].any()
    assert error_m(graph, truth) < 1.1 * clean_m + 0.02


def test_a_trusted_edge_is_kept_even_where_all_others_disagree() -> None:
    graph = PoseGraph(gtsam.Pose2())
    graph.add_node(gtsam.Pose2(1.0, 0.0, 0.0))
    for _ in range(5):
        graph.add_edge(edge(0, 1, gtsam.Pose2(5.0, 0.0, 0.0), kind=EdgeKind.WHEEL, trusted=False))
    graph.add_edge(edge(0, 1, gtsam.Pose2(1.0, 0.0, 0.0)))
    assert graph.optimize().kept[-1]


def test_the_gate_refuses_the_share_that_it_promises() -> None:
    """At a probability of 0.8 about a fifth of the true loops fails the gate; at 0.999 next to none."""
    shares = []
    for probability in (0.8, 0.999):
        graph, _, chain = ring(np.random.default_rng(5), 200, loops=120)
        shares.append(1.0 - graph.optimize(probability).kept[chain:].mean())
    assert 0.08 < shares[0] < 0.35
    assert shares[1] < 0.02


def test_no_false_loop_bends_the_running_estimate_far() -> None:
    """While mapping the Cauchy kernel stands in for GNC."""
    graph, truth, _ = ring(np.random.default_rng(2), 120, loops=40, false_loops=2)
    for _ in range(10):
        graph.update()
    bent = error_m(graph, truth)
    blind, _, _ = ring(np.random.default_rng(2), 120, loops=40, false_loops=2, trusted_loops=True)
    blind.edges[:] = [
        Edge(e.source, e.target, e.T_source_target, e.covariance, e.kind, True) for e in blind.edges
    ]
    blind.optimize()
    assert bent < 0.5 * error_m(blind, truth)


@pytest.mark.parametrize(("off_m", "others", "weighed"), [(0.5, 0, False), (1.7, 0, True), (1.7, 40, False)])
def test_new_loops_are_weighed_where_refusing_one_may_cost_less(
    off_m: float, others: int, weighed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All are beyond the gate at first, and none once the chain has bent; to refuse one of many says more."""
    steps, stated, solved = [straight_2d(1.0)] * (20 + others), list[int](), pose_graph.solved
    graph = graph_of(gtsam.Pose2(), steps)
    for n in range(20, 20 + others):
        graph.add_edge(edge(n, n + 1, straight_2d(1.0), kind=EdgeKind.LOOP, trusted=False))
    graph.optimize()

    def counting(*asked: object, most_steps: int = 100) -> gtsam.Values:
        stated.append(most_steps)
        return solved(*asked, most_steps)  # type: ignore[arg-type]

    monkeypatch.setattr(pose_graph, "solved", counting)
    graph.add_edge(edge(0, 20, straight_2d(20.0 + off_m), kind=EdgeKind.LOOP, trusted=False))
    assert graph.optimize().kept.all()
    # A round is one step from where the last one ended.
    assert (1 in stated) == weighed


def test_an_edge_that_is_stated_anew_is_solved_anew() -> None:
    graph = graph_of(gtsam.Pose2(), [straight_2d(1.0)])
    graph.optimize()
    graph.edges[0] = edge(0, 1, straight_2d(3.0))
    graph.optimize()
    assert_same(graph.pose(1), straight_2d(3.0))


def test_a_graph_of_one_node() -> None:
    graph = PoseGraph(ORIGINS[1])
    graph.update()
    result = graph.optimize()
    assert result.error == pytest.approx(0.0, abs=1e-12)
    assert result.kept.shape == (0,)
    np.testing.assert_allclose(graph.planar_poses(), [[100.0, -40.0, 2.0]])


@pytest.mark.parametrize("seed", range(4))
def test_one_step_never_makes_it_worse(seed: int) -> None:
    """From a start bent so far that undamped steps may."""
    rng = np.random.default_rng(seed)
    graph, truth, _ = ring(rng, 60, loops=10)
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(gauge(truth[0]))
    for one in graph.edges:
        factors.add(weighted(one, 1.0))
    for n, pose in enumerate(truth):
        start.insert(n, pose.compose(gtsam.Pose2(0.0, 0.0, 2.0 * rng.standard_normal() * (n > 0))))
    assert factors.error(pose_graph.solved(factors, start, most_steps=1)) <= factors.error(start)
