"""A coloured mesh and point cloud of what an RGB-D camera saw from known poses, by a TSDF.

The truncated signed distance field is Open3D's sparse voxel block grid, after Curless and Levoy, "A
volumetric method for building complex models from range images" (SIGGRAPH 1996), with equal weights.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.errors import ConfigError, ScanweaveError
from slam.mapping.posed_frames import posed_frames
from slam.measurements import BoolArray, CameraIntrinsics, Float32Array, RgbdFrame
from slam.vision.open3d_library import load_open3d

Colors: TypeAlias = NDArray[np.uint8]
Faces: TypeAlias = NDArray[np.int32]

# Blocks of 8 voxels a side, a band of 4 on either side of the surface: half the memory of Open3D's 16 and 8.
BLOCK_SIDE = 8
FIRST_BLOCKS = 2000


@dataclass(frozen=True, slots=True)
class DenseMapSettings:
    """How frames become a dense map.

    Attributes
    ----------
    voxel_size_m
        Side of a voxel; details below two of them are lost.
    depth_min_m, depth_max_m
        Readings outside are not used.
    minimum_views
        A surface enters the result where at least so many frames saw it; more removes fragments, and thins
        out what was seen in passing.
    memory_limit_mb
        Memory the voxels may take, in 10^6 bytes.

    Raises
    ------
    ConfigError
        Where a value is out of its range.
    """

    voxel_size_m: float = 0.015
    depth_min_m: float = 0.3
    depth_max_m: float = 4.0
    minimum_views: int = 3
    memory_limit_mb: float = 2000.0

    def __post_init__(self) -> None:
        if not 0.001 <= self.voxel_size_m <= 1.0:
            raise ConfigError(f"voxel_size_m is {self.voxel_size_m:g}; it must be from 0.001 to 1")
        if not 0.0 <= self.depth_min_m < self.depth_max_m <= 100.0:
            raise ConfigError(
                f"depth from {self.depth_min_m:g} to {self.depth_max_m:g} m; "
                "it must be 0 <= depth_min_m < depth_max_m <= 100"
            )
        if not (self.minimum_views >= 1 and self.memory_limit_mb > 0.0):
            raise ConfigError(
                f"minimum_views is {self.minimum_views} and memory_limit_mb {self.memory_limit_mb:g}; "
                "they must be at least 1 and above 0"
            )

    def too_large(self) -> ScanweaveError:
        """The error of a map beyond the memory limit."""
        return ScanweaveError(
            f"the dense map needs more than {self.memory_limit_mb:g} MB at voxels of "
            f"{self.voxel_size_m:g} m; use a larger voxel_size_m, a smaller depth_max_m or a "
            "larger memory_limit_mb"
        )


@dataclass(frozen=True, slots=True)
class ColoredCloud:
    """Points on surfaces.

    Attributes
    ----------
    points_map
        (N, 3) metres, in the map frame.
    colors
        (N, 3) RGB.
    normals_map
        (N, 3) unit vectors towards where the surface was seen from.
    """

    points_map: Float32Array
    colors: Colors
    normals_map: Float32Array


@dataclass(frozen=True, slots=True)
class ColoredMesh:
    """A triangle mesh.

    Attributes
    ----------
    vertices_map
        (N, 3) metres, in the map frame.
    colors
        (N, 3) RGB of the vertices.
    normals_map
        (N, 3) unit vectors of the vertices, towards where the surface was seen from.
    faces
        (M, 3) indices of vertices, counter-clockwise where seen from the side of the normals.
    """

    vertices_map: Float32Array
    colors: Colors
    normals_map: Float32Array
    faces: Faces


@dataclass(frozen=True, slots=True)
class DenseMap:
    """The fused surface, as mesh and as points, and how many frames had depth within the range."""

    mesh: ColoredMesh
    cloud: ColoredCloud
    frames_fused: int


def fuse_keyframes(
    frames: Iterable[RgbdFrame],
    poses: Sequence[gtsam.Pose3],
    settings: DenseMapSettings | None = None,
) -> DenseMap:
    """Fuse frames into one surface; ``poses`` are T_map_camera in the order of the frames.

    Frames are taken one at a time: memory grows with the surface, not with their number. A frame with
    hardly any depth within the range is passed over. Where nothing was seen often enough, the arrays are
    empty.

    Raises
    ------
    ScanweaveError
        Where a pose is not finite, or the memory limit is met.
    """
    volume = _Volume(settings or DenseMapSettings())
    fused = sum(volume.integrate(frame, T_map_camera) for frame, T_map_camera in posed_frames(frames, poses))
    return DenseMap(volume.mesh(), volume.cloud(), fused)


def block_bytes() -> int:
    """Of a block: a voxel has distance, weight, three colours as float32, and for the mesh four int32 more.

    Whole-number colours are not used: their running mean is cut off at every update and darkens.
    """
    return BLOCK_SIDE**3 * (5 * np.dtype(np.float32).itemsize + 4 * np.dtype(np.int32).itemsize)


class _Volume:
    """The voxel block grid; Open3D's types stay inside."""

    def __init__(self, settings: DenseMapSettings) -> None:
        open3d = self._o3d = load_open3d()
        self._settings = settings
        self._weight_below = settings.minimum_views - 0.5  # Open3D keeps what is above, not at the threshold
        self._most_blocks = int(settings.memory_limit_mb * 1e6 / block_bytes())
        self._grid = open3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(open3d.core.float32,) * 3,
            attr_channels=[open3d.core.SizeVector([channels]) for channels in (1, 1, 3)],
            voxel_size=settings.voxel_size_m,
            block_resolution=BLOCK_SIDE,
            block_count=max(1, min(FIRST_BLOCKS, self._most_blocks)),
        )

    def integrate(self, frame: RgbdFrame, T_map_camera: gtsam.Pose3) -> bool:
        """Add what one frame saw; False where it has no depth within the range, or too few readings of it."""
        settings, image = self._settings, self._o3d.t.geometry.Image
        tensor = self._o3d.core.Tensor.from_numpy
        usable = (frame.depth_m >= settings.depth_min_m) & (frame.depth_m <= settings.depth_max_m)
        usable &= frame.depth_m > 0.0
        # At the rim Open3D's arithmetic may look for the colour outside the image, and a surface turns black.
        usable[[0, -1], :] = usable[:, [0, -1]] = False
        if not _seen_by_open3d(usable):
            return False
        depth = image(tensor(np.where(usable, frame.depth_m, np.float32(0.0))))
        color = image(tensor(frame.color.astype(np.float32) / np.float32(255.0)))
        camera = tensor(_camera_matrix(frame.intrinsics))
        T_camera_map = tensor(np.ascontiguousarray(T_map_camera.inverse().matrix()))
        # One unit of depth a metre. Open3D leaves out what is at its limit, and is given a larger one.
        limits = (1.0, settings.depth_max_m * 1.001, BLOCK_SIDE / 2)
        blocks = self._grid.compute_unique_block_coordinates(depth, camera, T_camera_map, *limits)
        self._make_room(len(blocks))
        self._grid.integrate(blocks, depth, color, camera, T_camera_map, *limits)
        return True

    def _make_room(self, count: int) -> None:
        """Grow for ``count`` more blocks before Open3D does, which would double without regard to a limit."""
        blocks = self._grid.hashmap()
        needed = blocks.size() + count
        if needed > self._most_blocks:
            raise self._settings.too_large()
        if needed > blocks.capacity():
            blocks.reserve(min(max(needed, 3 * blocks.capacity() // 2), self._most_blocks))

    def mesh(self) -> ColoredMesh:
        """The zero crossing as triangles."""
        if self._grid.hashmap().size() == 0:
            return ColoredMesh(*_nothing(), np.empty((0, 3), np.int32))
        mesh = self._grid.extract_triangle_mesh(self._weight_below)
        if mesh.is_empty():
            return ColoredMesh(*_nothing(), np.empty((0, 3), np.int32))
        positions, colors, normals = _arrays(mesh.vertex)
        order = _order(positions, colors, normals)
        faces = _renumbered(mesh.triangle.indices.numpy(), order)
        return ColoredMesh(positions[order], colors[order], normals[order], faces)

    def cloud(self) -> ColoredCloud:
        """The zero crossing as points, one on each edge of a voxel that it cuts."""
        if self._grid.hashmap().size() == 0:
            return ColoredCloud(*_nothing())
        cloud = self._grid.extract_point_cloud(self._weight_below)
        if cloud.is_empty():
            return ColoredCloud(*_nothing())
        positions, colors, normals = _arrays(cloud.point)
        order = _order(positions, colors, normals)
        return ColoredCloud(positions[order], colors[order], normals[order])


def _seen_by_open3d(usable: BoolArray) -> bool:
    """Whether an (H, W) image has a reading among every fourth pixel.

    Open3D looks for blocks at those, up to the last whole four, and stops the run where it finds none.
    """
    rows, cols = (4 * (side // 4) for side in usable.shape)
    return bool(usable[:rows:4, :cols:4].any())


def _camera_matrix(camera: CameraIntrinsics) -> NDArray[np.float64]:
    """(3, 3) for Open3D, which cuts the pixel of a voxel off instead of rounding it: half a pixel is added.

    Without that a slanted surface lies half a pixel's change of depth off.
    """
    return np.array([[camera.fx, 0.0, camera.cx + 0.5], [0.0, camera.fy, camera.cy + 0.5], [0.0, 0.0, 1.0]])


def _arrays(attributes: Any) -> tuple[Float32Array, Colors, Float32Array]:
    """Positions, colours and normals of an Open3D geometry, as arrays of their own."""
    colors = np.rint(np.clip(attributes.colors.numpy(), 0.0, 1.0) * 255.0).astype(np.uint8)
    return attributes.positions.numpy().copy(), colors, attributes.normals.numpy().copy()


def _order(positions: Float32Array, colors: Colors, normals: Float32Array) -> NDArray[np.int64]:
    """Order of points by place, then normal and colour: Open3D's threads give another one every time."""
    keys = [*colors.T, *normals.T, *positions.T]
    return np.lexsort(keys).astype(np.int64)


def _renumbered(faces: Faces, order: NDArray[np.int64]) -> Faces:
    """Triangles (M, 3) of vertices in a new order, the least vertex first, sorted."""
    number = np.empty(order.size, np.int32)
    number[order] = np.arange(order.size, dtype=np.int32)
    faces = number[faces]
    first = faces.argmin(axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return np.ascontiguousarray(turned[np.lexsort(turned.T[::-1])])


def _nothing() -> tuple[Float32Array, Colors, Float32Array]:
    """Positions, colours and normals of no surface."""
    return np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8), np.empty((0, 3), np.float32)
