import gzip
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.errors import MapFileError
from slam.storage.g2o import G2oEdge, G2oGraph, read_g2o, write_g2o

POSEGRAPHS = Path(__file__).parents[2] / ".." / "shared" / "data" / "posegraph"
INFORMATION_2D = "1 0 0 1 0 1"


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


@given(seed=st.integers(0, 2**32 - 1), is_3d=st.booleans(), packed=st.booleans())
def test_reading_back_gives_the_same_graph(tmp_path_factory, seed, is_3d, packed):
    graph = random_graph(np.random.default_rng(seed), is_3d)
    path = tmp_path_factory.mktemp("g2o") / ("graph.g2o.gz" if packed else "graph.g2o")
    write_g2o(path, graph)
    back = read_g2o(path)
    assert back.is_3d() == is_3d
    assert list(back.vertices) == list(graph.vertices)
    assert back.fixed == graph.fixed
    for vertex, pose in graph.vertices.items():
        assert pose.equals(back.vertices[vertex], 1e-12)
        if not is_3d:
            assert (pose.x(), pose.y()) == (back.vertices[vertex].x(), back.vertices[vertex].y())
    assert len(back.edges) == len(graph.edges)
    for edge, again in zip(graph.edges, back.edges, strict=True):
        assert (edge.i, edge.j) == (again.i, again.j)
        assert edge.T_i_j.equals(again.T_i_j, 1e-12)
        assert np.array_equal(np.triu(edge.information), np.triu(again.information)) or is_3d
        np.testing.assert_allclose(again.information, edge.information, rtol=1e-9)


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


def test_a_3d_file_keeps_translation_first_and_gtsam_rotation_first(tmp_path):
    upper = [[10 * r + c if c >= r else 0 for c in range(1, 7)] for r in range(1, 7)]
    numbers = " ".join(str(v) for r, row in enumerate(upper) for v in row[r:])
    path = tmp_path / "graph.g2o"
    path.write_text(f"EDGE_SE3:QUAT 0 1 1 2 3 0 0 0.6 0.8 {numbers}\n")
    (edge,) = read_g2o(path).edges
    # g2o's third coordinate (z) is gtsam's sixth, g2o's fourth (first rotation) gtsam's first.
    assert edge.information[5, 5] == 33
    assert edge.information[0, 0] == 44
    assert edge.information[0, 5] == edge.information[5, 0] == 34
    np.testing.assert_allclose(edge.T_i_j.translation(), [1, 2, 3])
    assert edge.T_i_j.rotation().yaw() == pytest.approx(2 * np.arctan2(0.6, 0.8))
    write_g2o(path, G2oGraph({}, [edge]))
    assert [float(v) for v in path.read_text().split()[10:]] == [float(v) for v in numbers.split()]


@pytest.mark.parametrize("name", ["intel", "MIT", "smallGrid3D", "sphere2500"])
def test_public_graphs_read_as_gtsam_reads_them(tmp_path, name):
    packed = POSEGRAPHS / f"{name}.g2o.gz"
    if not packed.exists():
        pytest.skip(f"no pose graphs under {POSEGRAPHS}")
    graph = read_g2o(packed)
    plain = tmp_path / "graph.g2o"
    plain.write_bytes(gzip.decompress(packed.read_bytes()))
    factors, values = gtsam.readG2o(str(plain), graph.is_3d())
    assert len(graph.vertices) == values.size()
    pose_at = values.atPose3 if graph.is_3d() else values.atPose2
    assert all(pose.equals(pose_at(vertex), 1e-9) for vertex, pose in graph.vertices.items())
    assert len(graph.edges) == factors.size()
    for index in range(0, factors.size(), 7):
        factor, edge = factors.at(index), graph.edges[index]
        assert factor.keys() == [edge.i, edge.j]
        assert factor.measured().equals(edge.T_i_j, 1e-9)
        np.testing.assert_allclose(factor.noiseModel().information(), edge.information, rtol=1e-6, atol=1e-6)


def test_a_graph_of_edges_alone_is_a_graph(tmp_path):
    packed = POSEGRAPHS / "manhattan.g2o.gz"
    if not packed.exists():
        pytest.skip(f"no pose graphs under {POSEGRAPHS}")
    graph = read_g2o(packed)
    assert (len(graph.vertices), len(graph.edges), graph.fixed) == (0, 5453, frozenset())


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("VERTEX_XY 5 1 2", "unknown record 'VERTEX_XY'"),
        ("VERTEX_SE2 5 1 2", "3 fields"),
        ("VERTEX_SE2 x 1 2 3", "whole numbers"),
        ("VERTEX_SE2 1.5 1 2 3", "whole numbers"),
        ("VERTEX_SE2 0 1 2 3", "vertex 0 is listed twice"),
        ("VERTEX_SE2 5 1 nan 3", "'nan' is not a finite"),
        ("VERTEX_SE3:QUAT 5 1 2 3 0 0 0 1", "mixes 2D and 3D"),
        (f"EDGE_SE2 0 1 1 2 {INFORMATION_2D}", "10 fields"),
        (f"EDGE_SE2 1 1 1 2 3 {INFORMATION_2D}", "to itself"),
        ("FIX", "vertex id is missing"),
        ("FIX a", "whole numbers"),
    ],
)
def test_a_bad_line_is_refused_by_number(tmp_path, line, reason):
    path = tmp_path / "graph.g2o"
    path.write_text(f"VERTEX_SE2 0 0 0 0\n# comment\nVERTEX_SE2 1 1 0 0\n{line}\n")
    with pytest.raises(MapFileError, match=f"graph.g2o:4: .*{reason}"):
        read_g2o(path)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (f"EDGE_SE2 0 9 1 2 3 {INFORMATION_2D}", "edge 0 9 names vertex 9"),
        ("FIX 0 7", "FIX names vertex 7"),
    ],
)
def test_an_id_without_vertex_is_refused(tmp_path, line, reason):
    path = tmp_path / "graph.g2o"
    path.write_text(f"{line}\nVERTEX_SE2 0 0 0 0\n")
    with pytest.raises(MapFileError, match=reason):
        read_g2o(path)


def test_a_quaternion_must_be_of_unit_length(tmp_path):
    path = tmp_path / "graph.g2o"
    path.write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0.5\n")
    with pytest.raises(MapFileError, match=r"graph.g2o:1: quaternion of length 0.5"):
        read_g2o(path)


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
