"""A large map is held where it was solved: what an update does then, counted, and that it is no other map."""

import gtsam
import numpy as np
import pytest

from slam.graph import factors, pose_graph
from slam.graph.edge import Edge, EdgeKind
from slam.graph.pose_graph import PoseGraph
from slam.measurements import Pose

WINDOW = 40
STEP = np.diag([0.02, 0.02, 0.005]) ** 2


def in_space(pose: gtsam.Pose2) -> gtsam.Pose3:
    return gtsam.Pose3(pose)


def drive(laps: int, *, spatial: bool = False) -> tuple[PoseGraph, list[gtsam.Pose2], list[int]]:
    """Laps of a ring of 50 nodes by noisy steps, each node joined to that of the lap before, the edges turned
    now and then; the graph, the truth, and how many nodes iSAM2 had after each update."""
    rng = np.random.default_rng(1)
    step = gtsam.Pose2(1.0, 0.0, 2.0 * np.pi / 50)
    truth, sizes = [gtsam.Pose2()], []
    as_type = in_space if spatial else (lambda pose: pose)
    covariance = np.diag([1e-4, 1e-4, 2.5e-5, 4e-4, 4e-4, 1e-4]) if spatial else STEP

    def edge(source: int, target: int, kind: EdgeKind) -> Edge:
        noise = gtsam.Pose2(*(np.sqrt(np.diag(STEP)) * rng.standard_normal(3)))
        motion: Pose = as_type(truth[source].between(truth[target]).compose(noise))
        return Edge(source, target, motion, covariance, kind, trusted=kind != EdgeKind.LOOP)

    graph = PoseGraph(as_type(truth[0]))
    for n in range(1, 50 * laps):
        truth.append(truth[-1].compose(step))
        chain = edge(n - 1, n, EdgeKind.LIDAR)
        graph.add_node(graph.pose(n - 1).compose(chain.T_source_target))
        graph.add_edge(chain)
        if n >= 50:
            graph.add_edge(edge(n, n - 50, EdgeKind.LOOP) if n % 3 else edge(n - 50, n, EdgeKind.LOOP))
        if n % 5 == 0:
            graph.update()
            sizes.append(0 if graph._isam is None else graph._isam.calculateEstimate().size())
    return graph, truth, sizes


def error_m(graph: PoseGraph, truth: list[gtsam.Pose2]) -> float:
    found = [graph.pose(n).matrix()[:2, -1] for n in range(len(truth))]
    return max(float(np.linalg.norm(at - pose.translation())) for at, pose in zip(found, truth, strict=True))


@pytest.mark.parametrize("spatial", [False, True], ids=["plane", "space"])
def test_isam_moves_no_more_nodes_in_a_log_of_many_laps(
    spatial: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, truth, sizes = drive(6, spatial=spatial)
    assert sizes[-1] == 296
    monkeypatch.setattr(pose_graph, "_NODES_A_WINDOW", WINDOW)
    held, _, sizes = drive(6, spatial=spatial)
    assert max(sizes) <= (WINDOW // 4 if spatial else WINDOW) + 5
    assert error_m(held, truth) < 1.5 * error_m(whole, truth) + 0.02
    for graph in (whole, held):
        assert graph.optimize(1.0 - 1e-9).kept.all()
    np.testing.assert_allclose(
        [held.pose(n).matrix() for n in range(300)], [whole.pose(n).matrix() for n in range(300)], atol=1e-4
    )


def test_an_update_shows_from_which_node_on_poses_have_moved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_graph, "_NODES_A_WINDOW", WINDOW)
    graph, _, _ = drive(3)
    before = graph.planar_poses().copy()
    first = graph.update()
    assert first > 2 * WINDOW
    moved = graph.planar_poses(first)
    np.testing.assert_array_equal(graph.planar_poses()[:first], before[:first])
    np.testing.assert_array_equal(graph.planar_poses()[first:], moved)


@pytest.mark.parametrize("turned", [False, True])
def test_an_edge_to_what_is_held_pulls_as_hard_as_it_is_sure(
    turned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A chain of sigma 0.1 m a step leaves the held node 3; an equally sure edge says one metre more."""
    monkeypatch.setattr(pose_graph, "_NODES_A_WINDOW", 2)
    monkeypatch.setattr(factors, "_CAUCHY_SIGMAS", 1e6)
    covariance, step = 0.01 * np.eye(3), gtsam.Pose2(1.0, 0.0, 0.0)
    graph = PoseGraph(gtsam.Pose2())
    for n in range(5):
        graph.add_node(gtsam.Pose2(n + 1.0, 0.0, 0.0))
        graph.add_edge(Edge(n, n + 1, step, covariance, EdgeKind.LIDAR, trusted=True))
        if n == 2:
            graph.update()
    loop = Edge(1, 5, gtsam.Pose2(5.0, 0.0, 0.0), covariance, EdgeKind.LOOP, trusted=False)
    graph.add_edge(loop.turned() if turned else loop)
    assert graph.update() == 4
    # From node 3, two steps of which share the metre with the edge: two thirds of it.
    assert graph.pose(5).x() == pytest.approx(5.0 + 2.0 / 3.0, abs=1e-3)
    assert graph.pose(3).x() == 3.0
