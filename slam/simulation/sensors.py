"""Simulates sensors: a scan, a revolution of a 3D lidar, colour and depth images, each with ground truth.

A reading is the true distance, changed by faults, then noise, then quantisation. Each reading is
instantaneous: the robot does not move during a revolution of a lidar.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array
from slam.simulation.faults import Fault, FaultMask, FaultyReadings, Surfaces, corrupt
from slam.simulation.home_model import Material
from slam.simulation.scene import PERSON, Hits, Scene
from slam.simulation.sensor_models import CameraModel, LidarModel, RingLidarModel
from slam.simulation.texture import paint
from slam.simulation.wall_tags import paint_tags

_GLASS_SEEN = 0.2  # share of a pane's own colour in the transmitted image


@dataclass(frozen=True, slots=True)
class SimulatedScan:
    """A scan of a 2D lidar.

    Attributes
    ----------
    ranges_m
        (N,) as in `LaserScan`: ``inf`` no return, ``nan`` invalid (nearer than the lidar measures).
    true_ranges_m
        (N,) to the first surface, glass and person included; ``inf`` if there is none.
    fault
        (N,) `Fault` of each beam.
    """

    ranges_m: Float32Array
    true_ranges_m: Float32Array
    fault: FaultMask


@dataclass(frozen=True, slots=True)
class SimulatedCloud:
    """The returns of one revolution of a 3D lidar, firing by firing.

    Attributes
    ----------
    points_laser
        (N, 3) laser frame.
    ring
        (N,) index of the ring, 0 the lowest.
    time_s
        (N,) time of a firing within the revolution, for the order only: all see the world at one instant.
    true_ranges_m, fault
        (N,) of the same beams.
    """

    points_laser: Float32Array
    ring: NDArray[np.uint8]
    time_s: Float32Array
    true_ranges_m: Float32Array
    fault: FaultMask


@dataclass(frozen=True, slots=True)
class SimulatedImage:
    """A colour image and the depth image registered to it.

    Attributes
    ----------
    color
        (H, W, 3) RGB.
    depth_m
        (H, W) along the optical axis, in the device's steps; 0 invalid.
    true_depth_m
        (H, W) to the first surface, glass and person included; ``inf`` if there is none.
    fault
        (H, W) `Fault` of each pixel.
    """

    color: ColorImage
    depth_m: Float32Array
    true_depth_m: Float32Array
    fault: FaultMask


def scan_lidar(
    scene: Scene,
    T_world_laser: gtsam.Pose3,
    sensor: LidarModel,
    rng: np.random.Generator,
    person_xy: tuple[float, float] | None = None,
) -> SimulatedScan:
    """Simulate one scan of a 2D lidar.

    Parameters
    ----------
    T_world_laser
        Pose of the laser, with beams in its x-y plane.
    rng
        All noise and faults come from it.
    person_xy
        Where the person stands, map frame.
    """
    bearings = sensor.start_angle_rad + sensor.step_rad * np.arange(sensor.beams)
    directions = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(sensor.beams)])
    rays = _rays(directions.astype(np.float32), T_world_laser.matrix())
    surfaces, _ = _look(scene, scene.cast(rays, person_xy), rays, (1, sensor.beams), person_xy)
    faulty = corrupt(surfaces, sensor.faults, sensor.range_min_m, sensor.range_max_m, rng)

    def sigma_m(distance_m: Float32Array) -> Float32Array:
        growth = max(0.0, sensor.sigma_share_far - sensor.sigma_share) / sensor.range_max_m**2
        share = sensor.sigma_share + growth * distance_m**2
        return np.asarray(sensor.sigma_m + share * distance_m, dtype=np.float32)

    ranges, fault = _measure(faulty, sensor, sigma_m, rng)
    too_close = np.isnan(ranges) & (surfaces.distance_m < sensor.range_min_m) & (fault == Fault.HOLE_RANGE)
    ranges[np.isnan(ranges) & ~too_close] = np.inf
    return SimulatedScan(ranges[0], surfaces.distance_m[0], fault[0])


def scan_lidar_3d(
    scene: Scene,
    T_world_laser: gtsam.Pose3,
    sensor: RingLidarModel,
    rng: np.random.Generator,
    person_xy: tuple[float, float] | None = None,
) -> SimulatedCloud:
    """Simulate one revolution of a 3D lidar; arguments as `scan_lidar`."""
    directions = _ring_directions(sensor.elevations_rad, sensor.azimuths)
    shape = (len(sensor.elevations_rad), sensor.azimuths)
    rays = _rays(directions, T_world_laser.matrix())
    surfaces, _ = _look(scene, scene.cast(rays, person_xy), rays, shape, person_xy)
    faulty = corrupt(surfaces, sensor.faults, sensor.range_min_m, sensor.range_max_m, rng)
    ranges, fault = _measure(faulty, sensor, lambda d: np.full_like(d, sensor.sigma_m), rng)
    # Firing by firing, as the device sends them: all rings of an azimuth, then the next.
    column, ring = np.nonzero(~np.isnan(ranges.T))
    beams = directions.reshape(*shape, 3)[ring, column]
    return SimulatedCloud(
        points_laser=beams * ranges[ring, column, None],
        ring=ring.astype(np.uint8),
        time_s=(column / (sensor.azimuths * sensor.rate_hz)).astype(np.float32),
        true_ranges_m=surfaces.distance_m[ring, column],
        fault=fault[ring, column],
    )


def render_rgbd(
    scene: Scene,
    T_world_camera: gtsam.Pose3,
    camera: CameraModel,
    rng: np.random.Generator,
    person_xy: tuple[float, float] | None = None,
) -> SimulatedImage:
    """Simulate one colour image and its depth.

    Parameters
    ----------
    T_world_camera
        The optical frame: z forward, x right and y down in the image.
    rng
        All noise and faults come from it.
    person_xy
        Where the person stands, map frame.
    """
    shape = (camera.intrinsics.height, camera.intrinsics.width)
    # Directions have z = 1: the ray caster's distance is the depth.
    rays = _rays(_pixel_directions(camera.intrinsics), T_world_camera.matrix())
    hits = scene.cast_image(T_world_camera, camera.intrinsics, rays, person_xy)
    surfaces, behind = _look(scene, hits, rays, shape, person_xy)
    pixel_rad = 1.0 / camera.intrinsics.fx
    image = paint(scene.home, rays, hits, pixel_rad, person_xy)
    if behind is not None:
        panes = hits.material == Material.GLASS
        through = paint(scene.home, rays[panes], behind, pixel_rad, person_xy)
        image[panes] = _GLASS_SEEN * image[panes] + (1.0 - _GLASS_SEEN) * through
    paint_tags(image, hits.range_m, scene.home.tags, T_world_camera, camera.intrinsics)
    faulty = corrupt(surfaces, camera.faults, camera.range_min_m, camera.range_max_m, rng)
    depth, fault = _triangulate(faulty, camera, rng)
    color = _expose(image, camera.color_sigma, int(rng.integers(1 << 31)))
    return SimulatedImage(color.reshape(*shape, 3), depth, surfaces.distance_m, fault)


def _look(
    scene: Scene,
    hits: Hits,
    rays: Float32Array,
    shape: tuple[int, int],
    person_xy: tuple[float, float] | None,
) -> tuple[Surfaces, Hits | None]:
    """Return the surfaces on all rays, in the sensor's shape; and those behind panes, if any."""
    behind_m = hits.range_m.copy()
    panes = hits.material == Material.GLASS
    behind = None
    if panes.any():
        behind = scene.cast_through_glass(rays[panes], person_xy)
        behind_m[panes] = behind.range_m
    # Behind a window there is nothing: the home is isolated.
    behind_m[hits.material == Material.WINDOW] = np.inf
    surfaces = Surfaces(
        distance_m=hits.range_m.reshape(shape),
        behind_m=behind_m.reshape(shape),
        material=hits.material.reshape(shape),
        cos_incidence=_cos_incidence(rays, hits.normal).reshape(shape),
        face=(hits.triangle >> 1).reshape(shape),
        person=(hits.triangle == PERSON).reshape(shape),
    )
    return surfaces, behind


