"""What edges do to a map: in closed form on a line, and against the map solved again on rings."""

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest
from ring_graphs import PLANE, RINGS, SIDES, ring, solved

from slam.graph.edge import Edge, EdgeKind
from slam.graph.influence import LinearMap, influences, misfits
from slam.measurements import FloatArray, Pose
from tools.false_loops import snooped


def shifts(one: Sequence[Pose], other: Sequence[Pose]) -> FloatArray:
    """(n,) how far each node lies from where it lay."""
    apart = [a.translation() - b.translation() for a, b in zip(one, other, strict=True)]
    return np.linalg.norm(apart, axis=1)


@pytest.mark.parametrize("kept", [True, False])
def test_on_a_line_influence_is_reported_in_closed_form(kept: bool) -> None:
    steps, off, along, loop = 10, 0.05, 0.02**2, 0.03**2
    stiff = np.diag([along, 1e-6, 1e-8])
    step, claim = gtsam.Pose2(1.0, 0.0, 0.0), gtsam.Pose2(steps + off, 0.0, 0.0)
    edges = [Edge(n, n + 1, step, stiff, EdgeKind.LIDAR, trusted=True) for n in range(steps)]
    closing = Edge(0, steps, claim, np.diag([loop, 1e-2, 1e-2]), EdgeKind.LOOP, trusted=False, loop=0)
    share = steps * along / (steps * along + loop)
    stretch = 1.0 + share * off / steps if kept else 1.0
    poses = [gtsam.Pose2(n * stretch, 0.0, 0.0) for n in range(steps + 1)]
    found = influences(poses, [*edges, closing], [*[True] * steps, kept])
    assert found.edges.tolist() == [steps]
    assert found.nodes.tolist() == [steps]
    assert found.shifts_m[0] == pytest.approx(share * off, rel=1e-4)
    missed = off * (1.0 - share) if kept else off
    assert found.residuals[0] == pytest.approx(missed / np.sqrt(loop), rel=1e-4)
    assert found.left_out[0] == pytest.approx(off / np.sqrt(steps * along + loop), rel=1e-4)


@pytest.mark.parametrize("where", RINGS)
def test_influence_is_what_solving_again_without_the_loop_does(where: str) -> None:
    poses, edges = ring(*RINGS[where])
    found = influences(poses, edges, [True] * len(edges))
    assert len(found.edges) == sum(edge.loop is not None for edge in edges) > 4
    for n, left in enumerate(found.edges.tolist()):
        moved = shifts(poses, solved(poses, [edge for k, edge in enumerate(edges) if k != left]))
        assert found.shifts_m[n] == pytest.approx(moved.max(), rel=0.15)
        assert moved[found.nodes[n]] == pytest.approx(moved.max(), rel=0.02)


@pytest.mark.parametrize("where", RINGS)
def test_what_is_left_out_says_what_it_would_do_if_forced_in_again(where: str) -> None:
    poses, edges = ring(*RINGS[where])
    first = SIDES * 3  # the first loop
    without = [k != first for k in range(len(edges))]
    others = solved(poses, [edge for edge, held in zip(edges, without, strict=True) if held])
    inside = LinearMap(poses, edges, [True] * len(edges)).influences([first])
    outside = LinearMap(others, edges, without).influences([first])
    assert outside.shifts_m == pytest.approx(inside.shifts_m, rel=0.15)
    assert outside.left_out == pytest.approx(inside.left_out, rel=0.05)
    assert outside.residuals[0] > inside.residuals[0]


def test_squares_left_out_are_chi_square_of_three_where_loops_are_true() -> None:
    step, covariance = RINGS["plane"]
    means = []
    for seed in range(8):
        poses, edges = ring(step, 0.1 * covariance, laps=20, seed=seed)
        means.append(np.mean(influences(poses, edges, [True] * len(edges)).left_out ** 2))
    assert np.mean(means) == pytest.approx(3.0, abs=0.4)


def test_a_false_loop_stands_out_before_all_others() -> None:
    poses, edges = ring(*RINGS["plane"])
    wrong = Edge(3, 20, gtsam.Pose2(1.0, 1.0, 1.0), PLANE, EdgeKind.LOOP, trusted=False, loop=99)
    edges.append(wrong)
    found = influences(solved(poses, edges), edges, [True] * len(edges))
    assert edges[found.edges[found.left_out.argmax()]] is wrong


def test_the_first_keyframe_is_held_and_any_edge_may_be_asked() -> None:
    poses, edges = ring(*RINGS["plane"])
    step = LinearMap(poses, edges, [True] * len(edges)).influences([0])
    assert step.nodes[0] > 0
    assert step.shifts_m[0] > 0.0


def test_a_map_without_loops_or_in_pieces_has_no_influences() -> None:
    poses, edges = ring(*RINGS["plane"], laps=1)
    chain = [edge for edge in edges if edge.loop is None]
    assert len(influences(poses, chain, [True] * len(chain)).edges) == 0
    poses, edges = ring(*RINGS["plane"])
    kept = np.array([edge.loop is not None for edge in edges])
    assert len(influences(poses, edges, kept).edges) == len(misfits(poses, edges, kept, [0])) == 0


def test_what_some_edges_miss_is_reported_without_what_they_move() -> None:
    poses, edges = ring(*RINGS["plane"])
    found = influences(poses, edges, kept := np.ones(len(edges), np.bool_))
    some = found.edges[1::2].tolist()
    assert misfits(poses, edges, kept, some) == pytest.approx(found.left_out[1::2], rel=1e-9)
    assert len(misfits(poses, edges, kept, [])) == 0


def test_snooping_leaves_out_false_loops_alone_and_together() -> None:
    # The procedure of the page's button, in the trial of false loops.
    poses, edges = ring(*RINGS["plane"], laps=6)
    true = len(edges)
    claims = [(2, 40), (50, 70), (51, 71), (52, 72)]
    far = gtsam.Pose2(0.5, 2.0, 1.0)
    edges += [
        Edge(*ends, poses[ends[0]].between(poses[ends[1]]).compose(far), PLANE, EdgeKind.LOOP, False, 100 + n)
        for n, ends in enumerate(claims)
    ]
    loops = np.array([n for n, edge in enumerate(edges) if edge.loop is not None])
    ends = np.array([(edges[n].source, edges[n].target) for n in loops])
    for reach in (0, 3):
        order, within = snooped(solved(poses, edges), edges, loops, ends, reach, len(claims))
        assert sorted(order[:within]) == list(range(true, len(edges)))
