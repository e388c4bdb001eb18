from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.errors import MapFileError
from slam.storage.g2o import G2oEdge, G2oGraph, write_g2o


def random_information(rng, size):
    root = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-3, 3)
    return root @ root.T


def random_graph(rng, is_3d, count=4):
    def pose():
        if is_3d:
            return gtsam.Pose3.Expmap(rng.normal(size=6))
        return gtsam.Pose2(*(rng.normal(size=3) * [100.0, 100.0, 1.0]))

    vertices = {int(i): pose() for i in rng.permutation(50)[:count]}
    ids = list(vertices)
    edges = [G2oEdge(i, j, pose(), random_information(rng, 6 if is_3d else 3)) for i, j in pairwise(ids)]
    return G2oGraph(vertices, edges, frozenset(ids[:1]))


@given(seed=st.integers(0, 2**32 - 1), is_3d=st.booleans())
def test_gtsam_reads_the_same_graph(tmp_path_factory, seed, is_3d):
    graph = random_graph(np.random.default_rng(seed), is_3d)
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    write_g2o(path, graph)
    factors, values = gtsam.readG2o(str(path), is_3d)
    assert sorted(values.keys()) == sorted(graph.vertices)
    pose_at = values.atPose3 if is_3d else values.atPose2
    assert all(pose.equals(pose_at(vertex), 1e-12) for vertex, pose in graph.vertices.items())
    assert factors.size() == len(graph.edges)
    for number, edge in enumerate(graph.edges):
        factor = factors.at(number)
        assert factor.keys() == [edge.i, edge.j]
        assert factor.measured().equals(edge.T_i_j, 1e-12)
        information = factor.noiseModel().information()
        np.testing.assert_allclose(information, edge.information, rtol=1e-6, atol=1e-9 * information.max())


def test_a_number_is_written_to_its_last_digit_and_who_may_not_move(tmp_path):
    pose = gtsam.Pose2(0.1 + 0.2, -1.0 / 3.0, 2.0 / 3.0)
    write_g2o(tmp_path / "graph.g2o", G2oGraph({4: pose}, [], frozenset({4})))
    vertex, fixed = (tmp_path / "graph.g2o").read_text().splitlines()
    assert [float(text) for text in vertex.split()[2:4]] == [pose.x(), pose.y()]
    assert fixed == "FIX 4"


def test_a_3d_file_keeps_translation_first_and_gtsam_rotation_first(tmp_path):
    information = np.diag([4.0, 5.0, 6.0, 1.0, 2.0, 3.0])
    information[0, 5] = information[5, 0] = 0.5
    write_g2o(tmp_path / "graph.g2o", G2oGraph({}, [G2oEdge(0, 1, gtsam.Pose3(), information)]))
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = [float(v) for v in (tmp_path / "graph.g2o").read_text().split()[10:]]
    assert np.diag(upper).tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    # g2o's third coordinate (z) is gtsam's sixth, g2o's fourth (first rotation) gtsam's first.
    assert upper[2, 3] == 0.5


@pytest.mark.parametrize(
    ("graph", "reason"),
    [
        (G2oGraph({}, []), "empty"),
        (G2oGraph({0: gtsam.Pose2(), 1: gtsam.Pose3()}, []), "mixes Pose2 and Pose3"),
        (G2oGraph({0: gtsam.Pose2(np.nan, 0, 0)}, []), "not finite"),
        (G2oGraph({}, [G2oEdge(0, 1, gtsam.Pose2(), np.eye(6))]), "3 x 3 information"),
        (G2oGraph({}, [G2oEdge(0, 1, gtsam.Pose2(), np.triu(np.ones((3, 3))))]), "symmetric"),
        (G2oGraph({0: gtsam.Pose2()}, [], frozenset({3})), "FIX names vertex 3"),
    ],
)
def test_nothing_is_written_that_is_not_a_graph(tmp_path, graph, reason):
    with pytest.raises(MapFileError, match=reason):
        write_g2o(tmp_path / "graph.g2o", graph)
    assert not list(tmp_path.iterdir())