def _measure(
    faulty: FaultyReadings,
    sensor: LidarModel | RingLidarModel,
    sigma_m: Callable[[Float32Array], Float32Array],
    rng: np.random.Generator,
) -> tuple[Float32Array, FaultMask]:
    """Add noise and the lidar's resolution; ``nan`` is a hole, also if noise exceeds the range."""
    noise = rng.standard_normal(faulty.distance_m.shape, dtype=np.float32)
    noisy = faulty.distance_m + sigma_m(faulty.distance_m) * noise
    ranges = (np.round(noisy / sensor.resolution_m) * sensor.resolution_m).astype(np.float32)
    outside = (ranges < sensor.range_min_m) | (ranges > sensor.range_max_m)
    ranges[outside] = np.nan
    return ranges, np.where(outside, np.uint8(Fault.HOLE_RANGE), faulty.fault)


def _triangulate(
    faulty: FaultyReadings, camera: CameraModel, rng: np.random.Generator
) -> tuple[Float32Array, FaultMask]:
    """Return the depth that the device computes from a noisy, quantised disparity; 0 is a hole."""
    noise = rng.standard_normal(faulty.distance_m.shape, dtype=np.float32)
    depth, fault = faulty.distance_m.copy(), faulty.fault.copy()
    _disparity_steps(
        depth.ravel(),
        fault.ravel(),
        noise.ravel(),
        camera.focal_baseline_px_m,
        (camera.disparity_step_px, camera.disparity_sigma_px, camera.depth_unit_m),
        (camera.range_min_m, camera.range_max_m),
        np.uint8(Fault.HOLE_RANGE),
    )
    return depth, fault


