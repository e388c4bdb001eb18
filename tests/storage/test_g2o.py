from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.errors import MapFileError
from slam.graph.edge import Edge, EdgeKind
from slam.storage.g2o import write_g2o


def edge(i, j, T_i_j, covariance):
    return Edge(i, j, T_i_j, covariance, EdgeKind.LIDAR, True)


def random_covariance(rng, size):
    root = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-3, 3)
    return root @ root.T


def random_graph(rng, is_3d, count=4):
    def pose():
        if is_3d:
            return gtsam.Pose3.Expmap(rng.normal(size=6))
        return gtsam.Pose2(*(rng.normal(size=3) * [100.0, 100.0, 1.0]))

    edges = [edge(i, j, pose(), random_covariance(rng, 6 if is_3d else 3)) for i, j in pairwise(range(count))]
    return [pose() for _ in range(count)], edges


@given(seed=st.integers(0, 2**32 - 1), is_3d=st.booleans())
def test_gtsam_reads_the_same_graph(tmp_path_factory, seed, is_3d):
    poses, edges = random_graph(np.random.default_rng(seed), is_3d)
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    write_g2o(path, poses, edges)
    factors, values = gtsam.readG2o(str(path), is_3d)
    assert sorted(values.keys()) == list(range(len(poses)))
    pose_at = values.atPose3 if is_3d else values.atPose2
    assert all(pose.equals(pose_at(vertex), 1e-12) for vertex, pose in enumerate(poses))
    assert factors.size() == len(edges)
    for number, one in enumerate(edges):
        factor = factors.at(number)
        assert factor.keys() == [one.source, one.target]
        assert factor.measured().equals(one.T_source_target, 1e-12)
        information, wanted = factor.noiseModel().information(), np.linalg.inv(one.covariance)
        np.testing.assert_allclose(information, wanted, rtol=1e-6, atol=1e-6 * np.abs(wanted).max())


def test_a_number_is_written_to_its_last_digit_and_who_may_not_move(tmp_path):
    pose = gtsam.Pose2(0.1 + 0.2, -1.0 / 3.0, 2.0 / 3.0)
    write_g2o(tmp_path / "graph.g2o", [pose], [])
    vertex, fixed = (tmp_path / "graph.g2o").read_text().splitlines()
    assert [float(text) for text in vertex.split()[2:4]] == [pose.x(), pose.y()]
    assert fixed == "FIX 0"


def test_a_3d_file_keeps_translation_first_and_gtsam_rotation_first(tmp_path):
    information = np.diag([4.0, 5.0, 6.0, 1.0, 2.0, 3.0])
    information[0, 5] = information[5, 0] = 0.5
    poses = [gtsam.Pose3(), gtsam.Pose3()]
    write_g2o(tmp_path / "graph.g2o", poses, [edge(0, 1, gtsam.Pose3(), np.linalg.inv(information))])
    upper = np.zeros((6, 6))
    line = (tmp_path / "graph.g2o").read_text().splitlines()[2]
    upper[np.triu_indices(6)] = [float(v) for v in line.split()[10:]]
    np.testing.assert_allclose(np.diag(upper), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], rtol=1e-12)
    # g2o's third coordinate (z) is gtsam's sixth, g2o's fourth (first rotation) gtsam's first.
    assert upper[2, 3] == pytest.approx(0.5, rel=1e-12)


def test_nothing_is_written_that_is_not_finite(tmp_path):
    with pytest.raises(MapFileError, match="not finite"):
        write_g2o(tmp_path / "graph.g2o", [gtsam.Pose2(np.nan, 0, 0)], [])
    assert not list(tmp_path.iterdir())
