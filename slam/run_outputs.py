"""The files of a finished map: trajectory, graph and grid in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.config_stages import DenseMapConfig
from slam.graph.pose_graph import PoseGraph
from slam.map_result import DenseKeyframes, MapResult
from slam.mapping.dense_map import DenseMapSettings, fuse_keyframes
from slam.measurements import BoolArray
from slam.storage.g2o import G2oEdge, G2oGraph, write_g2o
from slam.storage.nav2 import write_nav2_map
from slam.storage.octomap import write_octomap
from slam.storage.ply import write_cloud_ply, write_mesh_ply
from slam.storage.tum import write_tum


def save_run(folder: Path, result: MapResult, dense: DenseMapConfig | None = None) -> list[Path]:
    """Write ``trajectory.tum``, ``graph.g2o``, and what else there is.

    With a grid ``map.yaml`` and ``map.pgm``, with camera keyframes ``mesh.ply`` and ``cloud.ply``.

    Parameters
    ----------
    folder
        Must exist; files of an earlier run are replaced one by one.
    dense
        How the coloured map is made.

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
    written = [trajectory, graph]
    if result.grid is not None:
        written += write_nav2_map(folder / "map", result.grid)
    dense = dense or DenseMapConfig()
    if result.dense is not None and dense.enabled:
        written += _save_dense(folder, result.dense, dense)
    return written


def _save_dense(folder: Path, keyframes: DenseKeyframes, config: DenseMapConfig) -> list[Path]:
    """The coloured mesh and cloud of the camera keyframes, and the octree where asked for."""
    settings = DenseMapSettings(
        voxel_size_m=config.voxel_m, depth_min_m=config.nearest_m, depth_max_m=config.farthest_m
    )
    dense = fuse_keyframes(keyframes.frames, keyframes.poses, settings)
    written = []
    if len(dense.mesh.faces):
        write_mesh_ply(folder / "mesh.ply", dense.mesh)
        written.append(folder / "mesh.ply")
    if len(dense.cloud.points_map):
        write_cloud_ply(folder / "cloud.ply", dense.cloud)
        written.append(folder / "cloud.ply")
    if config.octomap:
        write_octomap(
            folder / "map.bt",
            keyframes.frames,
            keyframes.poses,
            resolution_m=config.octomap_cell_m,
            range_max_m=config.farthest_m,
        )
        written.append(folder / "map.bt")
    return written


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
