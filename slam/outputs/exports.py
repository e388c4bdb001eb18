"""Export a finished map in the formats of other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import gtsam
import numpy as np

from slam.config import Config
from slam.config.files import nearest
from slam.errors import ScanweaveError
from slam.mapping.dense_map import ColoredMesh, Colors, DenseMapSettings, fuse_keyframes
from slam.mapping.elevation import Elevation, elevation
from slam.mapping.floor_plan import FloorPlan
from slam.mapping.layered_map import PASSED_BY, LayeredMap
from slam.matching.local_cloud import moved
from slam.measurements import AnyFloatArray, Float32Array, spatial
from slam.outputs.floorplan import floor_plan
from slam.outputs.lidar_cloud import lidar_cloud
from slam.storage.e57 import write_e57
from slam.storage.files import filling, make_folder
from slam.storage.g2o import write_g2o
from slam.storage.georeferenced import write_georeference, write_gpx
from slam.storage.glb import write_mesh_glb
from slam.storage.lidar_cloud_files import CLOUD_FORMATS, export_cloud, write_lidar_cloud
from slam.storage.map_contents import MapContents
from slam.storage.map_edits import CLOUD, FRAME, erased_bits, regions_of
from slam.storage.map_places import write_places_yaml
from slam.storage.mcap_results import write_results_bag
from slam.storage.nav2_layers import (
    MAP_YAML,
    write_driving_map,
    write_ground_layers,
    write_layers,
    write_passed_by,
)
from slam.storage.nav2_zones import write_room_zones, write_zones
from slam.storage.octomap import write_octomap, write_octree
from slam.storage.plan_files import write_plan_dxf, write_plan_geojson, write_plan_svg
from slam.storage.ply import write_cloud_ply, write_mesh_ply
from slam.storage.posed_images import IMAGES, plain_name, write_colmap, write_posed_images, write_transforms
from slam.storage.tum import write_kitti, write_trajectory, write_tum
from slam.trajectory.poses import Poses

ZONES = "nav2-zones"
_NAMES = {"tum": "trajectory.tum", "g2o": "graph.g2o", "nav2": MAP_YAML, "bt": "map.bt"}
_NAMES |= {"glb": "mesh.glb", "e57": "cloud.e57", "kitti": "poses.txt", "gpx": "trajectory.gpx"}
_PLANS: dict[str, Callable[[Path, FloorPlan], None]] = {
    "svg": write_plan_svg,
    "dxf": write_plan_dxf,
    "geojson": write_plan_geojson,
}
FORMATS = (*_NAMES, "ply", "colmap", "nerfstudio", "sensors", "mcap", *CLOUD_FORMATS, *_PLANS, ZONES)


@dataclass(frozen=True)
class Exports:
    """Export of a map for other programs.

    Attributes
    ----------
    known_ground
        As `ground`, if it is known already.
    """

    contents: MapContents
    config: Config
    known_ground: Elevation | None = None

    @cached_property
    def layers(self) -> LayeredMap | None:
        """The navigation map of the floor; None for a camera in 3D."""
        return self.contents.layers(self.config)

    @cached_property
    def ground(self) -> Elevation | None:
        """The ground under a 3D lidar's clouds; None for other maps, or if it was not seen."""
        saved = self.contents
        if self.known_ground is not None or saved.clouds is None or saved.ground_m is None:
            return self.known_ground
        poses = [spatial(pose) for pose in saved.node_poses]
        return elevation(saved.clouds, poses, saved.ground_m, self.config.cloud_map.plan_range_m)

    def write(self, format_: str, out: Path) -> list[Path]:
        """Write one format, see `slam.Map.export`; return the files written.

        Raises
        ------
        ScanweaveError
            If the map does not contain the data for the format, or a file cannot be written.
        """
        if format_ not in FORMATS:
            hint = nearest(str(format_), FORMATS)
            raise ScanweaveError(f"no format '{format_}'{hint}; formats are: {', '.join(FORMATS)}")
        if lacking := self._lacking(format_):
            raise ScanweaveError(f"the map holds no {lacking}, so there is nothing to write as {format_}")
        if format_ in _PLANS or format_ == ZONES:
            return self._write_plan(format_, out)
        if format_ in ("colmap", "nerfstudio"):
            return self._write_images(format_, out)
        if format_ == "sensors":
            return self._write_sensors(out)
        if format_ == "mcap":
            return [self._write_bag(out)]
        if format_ in CLOUD_FORMATS:
            with lidar_cloud(self.contents, self.config, self.ground) as cloud:
                return export_cloud(format_, out, cloud)
        if out.is_dir() or not out.suffix:
            make_folder(out)
            out /= _NAMES.get(format_, "cloud.ply" if self.contents.frames is None else "mesh.ply")
        return self._write_file(format_, out)

    def _lacking(self, format_: str) -> str:
        """Return what the map lacks for a format; empty if nothing is missing."""
        saved = self.contents
        if format_ == "nav2" and self.layers is None:
            return "grid"
        if format_ in ("ply", "bt", "e57") and saved.frames is None and saved.clouds is None:
            return "image or cloud"
        if format_ in ("glb", "colmap", "nerfstudio") and saved.frames is None:
            return "image"
        if format_ in CLOUD_FORMATS and saved.clouds is None:
            return "cloud"
        unplaced = format_ == "gpx" and saved.georeference is None
        return "place on the earth, as its log had no GNSS" if unplaced else ""

    def _write_file(self, format_: str, out: Path) -> list[Path]:
        """Write one of the single-file formats, with related files next to it."""
        saved = self.contents
        match format_:
            case "nav2":
                assert self.layers is not None
                return list(write_driving_map(out.with_suffix(""), self.layers))
            case "ply":
                return self._write_ply(out)
            case "kitti":
                return write_kitti(out, saved.trajectory)
            case "tum":
                return write_trajectory(out, saved.trajectory, saved.covariances)
            case "glb":
                write_mesh_glb(out, self._surface)
            case "e57":
                write_e57(out, self._scans())
            case "gpx":
                assert saved.georeference is not None
                write_gpx(out, saved.trajectory, saved.georeference)
            case "g2o":
                write_g2o(out, saved.node_poses, (factor.edge for factor in saved.factors if factor.kept))
            case "bt":
                self._write_octree(out)
        return [out]

    def write_files(self, folder: Path) -> list[Path]:
        """Write trajectory and graph, and for a floor navigation map, layers, zones; raises as `write`."""
        formats = ["tum", "g2o"] if self.layers is None else ["tum", "g2o", "nav2"]
        written = [path for name in formats for path in self.write(name, folder)]
        if self.contents.georeference is not None:
            written.append(folder / "georeference.yaml")
            write_georeference(written[-1], self.contents.georeference)
        if self.contents.places is not None:
            written.append(folder / "tags.yaml")
            write_places_yaml(written[-1], self.contents.places, self.contents.node_poses)
        if self.layers is None:
            return written
        poses, edits = self.contents.keyframe_poses, self.contents.edits
        keep_out = [zone.points(poses) for zone in regions_of(edits, "keep_out")]
        slow = [(zone.points(poses), zone.value) for zone in regions_of(edits, "slow")]
        layers = folder / "layers"
        passed_by = write_passed_by(layers, self.contents.grids.get(PASSED_BY))
        written += write_layers(layers, self.layers) + passed_by
        written += write_ground_layers(layers, self.ground, folder / MAP_YAML)
        return written + write_zones(folder, self.layers, keep_out, slow)

    def write_sessions(self, folder: Path, poses: Sequence[int]) -> list[Path]:
        """Write one trajectory per session if there are several: their clocks may overlap."""
        written, first, saved = list[Path](), 0, self.contents
        for number, count in enumerate(poses if len(poses) > 1 else (), start=1):
            part = slice(first, first + count)
            covariances = None if saved.covariances is None else saved.covariances[part]
            path = folder / f"trajectory-{number}.tum"
            written += write_trajectory(path, saved.trajectory[part], covariances)
            first = part.stop
        return written

    def write_surfaces(self, folder: Path) -> list[Path]:
        """Write surfaces and clouds, if they are enabled; see `write`."""
        shown = self.contents.frames is not None or self.contents.clouds is not None
        return self.write("ply", folder) if self.config.dense_map.enabled and shown else []

    def same_surfaces(self, other: Exports) -> bool:
        """Return whether another map of the same log has the same images and clouds at the same poses."""
        maps = (self.contents, other.contents)
        poses = [np.array([spatial(pose).matrix() for pose in saved.node_poses]) for saved in maps]
        erased = [[erased_bits(saved.edits, kind) for kind in (FRAME, CLOUD)] for saved in maps]
        return self.config == other.config and np.array_equal(poses[0], poses[1]) and erased[0] == erased[1]

    def _write_plan(self, format_: str, out: Path) -> list[Path]:
        """Write the floor plan, or its form for nav2 (a folder)."""
        plan = floor_plan(self.contents, self.config)
        if format_ == ZONES:
            assert self.layers is not None
            return write_room_zones(out, plan, self.layers)
        if out.is_dir() or not out.suffix:
            make_folder(out)
            out /= f"floorplan.{format_}"
        _PLANS[format_](out, plan)
        return [out]

    def _write_images(self, format_: str, folder: Path) -> list[Path]:
        """Write images with poses, intrinsics and an initial cloud into a folder."""
        saved = self.contents
        assert saved.frames is not None
        with filling(folder):
            moved_colors = {
                name for name, registration in saved.registrations.items() if registration.accepted
            }
            images = write_posed_images(folder, saved.frames, saved.frame_poses(), moved_colors)
            surface = self._surface
            if format_ == "colmap":
                written = write_colmap(folder, images, surface.cloud)
            else:
                written = [folder / "transforms.json"]
                write_transforms(written[0], images)
                if len(surface.cloud.points_map):
                    written.append(folder / "points.ply")
                    write_cloud_ply(written[-1], [surface.cloud])
        return [*written, folder / IMAGES]

    @cached_property
    def _surface(self) -> ColoredMesh:
        """Return the surface of the images; empty if they show none."""
        saved, dense = self.contents, self.config.dense_map
        settings = DenseMapSettings(dense.voxel_m, self.config.layers.depth_max_m)
        return fuse_keyframes(saved.frames or (), saved.frame_poses(), settings)

    def _scans(self) -> Iterator[tuple[str, gtsam.Pose3, AnyFloatArray, Colors | None, Float32Array | None]]:
        """Return the clouds of the 3D lidar with their poses; for images, their surface as one cloud."""
        saved = self.contents
        if saved.clouds is None:
            yield "surface", gtsam.Pose3(), self._surface.cloud.points_map, self._surface.cloud.colors, None
        for key, points in enumerate(saved.clouds or ()):
            assert saved.clouds is not None
            T_base_lidar = saved.clouds.T_base_lidar(key)
            pose = spatial(saved.node_poses[key]).compose(T_base_lidar)
            placed = moved(points, T_base_lidar.inverse())
            yield f"keyframe {key}", pose, placed, None, saved.clouds.intensities(key)

    def _mounts(self) -> dict[str, gtsam.Pose3]:
        """Return the mounting of each sensor, as far as the map has it."""
        saved = self.contents
        mounts = {name: camera.T_base_camera for name, camera in saved.cameras.items()}
        known = {name: pose for name, pose in mounts.items() if pose is not None}
        for scan in saved.keyframe_scans:
            if scan is not None and saved.clouds is None:
                known.setdefault(scan.sensor, gtsam.Pose3(scan.T_base_laser))
        return known if saved.clouds is None else {**known, "lidar": saved.T_base_lidar}

    def _write_sensors(self, folder: Path) -> list[Path]:
        """Write the pose of each sensor at every reading, one TUM file per sensor in a folder."""
        make_folder(folder)
        written, trajectory = [], self.contents.trajectory
        poses = trajectory.poses()
        for name, mount in self._mounts().items():
            written.append(folder / f"{plain_name(name)}.tum")
            placed = Poses.of([pose.compose(mount) for pose in poses])
            write_tum(written[-1], placed.trajectory(trajectory.stamps_s))
        if not written:
            raise ScanweaveError("the map has no pose of any sensor on the robot; use 'export tum'")
        return written

    def _write_bag(self, folder: Path) -> Path:
        """Write the results for Foxglove; in an existing folder, into a folder of its own."""
        saved, plan = self.contents, None if self.layers is None else self.layers.decision()
        begun_s = float(saved.trajectory.stamps_s.min())
        clouds = (
            (
                begun_s if saved.clouds is None else saved.clouds.stamp_s(n),
                moved(points.astype(np.float64), pose),
                colors,
                intensities,
            )
            for n, (_, pose, points, colors, intensities) in enumerate(self._scans())
        )
        has_points = saved.frames is not None or saved.clouds is not None
        folder = folder / "results" if folder.exists() else folder.with_suffix("")
        return write_results_bag(folder, plan, saved.trajectory, self._mounts(), clouds if has_points else ())

    def _write_ply(self, out: Path) -> list[Path]:
        """Write the coloured surface of the images, and the cloud of the 3D lidar."""
        written, path, saved = list[Path](), out, self.contents
        if saved.frames is not None:
            written = _save_surface(out, self._surface)
            path = out.with_name("lidar.ply" if out.name == "mesh.ply" else f"{out.stem}-lidar.ply")
        if saved.clouds is not None:
            with lidar_cloud(saved, self.config, self.ground) as cloud:
                written += write_lidar_cloud(path, cloud)
        return written

    def _write_octree(self, out: Path) -> None:
        """Write the octree of a 3D lidar's keyframes, otherwise of the images."""
        saved, resolution_m = self.contents, self.config.grid.resolution_m
        if saved.clouds is None:
            assert saved.frames is not None
            seen_m = self.config.layers.depth_max_m
            write_octomap(out, saved.frames, saved.frame_poses(), resolution_m, seen_m)
            return
        T_base_lidar = saved.T_base_lidar
        T_lidar_base = T_base_lidar.inverse()
        views = (
            (moved(points, T_lidar_base), spatial(T_map_base).compose(T_base_lidar))
            for points, T_map_base in zip(saved.clouds, saved.node_poses, strict=True)
        )
        write_octree(out, views, resolution_m, self.config.cloud_map.plan_range_m)


def _save_surface(path: Path, surface: ColoredMesh) -> list[Path]:
    """Write the coloured mesh of the camera keyframes and its points; nothing if there is no surface."""
    written = list[Path]()
    if len(surface.faces):
        write_mesh_ply(path, surface)
        written.append(path)
    if len(surface.cloud.points_map):
        written.append(path.with_name("cloud.ply" if path.name == "mesh.ply" else f"{path.stem}-cloud.ply"))
        write_cloud_ply(written[-1], [surface.cloud])
    return written
