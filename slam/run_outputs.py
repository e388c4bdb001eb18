"""The files of a finished map: trajectory, graph and grid in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.graph.pose_graph import PoseGraph
from slam.measurements import BoolArray
from slam.pipeline import MapResult
from slam.storage.g2o import G2oEdge, G2oGraph, write_g2o
from slam.storage.nav2 import write_nav2_map
from slam.storage.tum import write_tum


def save_run(folder: Path, result: MapResult) -> list[Path]:
    """Write ``trajectory.tum``, ``graph.g2o`` and, where there is a grid, ``map.yaml`` and ``map.pgm``.

    Parameters
    ----------
    folder
        Must exist; files of an earlier run are replaced one by one.

    Returns
    -------
    What was written.

    Raises
    ------
    MapFileError
        Where a file cannot be written.
    """
    trajectory, graph = folder / "trajectory.tum", folder / "graph.g2o"
    write_tum(trajectory, result.trajectory)
    write_g2o(graph, g2o_graph(result.graph, result.edges_kept))
    if result.grid is None:
        return [trajectory, graph]
    return [trajectory, graph, *write_nav2_map(folder / "map", result.grid)]


def g2o_graph(graph: PoseGraph, kept: BoolArray) -> G2oGraph:
    """The optimised nodes and the edges that hold (``kept``: (E,)), node 0 fixed."""
    return G2oGraph(
        {key: graph.pose(key) for key in range(len(graph))},
        [
            G2oEdge(
                edge.source,
                edge.target,
                edge.T_source_target,
                np.asarray(np.linalg.inv(edge.covariance), dtype=np.float64),
            )
            for edge, keep in zip(graph.edges, kept, strict=True)
            if keep
        ],
        frozenset({0}),
    )
