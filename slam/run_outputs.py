"""The files of a finished map: trajectory, graph and grid in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.config_clouds import CloudMapConfig
from slam.config_stages import DenseMapConfig
from slam.errors import ScanweaveError
from slam.map_result import DenseKeyframes, MapResult
from slam.mapping.cloud_map import map_cloud
from slam.mapping.dense_map import DenseMapSettings, fuse_keyframes
from slam.mapping.layered_map import LayeredMap
from slam.mapping.occupancy_grid import OccupancyGrid
from slam.matching.local_cloud import moved
from slam.storage.files import make_folder
from slam.storage.g2o import G2oEdge, G2oGraph, write_g2o
from slam.storage.map_contents import OCCUPANCY, MapContents, SavedFactor
from slam.storage.nav2 import write_nav2_map
from slam.storage.octomap import write_octomap, write_octree
from slam.storage.ply import write_cloud_ply, write_mesh_ply
from slam.storage.saved_map import SavedMap
from slam.storage.tum import write_tum


def save_run(folder: Path, result: MapResult) -> list[Path]:
    """Write ``trajectory.tum``, ``graph.g2o``, and with a grid ``map.yaml`` and ``map.pgm``.

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
    save_g2o(graph, contents_of(result))
    written = [trajectory, graph]
    if result.grid is not None:
        written += write_nav2_map(folder / "map", result.grid)
    return written


def save_dense(folder: Path, result: MapResult, config: DenseMapConfig) -> list[Path]:
    """Write ``mesh.ply`` and ``cloud.ply`` of the camera keyframes, and ``map.bt`` where it is asked for.

    Raises
    ------
    ScanweaveError
        Where a file cannot be written, or a library that this needs is missing.
    """
    if result.dense is None or not config.enabled:
        return []
    written = save_surface(folder / "mesh.ply", result.dense, config)
    if config.octomap:
        save_octomap(folder / "map.bt", result.dense, config)
        written.append(folder / "map.bt")
    return written


def save_clouds(folder: Path, result: MapResult, config: CloudMapConfig, dense: DenseMapConfig) -> list[Path]:
    """Write ``cloud.ply`` of a 3D lidar's keyframes, and ``map.bt`` where it is asked for.

    Raises
    ------
    ScanweaveError
        Where a file cannot be written, or a library that this needs is missing.
    """
    mapped = result.clouds
    if mapped is None or not (config.enabled and dense.enabled):
        return []
    write_cloud_ply(folder / "cloud.ply", map_cloud(mapped.clouds, mapped.poses, config.voxel_m))
    written = [folder / "cloud.ply"]
    if dense.octomap:
        T_base_lidar = mapped.T_base_lidar
        T_lidar_base = T_base_lidar.inverse()
        views = (
            (moved(points, T_lidar_base), T_map_base.compose(T_base_lidar))
            for points, T_map_base in zip(mapped.clouds, mapped.poses, strict=True)
        )
        write_octree(folder / "map.bt", views, dense.octomap_cell_m, config.plan_range_m)
        written.append(folder / "map.bt")
    return written


def save_surface(path: Path, keyframes: DenseKeyframes, config: DenseMapConfig) -> list[Path]:
    """The coloured mesh of the camera keyframes, and their cloud beside it; nothing where they show none."""
    settings = DenseMapSettings(
        voxel_size_m=config.voxel_m, depth_min_m=config.nearest_m, depth_max_m=config.farthest_m
    )
    dense = fuse_keyframes(keyframes.frames, keyframes.poses, settings)
    cloud = path.with_name("cloud.ply" if path.name == "mesh.ply" else f"{path.stem}-cloud.ply")
    written = []
    if len(dense.mesh.faces):
        write_mesh_ply(path, dense.mesh)
        written.append(path)
    if len(dense.cloud.points_map):
        write_cloud_ply(cloud, dense.cloud)
        written.append(cloud)
    return written


