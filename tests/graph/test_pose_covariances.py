"""Covariances of keyframes in closed form on chains, in space as in the plane, and by what each rule says."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam.config import Config
from slam.graph.anchors import Anchor, anchored
from slam.graph.edge import Edge, EdgeKind
from slam.graph.factors import solved
from slam.graph.held_graph import held_graph, marginals
from slam.graph.pose_covariances import pose_covariances
from slam.measurements import FloatArray, Pose

CONFIG = Config()
STEP = gtsam.Pose2(1.0, 0.0, 0.0)
MATCH = np.diag([0.01, 0.02, 0.003]) ** 2
GAUGE = 1e-8 * np.eye(3)


def chain(count: int, covariance: FloatArray = MATCH, step: Pose = STEP) -> tuple[list[Pose], list[Edge]]:
    """Poses along a line, joined by trusted matches."""
    poses = [type(step)()]
    for _ in range(count):
        poses.append(poses[-1].compose(step))
    edges = [Edge(n, n + 1, step, covariance, EdgeKind.LIDAR, trusted=True) for n in range(count)]
    return poses, edges


def stated(poses: Sequence[Pose], edges: list[Edge], kept: list[bool] | None = None) -> FloatArray:
    """Of the nodes, which are the bases."""
    return pose_covariances(poses, poses, edges, kept or [True] * len(edges), CONFIG)[0]


def claimed(edges: Sequence[Edge], factor: float = 0.5) -> list[Edge]:
    """As uncertain as they are stated to be where no loop shows more."""
    return [replace(edge, covariance=factor * edge.covariance) for edge in edges]


def test_marginals_of_a_chain_add_up_in_the_frame_of_its_end() -> None:
    poses, edges = chain(2)
    back = STEP.inverse().AdjointMap()
    expected = back @ (back @ GAUGE @ back.T + MATCH) @ back.T + MATCH
    assert marginals(poses, edges)[2] == pytest.approx(expected, rel=1e-6)


def test_marginals_are_those_that_gtsam_finds_node_by_node() -> None:
    poses, edges = chain(40)
    ends = [(3, 30), (5, 20), (20, 33), (0, 39)]
    edges += [
        replace(edges[0], source=a, target=b, T_source_target=poses[a].between(poses[b])) for a, b in ends
    ]
    graph, values = held_graph(poses, edges)
    solved = gtsam.Marginals(graph, values)
    expected = [solved.marginalCovariance(node) for node in range(len(poses))]
    np.testing.assert_allclose(marginals(poses, edges), expected, rtol=1e-8, atol=1e-12)


def test_marginals_of_a_long_stiff_chain_lose_no_digits() -> None:
    stiff = np.diag([1e-3, 1e-3, 1e-5]) ** 2
    poses, edges = chain(3000, stiff)
    lateral = 3000 * 1e-6 + 1e-10 * np.sum(np.arange(3000.0) ** 2) + 1e-8 * 3000.0**2
    assert marginals(poses, edges)[-1][1, 1] == pytest.approx(lateral, rel=1e-3)


def test_space_says_the_same_as_the_plane() -> None:
    flat, edges = chain(5)
    spatial = np.diag([1e-3, 1e-3, 0.003, 0.01, 0.02, 1e-3]) ** 2
    poses, spatial_edges = chain(5, spatial, gtsam.Pose3(STEP))
    picked = np.ix_([3, 4, 2], [3, 4, 2])  # x, y, yaw among rotation and translation
    assert stated(poses, spatial_edges)[5][picked] == pytest.approx(stated(flat, edges)[5], rel=1e-6)


def test_a_base_beside_its_camera_is_moved_by_its_turns() -> None:
    poses, edges = chain(3)
    bases = [pose.compose(gtsam.Pose2(0.0, 2.0, 0.0)) for pose in poses]
    nodes, _ = pose_covariances(poses, poses, edges, [True] * 3, CONFIG)
    found, steps = pose_covariances(poses, bases, edges, [True] * 3, CONFIG)
    # 2 m to the left of the node, a turn moves the base along x.
    arm = np.array([[1.0, 0.0, -2.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert found[3] == pytest.approx(arm @ nodes[3] @ arm.T, rel=1e-6)
    assert steps[2] == pytest.approx(0.5 * arm @ MATCH @ arm.T, rel=1e-6)


def test_two_loops_and_a_step_into_one_keyframe_are_one_witness() -> None:
    poses, edges = chain(5)
    # They close nothing that is far back, so nothing is learned of the variance.
    near = [
        Edge(place, 5, poses[place].between(poses[5]), MATCH, EdgeKind.LOOP, trusted=False, loop=0)
        for place in (2, 3)
    ]
    found = stated(poses, edges + near)[5]
    shared = claimed(edges[:4]) + claimed([edges[4], *near], 3.0 * 0.5)
    assert found == pytest.approx(marginals(poses, shared)[5], rel=1e-6)
    as_if_independent, alone = marginals(poses, claimed(edges + near))[5], marginals(poses, claimed(edges))[5]
    assert np.trace(as_if_independent) < np.trace(found) < np.trace(alone)


@pytest.mark.parametrize("gaps, surplus", [(0, 3), (1, 0), (3, 0)])
def test_a_loop_over_gaps_says_how_long_these_are_and_nothing_of_matches(gaps: int, surplus: int) -> None:
    poses, edges = chain(60)
    for n in range(gaps):
        edges[n] = replace(edges[n], kind=EdgeKind.WHEEL)
    loop = Edge(0, 50, poses[0].between(poses[50]), MATCH, EdgeKind.LOOP, trusted=False, loop=0)
    _, steps = pose_covariances(poses, poses, [*edges, loop], [True] * 61, CONFIG)
    assert steps[10] == pytest.approx(0.5 * 20.0 / (20.0 + surplus) * MATCH, rel=1e-6)


def test_a_camera_claims_the_noise_of_a_step_once() -> None:
    poses, edges = chain(4)
    seen = [replace(edge, kind=EdgeKind.RGBD) for edge in edges]
    assert stated(poses, seen)[4] == pytest.approx(marginals(poses, seen)[4], rel=1e-6)


def test_loops_that_fit_better_than_claimed_make_all_matches_surer() -> None:
    poses, edges = chain(60)
    # They fit exactly: three numbers for all between the same two local maps of 30 keyframes, beside 20 of
    # half the claim.
    loops = [
        Edge(n, n + 50, poses[n].between(poses[n + 50]), MATCH, EdgeKind.LOOP, trusted=False, loop=n)
        for n in range(7)
    ]
    ratio = 0.5 * 20.0 / (20.0 + 3.0)
    expected = (
        claimed(edges[:49], ratio) + claimed(edges[49:56] + loops, 2.0 * ratio) + claimed(edges[56:], ratio)
    )
    assert stated(poses, edges + loops)[20] == pytest.approx(marginals(poses, expected)[20], rel=1e-6)


def test_loops_that_miss_make_all_matches_less_sure() -> None:
    poses, edges = chain(60)
    missed = poses[0].between(poses[50]).compose(gtsam.Pose2(0.1, 0.0, 0.0))
    loop = Edge(0, 50, missed, MATCH, EdgeKind.LOOP, trusted=False, loop=0)
    ratio = (0.5 * 20.0 + (0.1 / 0.01) ** 2) / 23.0
    assert ratio > 4.0
    assert stated(poses, [*edges, loop])[20] == pytest.approx(
        marginals(
            poses,
            claimed(edges[:49], ratio) + claimed([edges[49], loop], 2.0 * ratio) + claimed(edges[50:], ratio),
        )[20],
        rel=0.01,
    )


def test_a_match_past_a_guess_is_not_believed() -> None:
    poses, edges = chain(1)
    guessed = 100.0 * MATCH
    poses += [poses[-1].compose(STEP), poses[-1].compose(STEP).compose(STEP)]
    edges += [
        Edge(1, 2, STEP, guessed, EdgeKind.WHEEL, trusted=True),
        Edge(2, 3, STEP, MATCH, EdgeKind.LIDAR, trusted=True),
    ]
    bridge = Edge(1, 3, STEP.compose(STEP), MATCH, EdgeKind.LIDAR, trusted=False)
    assert stated(poses, [*edges, bridge])[3] == pytest.approx(stated(poses, edges)[3], rel=1e-9)


@pytest.mark.parametrize("refused", [0, 3])
def test_wheels_alone_are_as_uncertain_as_the_mixture_of_their_rule_and_their_claim(refused: int) -> None:
    rule, claim, count = MATCH, 400.0 * MATCH, 8
    poses, _ = chain(count)
    edges, kept = [], []
    for n in range(count):
        edges += [
            Edge(n, n + 1, STEP, rule, EdgeKind.WHEEL, trusted=False),
            Edge(n, n + 1, STEP, claim, EdgeKind.ASSUMED, trusted=True),
        ]
        kept += [n >= refused, True]
    wrong = (refused + 1) / (count + 2)
    mixed = np.linalg.inv(np.linalg.inv((1 - wrong) * rule + wrong * claim) + np.linalg.inv(claim))
    _, steps = pose_covariances(poses, poses, edges, kept, CONFIG)
    assert steps[-1] == pytest.approx(mixed, rel=1e-6)
    assert steps[0] == pytest.approx(claim if refused else mixed, rel=1e-6)


def test_a_single_keyframe_is_the_frame_itself() -> None:
    covariances, steps = pose_covariances([gtsam.Pose2()], [gtsam.Pose2()], [], [], CONFIG)
    assert covariances.shape == (1, 3, 3) and steps.shape == (0, 3, 3)
    assert np.trace(covariances[0]) < 1e-6


def test_between_two_sessions_nothing_was_measured() -> None:
    poses, edges = chain(3)
    joined = [edges[0], edges[2], Edge(0, 2, poses[2], MATCH, EdgeKind.LOOP, trusted=False, loop=0)]
    _, steps = pose_covariances(poses, poses, joined, [True] * 3, CONFIG)
    assert np.sqrt(np.diag(steps[1])) == pytest.approx([1.0, 1.0, 0.5])


def test_ellipses_hold_as_many_true_poses_as_they_say() -> None:
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(200):
        poses, edges = chain(6, step=gtsam.Pose2(1.0, 0.2, 0.5))
        covariances = marginals(poses, edges)
        true = gtsam.Pose2()
        for edge in edges:
            noise = gtsam.Pose2.Expmap(rng.multivariate_normal(np.zeros(3), MATCH))
            true = true.compose(edge.T_source_target.compose(noise))
        off = gtsam.Pose2.Logmap(poses[-1].between(true))
        inside.append(off @ np.linalg.solve(covariances[-1], off) < 7.815)
    assert 0.91 < np.mean(inside) < 0.99


@pytest.mark.parametrize("planar", [True, False])
def test_surveyed_places_do_not_say_where_the_first_node_is(planar: bool) -> None:
    """Nodes 6 and 12 of a noisy chain are surveyed; the claim is the error relative to node 0."""
    rng, squares = np.random.default_rng(0), list[float]()
    spread = MATCH if planar else np.diag([1e-3, 1e-3, 0.003, 0.01, 0.02, 0.01]) ** 2
    step = STEP if planar else gtsam.Pose3(STEP)
    true, _ = chain(12, spread, step)
    kind = type(step)
    for _ in range(60):
        noise = rng.multivariate_normal(np.zeros(len(spread)), spread, 12)
        steps = [step.compose(kind.Expmap(one)) for one in noise]
        edges = [Edge(n, n + 1, one, spread, EdgeKind.WHEEL, trusted=True) for n, one in enumerate(steps)]
        poses = [kind()]
        for one in steps:
            poses.append(poses[-1].compose(one))
        places = {n: np.array([float(n), 0.0, 0.0]) + rng.normal(0.0, 0.003, 3) for n in (6, 12)}
        anchors = [Anchor(n, place, 9e-6 * np.eye(3), np.zeros(3)) for n, place in places.items()]
        found = anchored(poses, edges, anchors, EdgeKind.SURVEY)
        assert found is not None
        values = solved(*held_graph(poses, [*edges, *found.edges]))
        poses = [values.atPose2(n) if planar else values.atPose3(n) for n in range(13)]
        claim = stated(poses, [*edges, *found.edges])
        for n in (6, 12):
            missed = kind.Logmap(poses[n].between(true[n]))
            squares.append(float(missed @ np.linalg.solve(claim[n], missed)) / len(missed))
    assert 0.7 < np.mean(squares) < 1.3
