"""Where graduated non-convexity begins decides where it ends: the solution of less cost is taken."""

import math

import gtsam
import numpy as np
import pytest

from fusion.estimation import gate
from slam.graph.edge import Edge, EdgeKind
from slam.graph.pose_graph import PoseGraph
from slam.measurements import FloatArray


def edge(
    source: int,
    target: int,
    pose: gtsam.Pose2,
    sigmas: float | FloatArray,
    kind: EdgeKind,
    trusted: bool = True,
) -> Edge:
    covariance = np.diag(np.broadcast_to(np.asarray(sigmas, dtype=float), (3,)) ** 2)
    return Edge(source, target, pose, covariance, kind, trusted)


@pytest.mark.parametrize("seed", range(2))
def test_false_loops_that_agree_do_not_fold_a_way_of_wheels(seed: int) -> None:
    """Twelve that agree, against ten true ones, all kept; each step of the wheels may have been wrong."""
    rng = np.random.default_rng(seed)
    out = [gtsam.Pose2(float(x), 0.0, 0.0) for x in range(30)]
    back = [gtsam.Pose2(pose.x(), 0.0, math.pi) for pose in reversed(out)]
    truth = [*out, *back]
    wheels, loops = np.array([0.03, 0.03, 0.01]), np.array([0.05, 0.05, 0.05])

    def measured(source: int, end: gtsam.Pose2, sigmas: FloatArray) -> gtsam.Pose2:
        return truth[source].between(end).compose(gtsam.Pose2(*(sigmas * rng.standard_normal(3))))

    steps = [measured(n, truth[n + 1], wheels) for n in range(59)]
    graph, pose = PoseGraph(truth[0]), truth[0]
    for n, step in enumerate(steps):
        graph.add_node(pose := pose.compose(step))
        graph.add_edge(edge(n, n + 1, step, 0.5, EdgeKind.ASSUMED))
        graph.add_edge(edge(n, n + 1, step, wheels, EdgeKind.WHEEL, trusted=False))
    for n in rng.permutation(30)[:10].tolist():
        again = measured(29 - n, truth[30 + n], loops)
        graph.add_edge(edge(29 - n, 30 + n, again, loops, EdgeKind.LOOP, trusted=False))
    for n in range(12):
        elsewhere = measured(n // 2, gtsam.Pose2(-12.0, 9.0, 1.2).compose(truth[35 + n]), loops)
        graph.add_edge(edge(n // 2, 35 + n, elsewhere, loops, EdgeKind.LOOP, trusted=False))
    kept = graph.optimize().kept
    assert not kept[-12:].any()
    assert kept[-22:-12].all()


def test_to_doubt_two_of_a_hundred_steps_costs_more_than_all_of_three_loops() -> None:
    """By the gates alone the steps would be refused that hold a stretch which three loops have elsewhere."""
    step, away = gtsam.Pose2(1.0, 0.0, 0.0), gtsam.Pose2(50.8, 0.0, 0.0)
    graph = PoseGraph(gtsam.Pose2())
    for n in range(99):
        graph.add_node(graph.pose(n).compose(step))
        graph.add_edge(edge(n, n + 1, step, 0.5, EdgeKind.ASSUMED))
        graph.add_edge(edge(n, n + 1, step, 0.003, EdgeKind.WHEEL, trusted=False))
    graph.add_edge(edge(0, 99, gtsam.Pose2(99.0, 0.0, 0.0), 0.003, EdgeKind.SURVEY))
    for n in range(10, 13):
        graph.add_edge(edge(n, 50 + n, away, 0.05, EdgeKind.LOOP, trusted=False))
    costs, gates = [], []
    for refused in ({199, 200, 201}, {2 * 40 + 1, 2 * 80 + 1}):
        graph.begin_with(n not in refused for n in range(len(graph.edges)))
        found = graph.optimize()
        assert set(np.flatnonzero(~found.kept)) == refused
        gates.append(found.error + 0.5 * gate(3, 0.99) * len(refused))
        costs.append(found.cost)
    assert gates[0] > gates[1]
    assert costs[0] < costs[1]