def save_octomap(path: Path, keyframes: DenseKeyframes, config: DenseMapConfig) -> None:
    """The octree of the camera keyframes."""
    write_octomap(
        path,
        keyframes.frames,
        keyframes.poses,
        resolution_m=config.octomap_cell_m,
        range_max_m=config.farthest_m,
    )


def save_g2o(path: Path, contents: MapContents) -> None:
    """Write the optimised nodes and the edges that hold, node 0 fixed."""
    edges = [
        G2oEdge(
            factor.edge.source,
            factor.edge.target,
            factor.edge.T_source_target,
            np.asarray(np.linalg.inv(factor.edge.covariance), dtype=np.float64),
        )
        for factor in contents.factors
        if factor.kept
    ]
    write_g2o(path, G2oGraph(dict(enumerate(contents.node_poses)), edges, frozenset({0})))


def contents_of(result: MapResult, layers: LayeredMap | None = None) -> MapContents:
    """A finished map as it is saved."""
    grids = {} if result.grid is None else {OCCUPANCY: result.grid}
    if layers is not None:
        grids.update(layer_grids(layers))
    # An accepted loop's covariance is the very array of its candidate.
    loops = {id(loop.motion.covariance): n for n, loop in enumerate(result.loops) if loop.motion is not None}
    return MapContents(
        node_poses=[result.graph.pose(node) for node in range(len(result.graph))],
        stamps_s=result.scans.stamps_s[result.keyframe_numbers],
        readings=result.keyframe_numbers,
        measured_scans=result.measured_scans,
        scans=result.keyframe_scans,
        factors=[
            SavedFactor(edge, bool(kept), loops.get(id(edge.covariance)))
            for edge, kept in zip(result.graph.edges, result.edges_kept, strict=True)
        ],
        loops=result.loops,
        trajectory=result.trajectory,
        grids=grids,
    )


def layer_grids(layers: LayeredMap) -> dict[str, OccupancyGrid]:
    """The layers that there are, by the names under which they are saved."""
    grids = {}
    if layers.lidar is not None:
        grids["lidar layer"] = layers.grid("lidar")
    if layers.depth is not None:
        grids["depth layer"] = layers.grid("depth")
    return grids


def export_map(saved: SavedMap, format_: str, out: Path) -> list[Path]:
    """Write a saved map in another program's format.

    Parameters
    ----------
    format_
        nav2, tum, g2o, ply or bt.
    out
        The file, or a folder (what is one, or has no ending) for the names that `save_run` uses. Of nav2 it
        is the yaml, of ply the mesh; what belongs to them goes beside.

    Returns
    -------
    What was written.

    Raises
    ------
    ScanweaveError
        Where the map does not hold what the format needs, or a file cannot be written.
    """
    usual = {
        "nav2": "map.yaml",
        "tum": "trajectory.tum",
        "g2o": "graph.g2o",
        "ply": "mesh.ply",
        "bt": "map.bt",
    }
    if out.is_dir() or not out.suffix:
        make_folder(out)
        out = out / usual[format_]
    needs = {"nav2": saved.grid is not None, "ply": len(saved.frames) > 0, "bt": len(saved.frames) > 0}
    if not needs.get(format_, True):
        lacking = "grid" if format_ == "nav2" else "image"
        raise ScanweaveError(f"{saved.path} holds no {lacking}, so there is nothing to write as {format_}")
    config = saved.config.dense_map
    if format_ == "nav2":
        assert saved.grid is not None
        return list(write_nav2_map(out.with_suffix(""), saved.grid))
    if format_ == "ply":
        return save_surface(out, DenseKeyframes(saved.frames, saved.frame_poses()), config)
    if format_ == "bt":
        save_octomap(out, DenseKeyframes(saved.frames, saved.frame_poses()), config)
    elif format_ == "tum":
        write_tum(out, saved.trajectory)
    else:
        save_g2o(out, saved.contents)
    return [out]
