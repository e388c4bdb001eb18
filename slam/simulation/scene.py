"""Casts rays into a home: Embree or rasterisation for the mesh; closed form for a walking person."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import BoolArray, CameraIntrinsics, Float32Array
from slam.simulation.home_model import Home, Int32Array, Material
from slam.simulation.rasterizer import rasterize
from slam.simulation.ray_caster import RayCaster

NOTHING = -1  # triangle and obstacle of a ray without a hit
PERSON = -2  # triangle and obstacle of the person
PERSON_RADIUS_M, PERSON_HEIGHT_M = 0.25, 1.7


@dataclass(frozen=True, slots=True)
class Hits:
    """First surface on each ray; glass counts like any other surface.

    Attributes
    ----------
    range_m
        (N,) distance in lengths of the ray's direction: metres for unit directions, depth for directions
        whose component along the optical axis is 1. ``inf`` without a surface.
    triangle
        (N,) index into `Home.triangles`, `NOTHING` or `PERSON`.
    obstacle
        (N,) id of the obstacle, `NOTHING` or `PERSON`.
    material
        (N,) `Material`; matte without a surface.
    normal
        (N, 3) unit, outward, map frame; zero without a surface.
    """

    range_m: Float32Array
    triangle: Int32Array
    obstacle: Int32Array
    material: NDArray[np.uint8]
    normal: Float32Array


class Scene:
    """A home in a ray caster, built once."""

    def __init__(self, home: Home) -> None:
        self.home = home
        clear = np.isin(home.material_of_triangle, (Material.GLASS, Material.WINDOW))
        # Glass separate, so that a second cast finds the surface behind it.
        self._opaque_index = np.flatnonzero(~clear).astype(np.int32)
        self._all_index = np.arange(len(home.triangles), dtype=np.int32)
        a, b, c = (home.vertices[home.triangles[:, n]].astype(np.float64) for n in range(3))
        normals = np.cross(b - a, c - a)
        self._normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
        self._everything = RayCaster(home.vertices, home.triangles)
        self._opaque = RayCaster(home.vertices, home.triangles[self._opaque_index])

    def cast(self, origins_dirs: Float32Array, person_xy: tuple[float, float] | None = None) -> Hits:
        """Find the first surface along each ray.

        Parameters
        ----------
        origins_dirs
            (N, 6) origin and direction, map frame; the direction's length is the unit of the result.
        person_xy
            Position of the person, an upright cylinder of radius 0.25 m and height 1.7 m.
        """
        return self._cast(self._everything, self._all_index, origins_dirs, person_xy)

    def cast_image(
        self,
        T_world_camera: gtsam.Pose3,
        intrinsics: CameraIntrinsics,
        rays: Float32Array,
        person_xy: tuple[float, float] | None = None,
    ) -> Hits:
        """Find the first surface along the rays of all pixels, with directions z = 1; else as `cast`."""
        vertices_camera = (
            self.home.vertices - T_world_camera.translation()
        ) @ T_world_camera.rotation().matrix()
        range_m, triangle = rasterize(vertices_camera, self.home.triangles, intrinsics)
        return self._hits(range_m, triangle, rays, person_xy)

    def cast_through_glass(
        self, origins_dirs: Float32Array, person_xy: tuple[float, float] | None = None
    ) -> Hits:
        """Find the first surface along each ray that is not glass; arguments as `cast`."""
        return self._cast(self._opaque, self._opaque_index, origins_dirs, person_xy)

    def _cast(
        self,
        caster: RayCaster,
        index: Int32Array,
        origins_dirs: Float32Array,
        person_xy: tuple[float, float] | None,
    ) -> Hits:
        """Cast, then name what was hit."""
        rays = np.ascontiguousarray(origins_dirs, dtype=np.float32)
        range_m, primitive, _ = caster.cast(rays)
        # `NOTHING` is the last index of every array.
        return self._hits(range_m, np.append(index, np.int32(NOTHING))[primitive], rays, person_xy)

    def _hits(
        self,
        range_m: Float32Array,
        triangle: Int32Array,
        rays: Float32Array,
        person_xy: tuple[float, float] | None,
    ) -> Hits:
        """Identify the surfaces hit, with the person in front."""
        obstacle, material, normal = _name_hits(
            triangle, self._normals, self.home.obstacle_of_triangle, self.home.material_of_triangle
        )
        if person_xy is not None:
            mine = _meet_cylinder(rays, np.array(person_xy, dtype=np.float64), range_m, normal)
            triangle[mine], obstacle[mine], material[mine] = PERSON, PERSON, Material.MATTE
        return Hits(range_m, triangle, obstacle, material, normal)


@kernel(nogil=True)
def _name_hits(
    triangle: Int32Array,
    normal_of_triangle: Float32Array,
    obstacle_of_triangle: Int32Array,
    material_of_triangle: NDArray[np.uint8],
) -> tuple[Int32Array, NDArray[np.uint8], Float32Array]:
    """Return obstacle, material and normal of the triangles hit by the rays."""
    count = triangle.size
    obstacle = np.full(count, -1, np.int32)
    material = np.zeros(count, np.uint8)
    normal = np.zeros((count, 3), np.float32)
    for ray in range(count):
        face = triangle[ray]
        if face >= 0:
            obstacle[ray], material[ray] = obstacle_of_triangle[face], material_of_triangle[face]
            for axis in range(3):
                normal[ray, axis] = normal_of_triangle[face, axis]
    return obstacle, material, normal


@kernel(nogil=True)
def _meet_cylinder(
    rays: Float32Array, center: NDArray[np.float64], range_m: Float32Array, normal: Float32Array
) -> BoolArray:
    """Return the rays that hit the person first; their range and normal are replaced in place."""
    meets = np.zeros(range_m.size, np.bool_)
    for ray in range(range_m.size):
        x, y, z = rays[ray, 0] - center[0], rays[ray, 1] - center[1], np.float64(rays[ray, 2])
        dx, dy, dz = np.float64(rays[ray, 3]), np.float64(rays[ray, 4]), np.float64(rays[ray, 5])
        a, b = dx * dx + dy * dy, x * dx + y * dy
        c = x * x + y * y - PERSON_RADIUS_M**2
        if c <= 0.0 or b >= 0.0 or b * b - a * c <= 0.0:
            continue  # inside, pointing away, or beside
        root = math.sqrt(b * b - a * c)
        t = (-b - root) / a
        top = z + t * dz > PERSON_HEIGHT_M
        if top:  # above the edge: the ray may still hit the top
            t = (PERSON_HEIGHT_M - z) / dz if dz < 0.0 else math.inf
            if t > (-b + root) / a:
                continue
        if not (0.0 < t < range_m[ray]) or z + t * dz < 0.0:
            continue
        meets[ray] = True
        range_m[ray] = t
        normal[ray, 0] = 0.0 if top else (x + t * dx) / PERSON_RADIUS_M
        normal[ray, 1] = 0.0 if top else (y + t * dy) / PERSON_RADIUS_M
        normal[ray, 2] = 1.0 if top else 0.0
    return meets
