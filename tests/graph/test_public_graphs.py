"""Public pose graphs reach the errors that are known of them."""

import gzip
from itertools import chain
from pathlib import Path

import gtsam
import pytest

from slam.graph.edge import Edge, EdgeKind
from slam.graph.pose_graph import PoseGraph

GRAPHS = Path(__file__).parents[2] / ".." / "shared" / "data" / "posegraph"

# Half chi-square after LAGO or chordal initialisation and LM, from the data's README.
KNOWN_ERRORS = {
    "intel": 22.5021,
    "manhattan": 1774.52,
    "MIT": 385.119,
    "smallGrid3D": 517.925,
    "parking-garage": 0.634192,
    "sphere2500": 675.701,
}


def pose_graph_of(file: Path) -> PoseGraph:
    """A file's graph on nodes 0..n-1, all edges trusted; a file of edges alone gives no guesses."""
    is_3d = "SE3" in file.read_text()[:1000]
    factors, values = gtsam.readG2o(str(file), is_3d)
    edges = [factors.at(number) for number in range(factors.size())]
    ids = list(values.keys()) or sorted(set(chain.from_iterable(edge.keys() for edge in edges)))
    number = {vertex: n for n, vertex in enumerate(ids)}
    pose_at = values.atPose3 if is_3d else values.atPose2
    nowhere = gtsam.Pose3() if is_3d else gtsam.Pose2()
    guesses = [pose_at(vertex) if values.exists(vertex) else nowhere for vertex in ids]
    graph = PoseGraph(guesses[0])
    for guess in guesses[1:]:
        graph.add_node(guess)
    for edge in edges:
        source, target = map(number.__getitem__, edge.keys())
        covariance = edge.noiseModel().covariance()
        graph.add_edge(Edge(source, target, edge.measured(), covariance, EdgeKind.LIDAR, trusted=True))
    return graph


@pytest.mark.parametrize("name", KNOWN_ERRORS)
def test_known_error(name: str, tmp_path: Path) -> None:
    path = GRAPHS / f"{name}.g2o.gz"
    if not path.exists():
        pytest.skip(f"{path} is not there: the optimum of public graphs stays UNTESTED")
    plain = tmp_path / f"{name}.g2o"
    plain.write_bytes(gzip.decompress(path.read_bytes()))
    graph = pose_graph_of(plain)
    graph.initialize()
    result = graph.optimize()
    assert result.error == pytest.approx(KNOWN_ERRORS[name], rel=1e-3)
    assert result.kept.all()
