"""The files of a finished map: trajectory, graph and grid in the formats of other programs."""

from __future__ import annotations

import logging
from pathlib import Path

import gtsam
import numpy as np

from slam.config_clouds import CloudMapConfig
from slam.config_stages import DenseMapConfig
from slam.errors import LibraryError, ScanweaveError
from slam.map_result import DenseKeyframes, MappedClouds, MapResult
from slam.mapping.camera_points import camera_cloud
from slam.mapping.cloud_map import map_cloud
from slam.mapping.dense_map import DenseMapSettings, fuse_keyframes
from slam.mapping.layered_map import LayeredMap
from slam.matching.local_cloud import moved
from slam.storage.files import make_folder
from slam.storage.g2o import G2oEdge, G2oGraph, write_g2o
from slam.storage.map_contents import DEPTH, OCCUPANCY, MapContents, SavedFactor
from slam.storage.nav2_layers import MAP_YAML, write_driving_map, write_layers
from slam.storage.octomap import write_octomap, write_octree
from slam.storage.ply import write_cloud_ply, write_mesh_ply
from slam.storage.saved_map import SavedMap
from slam.storage.tum import write_tum

log = logging.getLogger(__name__)


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


def save_dense(folder: Path, result: MapResult, config: DenseMapConfig) -> tuple[list[Path], list[str]]:
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
    if result.dense is None or not config.enabled:
        return [], []
    written, missing = save_surface(folder / "mesh.ply", result.dense, config)
    if config.octomap and result.clouds is None:
        save_octomap(folder / "map.bt", result.dense, config)
        written.append(folder / "map.bt")
    return written, missing


def save_clouds(folder: Path, result: MapResult, config: CloudMapConfig, dense: DenseMapConfig) -> list[Path]:
    """Write the cloud of a 3D lidar's keyframes, and ``map.bt`` where it is asked for.

    The cloud is ``cloud.ply``; beside the coloured one of cameras ``lidar.ply``.

    Raises
    ------
    ScanweaveError
        Where a file cannot be written, or a library that this needs is missing.
    """
    mapped = result.clouds
    if mapped is None or not (config.enabled and dense.enabled):
        return []
    written = [folder / ("cloud.ply" if result.dense is None else "lidar.ply")]
    save_cloud(written[0], mapped, config)
    if dense.octomap:
        written.append(folder / "map.bt")
        save_cloud_octomap(written[1], mapped, config, dense)
    return written


def save_cloud(path: Path, mapped: MappedClouds, config: CloudMapConfig) -> None:
    """The cloud of a 3D lidar's keyframes."""
    write_cloud_ply(path, map_cloud(mapped.clouds, mapped.poses, config.voxel_m))


def save_cloud_octomap(
    path: Path, mapped: MappedClouds, config: CloudMapConfig, dense: DenseMapConfig
) -> None:
    """The octree of a 3D lidar's keyframes."""
    T_base_lidar = mapped.T_base_lidar
    T_lidar_base = T_base_lidar.inverse()
    views = (
        (moved(points, T_lidar_base), T_map_base.compose(T_base_lidar))
        for points, T_map_base in zip(mapped.clouds, mapped.poses, strict=True)
    )
    write_octree(path, views, dense.octomap_cell_m, config.plan_range_m)


def save_surface(
    path: Path, keyframes: DenseKeyframes, config: DenseMapConfig
) -> tuple[list[Path], list[str]]:
    """The coloured mesh of the camera keyframes, and their cloud beside it; nothing where they show none.

    Without Open3D there is no mesh, and the cloud is of the points as they were seen.

    Returns
    -------
    What was written, and what could not be had.
    """
    settings = DenseMapSettings(
        voxel_size_m=config.voxel_m, depth_min_m=config.nearest_m, depth_max_m=config.farthest_m
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


def export_map(saved: SavedMap, format_: str, out: Path) -> list[Path]:
    """Write a saved map in another program's format.

    Parameters
    ----------
    format_
        nav2 (the map to drive by), tum, g2o, ply or bt.
    out
        The file, or a folder (what is one, or has no ending) for the names that `save_run` uses. Of nav2 it
        is the yaml, of ply the mesh of the images or, without any, the cloud of the 3D lidar; what belongs to
        them goes beside.

    Returns
    -------
    What was written.

    Raises
    ------
    ScanweaveError
        Where the map does not hold what the format needs, or a file cannot be written.
    """
    usual = {
        "nav2": MAP_YAML,
        "tum": "trajectory.tum",
        "g2o": "graph.g2o",
        "ply": "mesh.ply" if len(saved.frames) or not len(saved.clouds) else "cloud.ply",
        "bt": "map.bt",
    }
    lacking = ""
    if format_ == "nav2" and saved.layers is None:
        lacking = "grid"
    elif format_ in ("ply", "bt") and not len(saved.frames) + len(saved.clouds):
        lacking = "image or cloud"
    if lacking:
        raise ScanweaveError(f"{saved.path} holds no {lacking}, so there is nothing to write as {format_}")
    if out.is_dir() or not out.suffix:
        make_folder(out)
        out = out / usual[format_]
    if format_ == "nav2":
        assert saved.layers is not None
        return list(write_driving_map(out.with_suffix(""), saved.layers))
    if format_ == "ply":
        return _export_ply(saved, out)
    if format_ == "bt":
        _export_octomap(saved, out)
    elif format_ == "tum":
        write_tum(out, saved.trajectory)
    else:
        save_g2o(out, saved.contents)
    return [out]


def _export_ply(saved: SavedMap, out: Path) -> list[Path]:
    """The coloured surface of the images, and the cloud of the 3D lidar."""
    written, cloud = list[Path](), out
    if len(saved.frames):
        written, missing = save_surface(out, _dense_of(saved), saved.config.dense_map)
        for fault in missing:
            log.warning("%s", fault)
        cloud = out.with_name("lidar.ply" if out.name == "mesh.ply" else f"{out.stem}-lidar.ply")
    if len(saved.clouds):
        save_cloud(cloud, _clouds_of(saved), saved.config.cloud_map)
        written.append(cloud)
    return written


def _export_octomap(saved: SavedMap, out: Path) -> None:
    """The octree of the 3D lidar, or else of the images."""
    if len(saved.clouds):
        save_cloud_octomap(out, _clouds_of(saved), saved.config.cloud_map, saved.config.dense_map)
    else:
        save_octomap(out, _dense_of(saved), saved.config.dense_map)


def _dense_of(saved: SavedMap) -> DenseKeyframes:
    """The camera keyframes of a saved map."""
    return DenseKeyframes(saved.frames, saved.frame_poses())


def _clouds_of(saved: SavedMap) -> MappedClouds:
    """The clouds of a saved map, whose nodes are the bases."""
    nodes = [pose for pose in saved.contents.node_poses if isinstance(pose, gtsam.Pose3)]
    return MappedClouds(saved.clouds, nodes, saved.clouds.T_base_lidar(len(nodes) - 1))