@lru_cache(maxsize=16)
def _pixel_directions(intrinsics: CameraIntrinsics) -> Float32Array:
    """Return (H * W, 3) directions of the pixels, optical frame, z = 1."""
    x = (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
    y = (np.arange(intrinsics.height) - intrinsics.cy) / intrinsics.fy
    across, down = np.meshgrid(x, y)
    return np.stack([across, down, np.ones_like(across)], axis=-1).reshape(-1, 3).astype(np.float32)


@lru_cache(maxsize=4)
def _ring_directions(elevations_rad: tuple[float, ...], azimuths: int) -> Float32Array:
    """Return (rings * azimuths, 3) unit directions, ring by ring."""
    turn = 2.0 * np.pi * np.arange(azimuths) / azimuths
    rise = np.array(elevations_rad)[:, None]
    level = np.cos(rise)
    beams = np.stack([level * np.cos(turn), level * np.sin(turn), np.sin(rise) + 0.0 * turn], axis=-1)
    return beams.reshape(-1, 3).astype(np.float32)


@kernel(nogil=True)
def _rays(directions: Float32Array, T_world_sensor: NDArray[np.float64]) -> Float32Array:
    """Return (N, 6) origins and directions in the world from directions in the sensor's frame."""
    rays = np.empty((directions.shape[0], 6), np.float32)
    T = T_world_sensor
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], np.float32(T[0, 3])
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], np.float32(T[1, 3])
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], np.float32(T[2, 3])
    for ray in range(directions.shape[0]):
        x, y, z = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        rays[ray, 0], rays[ray, 1], rays[ray, 2] = tx, ty, tz
        rays[ray, 3] = r00 * x + r01 * y + r02 * z
        rays[ray, 4] = r10 * x + r11 * y + r12 * z
        rays[ray, 5] = r20 * x + r21 * y + r22 * z
    return rays


@kernel(nogil=True)
def _cos_incidence(rays: Float32Array, normal: Float32Array) -> Float32Array:
    """Return (N,) the cosine between each ray and the normal of its surface."""
    cosine = np.empty(rays.shape[0], np.float32)
    for ray in range(rays.shape[0]):
        dx, dy, dz = rays[ray, 3], rays[ray, 4], rays[ray, 5]
        along = abs(dx * normal[ray, 0] + dy * normal[ray, 1] + dz * normal[ray, 2])
        cosine[ray] = along / np.sqrt(dx * dx + dy * dy + dz * dz)
    return cosine


@kernel(nogil=True, error_model="numpy")
def _disparity_steps(
    depth: Float32Array,
    fault: FaultMask,
    noise: Float32Array,
    focal_baseline_px_m: float,
    step_sigma_unit: tuple[float, float, float],
    limits_m: tuple[float, float],
    out_of_range: np.uint8,
) -> None:
    """Apply Li2020 Eq. (2)-(4) forth and back with noise and quantisation between; in place."""
    step, sigma, unit = step_sigma_unit
    for pixel in range(depth.size):
        # Without branches, the compiler vectorises over pixels.
        disparity = focal_baseline_px_m / depth[pixel] + sigma * noise[pixel]
        disparity = max(step, np.floor(disparity / step + 0.5) * step)
        measured = np.floor(focal_baseline_px_m / disparity / unit + 0.5) * unit
        hole = np.isnan(depth[pixel])
        within = (limits_m[0] <= measured) & (measured <= limits_m[1])
        depth[pixel] = 0.0 if hole | ~within else measured
        fault[pixel] = fault[pixel] if hole | within else out_of_range


@kernel(nogil=True)
def _expose(image: Float32Array, sigma: float, seed: int) -> ColorImage:
    """Add noise and round to bytes; a hash is faster than three normal numbers per pixel."""
    color = np.empty(image.size, np.uint8)
    values = image.ravel()
    for at in range(values.size):
        h = np.uint32(seed) ^ (np.uint32(at) * np.uint32(0x9E3779B1))
        h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
        h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
        h = np.uint32(h ^ (h >> np.uint32(16)))
        # The sum of two uniform numbers: a triangle of standard deviation 1 / sqrt(6).
        total = float(np.int32(h & np.uint32(0xFFFF)) + np.int32(h >> np.uint32(16)))
        noise = (total / 65536.0 - 1.0) * 2.449489742783178 * sigma
        color[at] = np.uint8(np.int32(min(255.0, max(0.0, values[at] + noise + 0.5))))
    return color.reshape(image.shape)
