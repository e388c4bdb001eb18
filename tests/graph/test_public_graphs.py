"""Public pose graphs reach the errors that are known of them."""

from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.graph.pose_graph import Edge, EdgeKind, PoseGraph
from slam.storage.g2o import G2oGraph, read_g2o

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


def pose_graph_of(file: G2oGraph) -> PoseGraph:
    """The file's graph on nodes 0..n-1, all edges trusted; a file of edges alone gives no guesses."""
    ids = list(file.vertices) or sorted({vertex for edge in file.edges for vertex in (edge.i, edge.j)})
    number = {vertex: n for n, vertex in enumerate(ids)}
    nowhere = gtsam.Pose3() if file.is_3d() else gtsam.Pose2()
    graph = PoseGraph(file.vertices.get(ids[0], nowhere))
    for vertex in ids[1:]:
        graph.add_node(file.vertices.get(vertex, nowhere))
    for edge in file.edges:
        graph.add_edge(
            Edge(
                number[edge.i],
                number[edge.j],
                edge.T_i_j,
                np.linalg.inv(edge.information),
                EdgeKind.LIDAR,
                trusted=True,
            )
        )
    return graph


@pytest.mark.parametrize("name", KNOWN_ERRORS)
def test_known_error(name: str) -> None:
    path = GRAPHS / f"{name}.g2o.gz"
    if not path.exists():
        pytest.skip(f"{path} is not there: the optimum of public graphs stays UNTESTED")
    graph = pose_graph_of(read_g2o(path))
    graph.initialize()
    result = graph.optimize()
    assert result.error == pytest.approx(KNOWN_ERRORS[name], rel=1e-3)
    assert result.kept.all()
