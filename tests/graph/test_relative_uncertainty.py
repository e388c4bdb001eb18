"""The Dijkstra bound against GTSAM's own marginals."""

import gtsam
import numpy as np
import pytest

from slam.graph import relative_uncertainty
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row


class Twin:
    """The same graph for GTSAM and for the bound; edges agree with the poses, so both linearise alike."""

    def __init__(self, poses: FloatArray) -> None:
        self.poses = poses
        self.bound = UncertaintyGraph()
        self.factors = gtsam.NonlinearFactorGraph()
        self.values = gtsam.Values()
        for n, pose in enumerate(poses):
            self.bound.add_node()
            self.values.insert(n, pose2_from_row(pose))
        self.factors.add(
            gtsam.PriorFactorPose2(0, pose2_from_row(poses[0]), gtsam.noiseModel.Isotropic.Sigma(3, 1e-3))
        )

    def join(self, source: int, target: int, covariance: FloatArray) -> None:
        relative = between(self.poses[source], self.poses[target])
        self.bound.add_edge(source, target, relative, covariance)
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        self.factors.add(gtsam.BetweenFactorPose2(source, target, pose2_from_row(relative), noise))

    def exact(self, start: int, target: int) -> FloatArray:
        """Covariance of inverse(pose_target) * pose_start in the start's frame, by the marginals."""
        marginals = gtsam.Marginals(self.factors, self.values)
        keys = [start, target]
        joint = marginals.jointMarginalCovariance(keys)
        blocks = np.block([[joint.at(a, b) for b in keys] for a in keys])
        back = pose2_from_row(self.poses[start]).between(pose2_from_row(self.poses[target])).AdjointMap()
        jacobian = np.hstack([np.eye(3), -back])
        return jacobian @ blocks @ jacobian.T


def random_covariance(rng: np.random.Generator) -> FloatArray:
    root = rng.normal(0.0, [0.05, 0.05, 0.02], (6, 3))
    return root.T @ root


def walk(rng: np.random.Generator, count: int) -> FloatArray:
    """A meandering walk that starts somewhere."""
    poses = [np.array([3.0, -2.0, 0.8])]
    for _ in range(count - 1):
        poses.append(compose(poses[-1], rng.normal([0.5, 0.0, 0.0], [0.2, 0.1, 0.5])))
    return np.array(poses)


