"""A finished map in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from slam.config import Config
from slam.edits.remaking import regions_of
from slam.errors import LibraryError, ScanweaveError
from slam.mapping.camera_points import camera_cloud
from slam.mapping.cloud_map import map_cloud
from slam.mapping.dense_map import DenseMapSettings, fuse_keyframes
from slam.mapping.floor_plan import FloorPlan
from slam.mapping.keyframe_grid import PASSED_BY
from slam.mapping.layered_map import LayeredMap
from slam.matching.local_cloud import moved
from slam.measurements import spatial
from slam.outputs.floorplan import floor_plan
from slam.storage.covariances import write_trajectory
from slam.storage.files import make_folder
from slam.storage.g2o import write_g2o
from slam.storage.map_contents import MapContents
from slam.storage.map_edits import CLOUD, FRAME, erased_bits
from slam.storage.nav2_layers import MAP_YAML, write_driving_map, write_layers, write_passed_by
from slam.storage.nav2_rooms import write_room_zones
from slam.storage.nav2_zones import write_zones
from slam.storage.octomap import write_octomap, write_octree
from slam.storage.plan_dxf import write_plan_dxf
from slam.storage.plan_geojson import write_plan_geojson
from slam.storage.plan_svg import write_plan_svg
from slam.storage.ply import write_cloud_ply, write_mesh_ply

ZONES = "nav2-zones"
_NAMES = {"tum": "trajectory.tum", "g2o": "graph.g2o", "nav2": MAP_YAML, "bt": "map.bt"}
_PLANS: dict[str, Callable[[Path, FloorPlan], None]] = {
    "svg": write_plan_svg,
    "dxf": write_plan_dxf,
    "geojson": write_plan_geojson,
}


@dataclass(frozen=True)
class Exports:
    """What is written of a map for other programs.

    Attributes
    ----------
    contents
        The map.
    config
        Its settings.
    """

    contents: MapContents
    config: Config

    @cached_property
    def layers(self) -> LayeredMap | None:
        """The map of the floor to drive by; None of a camera in space."""
        return self.contents.layers(self.config)

    def write(self, format_: str, out: Path) -> tuple[list[Path], list[str]]:
        """Write one format, see `slam.Map.export`; what was written, and what of it could not be had.

        Raises
        ------
        ScanweaveError
            Where the map does not hold what the format needs, or a file cannot be written.
        """
        found = self.contents
        if format_ in _PLANS or format_ == ZONES:
            return self._write_plan(format_, out), []
        seen = found.frames is not None or found.clouds is not None
        if (format_ == "nav2" and self.layers is None) or (format_ in ("ply", "bt") and not seen):
            lacking = "grid" if format_ == "nav2" else "image or cloud"
            raise ScanweaveError(f"the map holds no {lacking}, so there is nothing to write as {format_}")
        if out.is_dir() or not out.suffix:
            make_folder(out)
            out /= _NAMES.get(format_, "cloud.ply" if found.frames is None else "mesh.ply")
        if format_ == "nav2":
            assert self.layers is not None
            return list(write_driving_map(out.with_suffix(""), self.layers)), []
        if format_ == "ply":
            return self._write_ply(out)
        if format_ == "tum":
            return write_trajectory(out, found.trajectory, found.covariances), []
        if format_ == "g2o":
            write_g2o(out, found.node_poses, (factor.edge for factor in found.factors if factor.kept))
        elif found.clouds is not None:
            _save_cloud_octomap(out, found, self.config)
        elif found.frames is not None:
            resolution_m, range_max_m = self.config.grid.resolution_m, self.config.layers.depth_max_m
            poses = found.frame_poses()
            write_octomap(out, found.frames, poses, resolution_m=resolution_m, range_max_m=range_max_m)
        return [out], []

    def write_files(self, folder: Path) -> list[Path]:
        """Write trajectory and graph, of a floor the map to drive by, layers, zones; errors as in `write`."""
        formats = ["tum", "g2o"] if self.layers is None else ["tum", "g2o", "nav2"]
        written = [path for name in formats for path in self.write(name, folder)[0]]
        if self.layers is None:
            return written
        poses, edits = self.contents.keyframe_poses, self.contents.edits
        keep_out = [zone.points(poses) for zone in regions_of(edits, "keep_out")]
        slow = [(zone.points(poses), zone.value) for zone in regions_of(edits, "slow")]
        beside = folder / "layers"
        passed_by = write_passed_by(beside, self.contents.grids.get(PASSED_BY))
        written += write_layers(beside, self.layers) + passed_by
        return written + write_zones(folder, self.layers, keep_out, slow)

    def write_sessions(self, folder: Path, poses: Sequence[int]) -> list[Path]:
        """Write a trajectory a session, where several have so many poses: their clocks may overlap."""
        written, first, found = list[Path](), 0, self.contents
        for number, count in enumerate(poses if len(poses) > 1 else (), start=1):
            part = slice(first, first + count)
            covariances = None if found.covariances is None else found.covariances[part]
            path = folder / f"trajectory-{number}.tum"
            written += write_trajectory(path, found.trajectory[part], covariances)
            first = part.stop
        return written

    def write_surfaces(self, folder: Path) -> tuple[list[Path], list[str]]:
        """Write surfaces and clouds, and the octree, where they are asked for; see `write`."""
        dense = self.config.dense_map
        if not dense.enabled or (self.contents.frames is None and self.contents.clouds is None):
            return [], []
        written, missing = self.write("ply", folder)
        return (written + self.write("bt", folder)[0] if dense.octomap else written), missing

    def _write_plan(self, format_: str, out: Path) -> list[Path]:
        """The plan of the floor, or what nav2 makes of it (a folder)."""
        plan = floor_plan(self.contents, self.config)
        if format_ == ZONES:
            assert self.layers is not None
            return write_room_zones(out, plan, self.layers)
        if out.is_dir() or not out.suffix:
            make_folder(out)
            out /= f"floorplan.{format_}"
        _PLANS[format_](out, plan)
        return [out]

    def _write_ply(self, out: Path) -> tuple[list[Path], list[str]]:
        """The coloured surface of the images, and the cloud of the 3D lidar."""
        written, missing, path, found = list[Path](), list[str](), out, self.contents
        if found.frames is not None:
            written, missing = _save_surface(out, found, self.config)
            path = out.with_name("lidar.ply" if out.name == "mesh.ply" else f"{out.stem}-lidar.ply")
        if found.clouds is not None:
            poses = [spatial(pose) for pose in found.node_poses]
            write_cloud_ply(path, map_cloud(found.clouds, poses, self.config.grid.resolution_m))
            written.append(path)
        return written, missing


def same_surfaces(one: MapContents, other: MapContents, same_settings: bool) -> bool:
    """Whether two maps of the same log show the same images and clouds at the same places."""
    poses = [np.array([spatial(pose).matrix() for pose in contents.node_poses]) for contents in (one, other)]
    erased = [[erased_bits(contents.edits, kind) for kind in (FRAME, CLOUD)] for contents in (one, other)]
    return same_settings and np.array_equal(poses[0], poses[1]) and erased[0] == erased[1]


def _save_cloud_octomap(path: Path, found: MapContents, config: Config) -> None:
    """The octree of a 3D lidar's keyframes."""
    T_base_lidar = found.T_base_lidar
    T_lidar_base = T_base_lidar.inverse()
    views = (
        (moved(points, T_lidar_base), spatial(T_map_base).compose(T_base_lidar))
        for points, T_map_base in zip(found.clouds or (), found.node_poses, strict=True)
    )
    write_octree(path, views, config.grid.resolution_m, config.cloud_map.plan_range_m)


def _save_surface(path: Path, found: MapContents, config: Config) -> tuple[list[Path], list[str]]:
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
    written, missing, frames, poses = [], [], found.frames or (), found.frame_poses()
    try:
        dense = fuse_keyframes(frames, poses, settings)
        cloud = dense.cloud
        if len(dense.mesh.faces):
            write_mesh_ply(path, dense.mesh)
            written.append(path)
    except LibraryError as error:
        cloud = camera_cloud(frames, poses, settings)
        missing.append(f"No {path.name}, and {cloud_path.name} is of points as they were seen: {error}")
    if len(cloud.points_map):
        write_cloud_ply(cloud_path, [cloud])
        written.append(cloud_path)
    return written, missing
