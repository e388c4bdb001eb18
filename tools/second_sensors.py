"""A second model of a lidar and a depth camera, not used to develop the repair: faults emerge from physics.

The scenes and poses are those of a drive; nothing is shared with `slam.simulation.faults`. A beam of the
lidar is a cone of rays whose returns are averaged by intensity, so readings at edges mix; glass transmits
light and reflects it near a right angle; lacquer reflects part of it to other surfaces; weak returns are
lost. The camera matches the projected dots (OpenCV's block matching): it has holes where the projector is
occluded, where too little light returns, where daylight is brighter than the dots and below its minimum
depth, and its edges are as wide as its blocks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator

import gtsam
import numpy as np
from numpy.typing import NDArray
from xu2024_pairs import TrueImage, TruePair

from slam.simulation.drive import Drive
from slam.simulation.home_model import Material
from slam.simulation.scene import Scene
from slam.simulation.sensor_models import CameraModel, LidarModel

Floats = NDArray[np.float32]

# Shares of the light that a surface scatters, and that it throws on like a mirror.
_SCATTERED = {Material.MATTE: 0.6, Material.DARK: 0.04, Material.GLASS: 0.01, Material.WINDOW: 0.01,
              Material.SHINY: 0.25}  # fmt: skip
_MIRRORED = {Material.MATTE: 0.0, Material.DARK: 0.0, Material.GLASS: 0.08, Material.WINDOW: 0.08,
             Material.SHINY: 0.4}  # fmt: skip
_THROUGH = 0.84  # of a pane, both ways
_LOBE_RAD = 0.1  # within which a mirror throws light back to where it came from

_SUBRAYS = 9
_DIVERGENCE_RAD = 0.006  # of a URG-04LX: some 20 mm at 4 m and its own width
_WEAKEST = 0.05  # return at which a lidar gives up: matte at a right angle, at a fifth more than its reach
_LOST_SHARE = 0.004  # interference, motes
_GAIN_SIGMA = 0.3  # of the logarithm of what is too faint, beam by beam

_BLOCK, _DISPARITIES = 9, 64
_BRIGHT = 1.6  # exposure: matte at 1 m saturates
_DAYLIGHT, _GRAIN = 0.9, 0.012


def second_pairs(drive: Drive, pairs: Iterable[TruePair]) -> Iterator[TruePair]:
    """The pairs of a drive with other readings; their fault masks stay those of the first model."""
    scene, mounted = Scene(drive.home), drive.rig.lidar
    assert mounted is not None
    for number, pair in enumerate(pairs):
        rng = np.random.default_rng([drive.seed, number])
        x, y, yaw = pair.T_map_laser.x(), pair.T_map_laser.y(), pair.T_map_laser.theta()
        T_map_laser = gtsam.Pose3(gtsam.Rot3.Rz(yaw), np.array([x, y, mounted.T_base_laser.z()]))
        ranges = scan_cones(scene, T_map_laser.matrix(), mounted.model, rng)
        scan = dataclasses.replace(pair.scan, ranges_m=ranges)
        images = tuple(
            _image(scene, T_map_laser, image, camera.model, rng)
            for image, camera in zip(pair.images, drive.rig.cameras, strict=True)
        )
        yield dataclasses.replace(pair, scan=scan, images=images)


def scan_cones(
    scene: Scene, T_map_laser: NDArray[np.float64], model: LidarModel, rng: np.random.Generator
) -> Floats:
    """(N,) ranges, ``inf`` where too little comes back."""
    beams = model.start_angle_rad + model.step_rad * np.arange(model.beams)
    spread = np.linspace(-0.5, 0.5, _SUBRAYS) * _DIVERGENCE_RAD
    bearings = (beams[:, None] + spread).ravel()
    ways = (
        np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros(bearings.size)]) @ T_map_laser[:3, :3].T
    )
    rays = np.hstack([np.tile(T_map_laser[:3, 3], (len(ways), 1)), ways]).astype(np.float32)
    distance, strength = returns(scene, rays)
    beam = np.exp(-((2.0 * spread / _DIVERGENCE_RAD) ** 2))
    strength = strength.reshape(2, model.beams, _SUBRAYS) * beam / beam.sum()
    distance = np.where(strength > 0.0, distance.reshape(strength.shape), 0.0)
    total = strength.sum(axis=(0, 2))
    mean = (distance * strength).sum(axis=(0, 2)) / np.maximum(total, 1e-12)
    faintest = _WEAKEST * _SCATTERED[Material.MATTE] / model.range_max_m**2
    fainter = np.sqrt(faintest / np.maximum(total, faintest))
    sigma = model.sigma_m + mean * (model.sigma_share + fainter * (model.sigma_share_far - model.sigma_share))
    ranges = mean + sigma * rng.standard_normal(model.beams)
    lost = total < faintest * rng.lognormal(0.0, _GAIN_SIGMA, model.beams)
    lost |= (
        (rng.random(model.beams) < _LOST_SHARE) | (ranges > model.range_max_m) | (ranges < model.range_min_m)
    )
    return np.where(lost, np.inf, ranges).astype(np.float32)


def returns(scene: Scene, rays: Floats) -> tuple[Floats, Floats]:
    """(2, N) distances and strengths of the first surface's return, and of what comes through or around."""
    hits = scene.cast(rays)
    ways = rays[:, 3:] / np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    cosine = np.abs((ways * hits.normal).sum(axis=1))
    mirrored = _of(hits.material, _MIRRORED)
    first_m = hits.range_m
    straight = _of(hits.material, _SCATTERED) * cosine
    straight += mirrored * np.exp(-((np.arccos(cosine.clip(0.0, 1.0)) / _LOBE_RAD) ** 2))
    panes = np.isin(hits.material, (Material.GLASS, Material.WINDOW))
    # What goes on: straight through a pane, or thrown off lacquer; of a window nothing comes back.
    shiny = hits.material == Material.SHINY
    further_m, further = np.full_like(first_m, np.inf), np.zeros_like(first_m)
    if panes.any():
        behind = scene.cast_through_glass(rays[panes])
        seen = np.abs((ways[panes] * behind.normal).sum(axis=1))
        further_m[panes] = np.where(hits.material[panes] == Material.GLASS, behind.range_m, np.inf)
        further[panes] = _THROUGH * _of(behind.material, _SCATTERED) * seen
    if shiny.any():
        off = ways[shiny] - 2.0 * (ways[shiny] * hits.normal[shiny]).sum(axis=1)[:, None] * hits.normal[shiny]
        start = rays[shiny, :3] + (first_m[shiny, None] - 1e-3) * rays[shiny, 3:]
        beside = scene.cast(np.hstack([start, off]).astype(np.float32))
        further_m[shiny] = first_m[shiny] + beside.range_m
        # There and back over the mirror.
        further[shiny] = _of(beside.material, _SCATTERED) * np.abs((off * beside.normal).sum(axis=1))
        further[shiny] *= mirrored[shiny] ** 2
    distance = np.stack([first_m, further_m])
    strength = np.stack([straight, further]) / np.maximum(distance, 0.05) ** 2
    return distance, np.where(np.isfinite(distance), strength, 0.0).astype(np.float32)


