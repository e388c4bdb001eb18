"""The files of a finished map: trajectory, graph and grid in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.config import Config
from slam.errors import LibraryError
from slam.mapper.map_result import DenseKeyframes, MappedClouds, MapResult
from slam.mapping.camera_points import camera_cloud
from slam.mapping.cloud_map import map_cloud
from slam.mapping.dense_map import DenseMapSettings, fuse_keyframes
from slam.mapping.layered_map import LayeredMap
from slam.matching.local_cloud import moved
from slam.storage.g2o import G2oEdge, G2oGraph, write_g2o
from slam.storage.map_contents import DEPTH, OCCUPANCY, MapContents, SavedFactor
from slam.storage.nav2_layers import MAP_YAML, write_driving_map, write_layers
from slam.storage.octomap import write_octomap, write_octree
from slam.storage.ply import write_cloud_ply, write_mesh_ply
from slam.storage.tum import write_tum


def save_run(folder: Path, result: MapResult, layers: LayeredMap | None) -> list[Path]:
    """Write ``trajectory.tum``, ``graph.g2o``, and of a floor ``map.yaml``, ``map.pgm`` and ``layers/``.

    Parameters
    ----------
    folder
        Must exist; files of an earlier run are replaced one by one.
    layers
        The map of the floor; None of a camera in space.

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
    if layers is not None:
        written += write_driving_map(folder / Path(MAP_YAML).stem, layers)
        written += write_layers(folder / "layers", layers)
    return written


def save_dense(folder: Path, result: MapResult, config: Config) -> tuple[list[Path], list[str]]:
    """Write ``mesh.ply`` and ``cloud.ply`` of the camera keyframes, and ``map.bt`` where it is asked for.

    The octree is that of a 3D lidar where there is one, see `save_clouds`.

    Returns
    -------
    What was written, and what of it could not be had.

    Raises
    ------
    ScanweaveError
        Where a file cannot be written, or a library that this needs is missing.
    """
    if result.dense is None or not config.dense_map.enabled:
        return [], []
    written, missing = save_surface(folder / "mesh.ply", result.dense, config)
    if config.dense_map.octomap and result.clouds is None:
        save_octomap(folder / "map.bt", result.dense, config)
        written.append(folder / "map.bt")
    return written, missing


def save_clouds(folder: Path, result: MapResult, config: Config) -> list[Path]:
    """Write the cloud of a 3D lidar's keyframes, and ``map.bt`` where it is asked for.

    The cloud is ``cloud.ply``; beside the coloured one of cameras ``lidar.ply``.

    Raises
    ------
    ScanweaveError
        Where a file cannot be written, or a library that this needs is missing.
    """
    mapped = result.clouds
    if mapped is None or not config.dense_map.enabled:
        return []
    written = [folder / ("cloud.ply" if result.dense is None else "lidar.ply")]
    save_cloud(written[0], mapped, config)
    if config.dense_map.octomap:
        written.append(folder / "map.bt")
        save_cloud_octomap(written[1], mapped, config)
    return written


def save_cloud(path: Path, mapped: MappedClouds, config: Config) -> None:
    """The cloud of a 3D lidar's keyframes."""
    write_cloud_ply(path, map_cloud(mapped.clouds, mapped.poses, config.grid.resolution_m))


def save_cloud_octomap(path: Path, mapped: MappedClouds, config: Config) -> None:
    """The octree of a 3D lidar's keyframes."""
    T_base_lidar = mapped.T_base_lidar
    T_lidar_base = T_base_lidar.inverse()
    views = (
        (moved(points, T_lidar_base), T_map_base.compose(T_base_lidar))
        for points, T_map_base in zip(mapped.clouds, mapped.poses, strict=True)
    )
    write_octree(path, views, config.grid.resolution_m, config.cloud_map.plan_range_m)


def save_surface(path: Path, keyframes: DenseKeyframes, config: Config) -> tuple[list[Path], list[str]]:
    """The coloured mesh of the camera keyframes, and their cloud beside it; nothing where they show none.

    Without Open3D there is no mesh, and the cloud is of the points as they were seen.

    Returns
    -------
    What was written, and what could not be had.
    """
    settings = DenseMapSettings(
        voxel_size_m=config.dense_map.voxel_m,
        depth_min_m=config.dense_map.nearest_m,
        depth_max_m=config.layers.depth_max_m,
    )
    cloud_path = path.with_name("cloud.ply" if path.name == "mesh.ply" else f"{path.stem}-cloud.ply")
    written, missing = [], []
    try:
        dense = fuse_keyframes(keyframes.frames, keyframes.poses, settings)
        cloud = dense.cloud
        if len(dense.mesh.faces):
            write_mesh_ply(path, dense.mesh)
            written.append(path)
    except LibraryError as error:
        cloud = camera_cloud(keyframes.frames, keyframes.poses, settings)
        missing.append(f"No {path.name}, and {cloud_path.name} is of points as they were seen: {error}")
    if len(cloud.points_map):
        write_cloud_ply(cloud_path, cloud)
        written.append(cloud_path)
    return written, missing


def save_octomap(path: Path, keyframes: DenseKeyframes, config: Config) -> None:
    """The octree of the camera keyframes."""
    write_octomap(
        path,
        keyframes.frames,
        keyframes.poses,
        resolution_m=config.grid.resolution_m,
        range_max_m=config.layers.depth_max_m,
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
    if layers is not None and layers.depth is not None:
        grids[DEPTH] = layers.depth
    return MapContents(
        node_poses=[result.graph.pose(node) for node in range(len(result.graph))],
        stamps_s=result.scans.stamps_s[result.keyframe_numbers],
        readings=result.keyframe_numbers,
        measured_scans=result.measured_scans,
        scans=result.keyframe_scans,
        factors=[
            SavedFactor(edge, bool(kept))
            for edge, kept in zip(result.graph.edges, result.edges_kept, strict=True)
        ],
        loops=result.loops,
        trajectory=result.trajectory,
        grids=grids,
        cameras={name: record.learned for name, record in result.cameras.items()},
    )