@pytest.mark.parametrize("start", [0, 4, 9])
@pytest.mark.parametrize("seed", range(3))
def test_on_a_chain_it_is_exact(seed: int, start: int) -> None:
    rng = np.random.default_rng(seed)
    twin = Twin(walk(rng, 10))
    for n in range(9):
        # Some edges run backward in the chain.
        ends = (n, n + 1) if n % 3 else (n + 1, n)
        twin.join(*ends, random_covariance(rng))
    others = np.array([n for n in range(10) if n != start])
    found = twin.bound.relative_covariances(start, others, twin.poses)
    for target, covariance in zip(others, found, strict=True):
        np.testing.assert_allclose(covariance, twin.exact(start, int(target)), rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("anchors", [4096, 16, 8])
@pytest.mark.parametrize("seed", range(4))
def test_with_loops_it_is_an_upper_bound(seed: int, anchors: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Any path alone says less than the whole graph: the difference has no negative eigenvalue."""
    monkeypatch.setattr(relative_uncertainty, "_MOST_ANCHORS", anchors)
    rng = np.random.default_rng(seed)
    twin = Twin(walk(rng, 30))
    for n in range(29):
        twin.join(n, n + 1, random_covariance(rng))
    for _ in range(12):
        a, b = rng.choice(30, 2, replace=False)
        twin.join(int(a), int(b), random_covariance(rng))
    targets = np.arange(29)
    twin.join(28, 29, random_covariance(rng))  # grown by now: a second one between two that share an anchor
    found = twin.bound.relative_covariances(29, targets, twin.poses)
    shares = []
    for target in targets:
        exact = twin.exact(29, int(target))
        assert np.trace(found[target]) >= np.trace(exact) - 1e-9
        assert np.linalg.eigvalsh(found[target] - exact)[0] > -1e-7
        shares.append(np.trace(found[target]) / np.trace(exact))
    assert np.median(shares) < 10.0, "a bound, and a useful one"


def test_a_loop_lowers_the_bound() -> None:
    poses = np.column_stack([np.arange(20.0), np.zeros(20), np.zeros(20)])
    twin = Twin(poses)
    for n in range(19):
        twin.join(n, n + 1, np.eye(3) * 0.01)
    target = np.array([0])
    before = twin.bound.relative_covariances(19, target, poses)[0]
    twin.join(0, 19, np.eye(3) * 0.002)
    after = twin.bound.relative_covariances(19, target, poses)[0]
    np.testing.assert_allclose(after[2, 2], 0.002)
    assert before[2, 2] == pytest.approx(0.19)
    assert np.trace(after) < 0.2 * np.trace(before)


def test_the_surer_of_two_ways_is_taken_however_many_edges_it_has() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    twin = Twin(poses)
    twin.join(0, 2, np.eye(3) * 1e-4)
    twin.join(0, 1, np.eye(3) * 1e-6)
    twin.join(1, 2, np.eye(3) * 1e-6)
    assert twin.bound.relative_covariances(2, np.array([0]), poses)[0, 2, 2] == pytest.approx(2e-6)


def test_no_path_is_infinite() -> None:
    poses = np.zeros((4, 3))
    twin = Twin(poses)
    twin.join(0, 1, np.eye(3) * 0.01)
    twin.join(2, 3, np.eye(3) * 0.01)
    found = twin.bound.relative_covariances(3, np.array([0, 1, 2]), poses)
    assert np.isinf(found[:2]).all()
    assert np.isfinite(found[2]).all()


def test_itself_and_nothing() -> None:
    twin = Twin(np.zeros((2, 3)))
    twin.join(0, 1, np.eye(3))
    np.testing.assert_array_equal(
        twin.bound.relative_covariances(1, np.array([1]), twin.poses), np.zeros((1, 3, 3))
    )
    assert twin.bound.relative_covariances(1, np.array([], dtype=np.int64), twin.poses).shape == (0, 3, 3)


def test_the_order_of_the_targets_does_not_matter() -> None:
    """Targets that share a stretch of path reuse it; whichever comes first."""
    rng = np.random.default_rng(1)
    twin = Twin(walk(rng, 15))
    for n in range(14):
        twin.join(n, n + 1, random_covariance(rng))
    order = rng.permutation(14)
    straight = twin.bound.relative_covariances(14, np.arange(14), twin.poses)
    shuffled = twin.bound.relative_covariances(14, order, twin.poses)
    np.testing.assert_array_equal(shuffled, straight[order])


def test_a_graph_that_outgrows_its_first_arrays() -> None:
    """More nodes and edges than the arrays begin with: 64 and 256."""
    poses = np.column_stack([0.1 * np.arange(700), np.zeros(700), np.zeros(700)])
    graph = UncertaintyGraph()
    graph.add_node()
    for n in range(1, 700):
        graph.add_node()
        graph.add_edge(n - 1, n, np.array([0.1, 0.0, 0.0]), np.diag([1e-4, 1e-4, 0.0]) + 1e-12 * np.eye(3))
    found = graph.relative_covariances(699, np.array([0, 350]), poses)
    np.testing.assert_allclose(found[:, 0, 0], [699e-4, 349e-4], rtol=1e-6)


def drive(keyframes: int, laps: int) -> tuple[UncertaintyGraph, FloatArray]:
    """Laps of a square, each lap joined to the one before at every tenth node."""
    lap = keyframes // laps
    turn = 2.0 * np.pi * (np.arange(keyframes) % lap) / lap
    poses = np.column_stack([20.0 * np.cos(turn), 20.0 * np.sin(turn), turn])
    graph = UncertaintyGraph()
    for n in range(keyframes):
        graph.add_node()
        if n:
            graph.add_edge(n - 1, n, between(poses[n - 1], poses[n]), 1e-6 * np.eye(3))
        if n >= lap and n % 10 == 0:
            graph.add_edge(n - lap, n, between(poses[n - lap], poses[n]), 1e-5 * np.eye(3))
    return graph, poses


def test_a_search_visits_no_more_in_a_log_of_many_laps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every lap is another hundred nodes that the places wanted lie among."""
    visited = []

    def counting(*arrays: object) -> None:
        follow(*arrays)
        visited.append(int(np.isfinite(arrays[9]).sum()))

    follow = relative_uncertainty._follow
    monkeypatch.setattr(relative_uncertainty, "_follow", counting)
    monkeypatch.setattr(relative_uncertainty, "_MOST_ANCHORS", 256)
    sigmas_m = []
    for laps in (2, 20, 80):
        graph, poses = drive(100 * laps, laps)
        targets = np.arange(50, len(poses) - 100, 100)
        found = graph.relative_covariances(len(poses) - 1, targets, poses)
        sigmas_m.append(np.sqrt(found[-1, 0, 0]))
    assert max(visited) <= 256 and visited[0] > 100
    # Paths by way of anchors are a little longer.
    assert sigmas_m[2] < 1.6 * sigmas_m[0]


@pytest.mark.parametrize("anchors", [4, 10, 32])
def test_anchors_make_a_chain_no_more_uncertain_than_the_way_back_to_them(
    anchors: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relative_uncertainty, "_MOST_ANCHORS", anchors)
    poses = np.zeros((70, 3))
    graph = UncertaintyGraph()
    for n in range(70):
        graph.add_node()
        if n:
            graph.add_edge(n - 1, n, np.zeros(3), np.eye(3))
    targets = np.arange(69)
    steps = graph.relative_covariances(69, targets, poses)[:, 0, 0]
    stride = next(2**k for k in range(8) if anchors * 2**k >= 70)
    assert (steps >= 69 - targets).all()
    apart = targets // stride != 69 // stride
    assert (steps[apart] < 69 - targets[apart] + 2 * stride).all()