def _of(materials: NDArray[np.uint8], table: dict[Material, float]) -> Floats:
    """(N,) a property of each material."""
    return np.array([table[material] for material in sorted(table)], dtype=np.float32)[materials]


def _image(
    scene: Scene, T_map_laser: gtsam.Pose3, image: TrueImage, model: CameraModel, rng: np.random.Generator
) -> TrueImage:
    """The same image by matched dots."""
    T = T_map_laser.compose(image.T_laser_camera).matrix()
    depth = match_dots(scene, T, model, rng)
    return dataclasses.replace(image, depth=dataclasses.replace(image.depth, depth_m=depth))


def match_dots(
    scene: Scene, T_map_camera: NDArray[np.float64], model: CameraModel, rng: np.random.Generator
) -> Floats:
    """(H, W) depth by matching a camera's image with the dots that the projector on its right throws."""
    import cv2

    k = model.intrinsics
    x, y = (np.arange(k.width) - k.cx) / k.fx, (np.arange(k.height) - k.cy) / k.fy
    across, down = np.meshgrid(x, y)
    ways = np.stack([across, down, np.ones_like(across)], axis=-1).reshape(-1, 3)
    eye = T_map_camera[:3, 3]
    rays = np.hstack([np.tile(eye, (len(ways), 1)), ways @ T_map_camera[:3, :3].T]).astype(np.float32)
    depth, strength = returns(scene, rays)
    lengths = np.linalg.norm(ways, axis=1)
    # Millimetres of pattern: the device's own focal length times its baseline, at this image's width.
    baseline_m = model.faults.shadow_focal_baseline_px_m / k.fx
    projector = eye + baseline_m * T_map_camera[:3, 0]
    dots = rng.random((k.height, k.width + 2 * _DISPARITIES)).astype(np.float32)
    dots = cv2.GaussianBlur((dots > 0.7).astype(np.float32), (0, 0), 0.6)
    shone = np.zeros(len(rays), dtype=np.float32)
    for way in range(2):
        some = np.isfinite(depth[way]) & (strength[way] > 0.0)
        points = rays[:, :3] + np.where(some, depth[way], 0.0)[:, None] * rays[:, 3:]
        lit = some & _lit(scene, projector, points)
        disparity = model.faults.shadow_focal_baseline_px_m / np.where(some, np.maximum(depth[way], 0.1), 1.0)
        column = np.tile(np.arange(k.width), k.height) - disparity + _DISPARITIES
        row = np.repeat(np.arange(k.height), k.width)
        pattern = cv2.remap(
            dots,
            column.reshape(k.height, k.width).astype(np.float32),
            row.reshape(k.height, k.width).astype(np.float32),
            cv2.INTER_LINEAR,
        ).ravel()
        # The strength is by the square of the depth; of the distance it must be.
        shone += np.where(lit, strength[way] / lengths**2 * pattern, 0.0).astype(np.float32)
    window = scene.cast(rays).material == Material.WINDOW
    daylight = cv2.GaussianBlur(window.reshape(k.height, k.width).astype(np.float32), (0, 0), k.width / 40.0)
    seen = _BRIGHT * shone.reshape(k.height, k.width) + _DAYLIGHT * daylight
    seen += _GRAIN * rng.standard_normal(seen.shape)
    left = cv2.copyMakeBorder(seen.astype(np.float32), 0, 0, _DISPARITIES, 0, cv2.BORDER_CONSTANT)
    matcher = cv2.StereoBM_create(numDisparities=_DISPARITIES, blockSize=_BLOCK)
    matcher.setUniquenessRatio(10)
    matcher.setTextureThreshold(20)
    matcher.setSpeckleWindowSize(40)
    matcher.setSpeckleRange(2)
    found = matcher.compute(_grey(left), _grey(dots[:, : left.shape[1]]))[:, _DISPARITIES:] / 16.0
    with np.errstate(divide="ignore"):
        metres = model.faults.shadow_focal_baseline_px_m / np.where(found > 0.0, found, np.nan)
    good = (metres >= model.range_min_m) & (metres <= model.range_max_m)
    return np.where(good, metres, 0.0).astype(np.float32)


def _grey(image: Floats) -> NDArray[np.uint8]:
    """In the 256 steps of a camera."""
    return (255.0 * image).clip(0, 255).astype(np.uint8)


def _lit(scene: Scene, projector: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether light from the projector reaches points; panes let it through."""
    ways = points - projector
    rays = np.hstack([np.tile(projector, (len(points), 1)), ways]).astype(np.float32)
    return np.asarray(scene.cast_through_glass(rays).range_m > 0.98)
