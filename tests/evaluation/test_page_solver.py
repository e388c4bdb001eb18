"""The page's own solver in Chromium, against GTSAM on rings in the plane and in space."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gtsam
import numpy as np
import pytest
from browser import visit
from ring_graphs import PLANE, RINGS, SIDES, SPACE, ring, solved

from slam.graph.edge import Edge, EdgeKind
from slam.measurements import Pose
from tools.what_if import PAGE, PARTS, SETUP, SWITCH, Graph, distances

pytestmark = pytest.mark.browser
STATE = """() => {
  const {solver, on} = globalThis, {poses, rounds} = solver.solve(on);
  const moved = Math.max(...solver.shifts(solver.start, poses));
  return {rounds, moved, residuals: Array.from(solver.residuals(poses))};
}"""
WRONG = {
    "plane": (gtsam.Pose2(1.0, -1.5, 2.5), PLANE),
    "space": (gtsam.Pose3(gtsam.Rot3.RzRyRx(0.7, -0.5, 1.5), np.array([1.0, -1.5, 0.5])), SPACE),
}


@pytest.fixture(scope="module")
def evaluate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., Any]]:
    """Runs JavaScript where the parts of the page's solver are."""
    empty = tmp_path_factory.mktemp("page") / "empty.html"
    empty.write_text("<!DOCTYPE html><script>globalThis.Scanweave = {};</script>")
    with visit(empty) as seen:
        for part in PARTS:
            seen.page.add_script_tag(path=PAGE / f"{part}.js")
        yield seen.page.evaluate


def graph_of(poses: Sequence[Pose], edges: Sequence[Edge]) -> Graph:
    """All edges hold it."""
    planar = isinstance(poses[0], gtsam.Pose2)
    return Graph(planar, poses, edges, np.ones(len(edges), np.bool_))


@pytest.mark.parametrize("where", RINGS)
def test_a_loop_switched_off_moves_the_map_as_gtsam_does(where: str, evaluate: Callable[..., Any]) -> None:
    graph = graph_of(*ring(*RINGS[where]))
    evaluate(SETUP, graph.page())
    base = graph.solved(graph.kept)
    for edge in (3 * SIDES, 3 * SIDES + 2):
        exact = graph.solved(graph.switched(edge))
        found = np.array(evaluate(SWITCH, edge)["poses"]).reshape(len(exact), -1)[:, : exact.shape[1]]
        assert distances(exact, base).max() > 1e-2
        assert distances(found, exact).max() < 1e-5


@pytest.mark.parametrize("where", RINGS)
def test_a_grossly_false_loop_forced_on_bends_the_map_as_gtsam_does(
    where: str, evaluate: Callable[..., Any]
) -> None:
    poses, edges = ring(*RINGS[where])
    motion, covariance = WRONG[where]
    wrong = Edge(5, 25, motion, covariance, EdgeKind.LOOP, trusted=False, loop=99)
    graph = graph_of(poses, [*edges, wrong])
    graph.kept[-1] = False
    evaluate(SETUP, graph.page())
    exact = graph.solved(graph.switched(len(edges)))
    found = np.array(evaluate(SWITCH, len(edges))["poses"]).reshape(len(exact), -1)[:, : exact.shape[1]]
    assert distances(exact, graph.solved(graph.kept)).max() > 0.3
    assert distances(found, exact).max() < 1e-4


@pytest.mark.parametrize("where", RINGS)
def test_residuals_are_whitened_norms_and_a_solved_map_stays(
    where: str, evaluate: Callable[..., Any]
) -> None:
    poses, edges = ring(*RINGS[where])
    evaluate(SETUP, graph_of(poses, edges).page())
    state = evaluate(STATE)
    expected = []
    for edge in edges:
        found = poses[edge.source].between(poses[edge.target])
        off = edge.T_source_target.localCoordinates(found)
        expected.append(np.sqrt(off @ np.linalg.solve(edge.covariance, off)))
    assert state["residuals"] == pytest.approx(expected, rel=1e-5, abs=1e-9)
    assert state["moved"] < 1e-7
    assert state["rounds"] == 1


def test_what_nothing_holds_is_said(evaluate: Callable[..., Any]) -> None:
    poses, edges = ring(*RINGS["plane"])
    chain = [edge for edge in edges if edge.loop is None]
    evaluate(SETUP, graph_of(solved(poses, chain), chain).page())
    assert evaluate(SWITCH, 7)["loose"] >= 8
